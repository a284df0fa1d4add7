"""The ways through free floor: the middle lines of all passages as a network, and a walk along each both ways."""

from __future__ import annotations

import itertools

import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import dijkstra
from skimage.morphology import skeletonize

from sim_bridge.stage.paths import CELL_M, FloorGraph

Array = NDArray[np.float64]
Cell = tuple[int, int]

# Dead ends of the middle lines run into corners: so much of them is not walked.
CORNER_M = 1.2
# Crossings closer than this are one.
CROSSING_M = 0.5


def walk_network(graph: FloorGraph, *, reach_m: float) -> Array:
    """Return a closed walk (n, 2) in m that goes along every passage of connected free floor, once each way.

    Passages that lead around furniture are walked through, never only into: a map of images of one end and images of
    the other could not tell how they belong together. Free floor farther than ``reach_m`` from the walk is visited.
    """
    cells = np.round((graph.centres - graph.centres[0]) / CELL_M).astype(int)
    low = cells.min(axis=0) - 1
    cells -= low
    free = np.zeros(cells.max(axis=0) + 2, np.bool_)
    free[tuple(cells.T)] = True
    number = np.full(free.shape, -1)
    number[tuple(cells.T)] = np.arange(len(cells))
    lines = _contracted(_network(_pixels(np.asarray(skeletonize(free)))))
    _trim(lines)
    kept = np.zeros(free.shape, np.bool_)
    for *_, way in lines.edges(data="way"):
        kept[tuple(np.array(way).T)] = True
    if not kept.any():
        # A floor without passages: its middle.
        middle = cells[np.argmin(np.linalg.norm(cells - cells.mean(axis=0), axis=1))]
        kept[tuple(middle)] = True
    _reach_out(graph, kept, number, reach_m)
    walked = _contracted(_network(_pixels(kept)))
    route = _both_ways(walked)
    if len(route) < 2:
        route = [tuple(np.argwhere(kept)[0])]
    walk: Array = graph.centres[0] + (np.array(route) + low) * CELL_M
    return walk


def _pixels(mask: NDArray[np.bool_]) -> nx.Graph:
    """Return the graph of neighbouring cells; a diagonal beside a corner is left out."""
    graph = nx.Graph()
    for x, y in np.argwhere(mask):
        graph.add_node((int(x), int(y)))
        for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
            i, j = x + dx, y + dy
            if not (0 <= i < mask.shape[0] and 0 <= j < mask.shape[1] and mask[i, j]):
                continue
            if dx and dy and (mask[x, j] or mask[i, y]):
                continue
            graph.add_edge((int(x), int(y)), (int(i), int(j)))
    return graph


def _network(pixels: nx.Graph) -> nx.MultiGraph:
    """Return crossings and ends, joined by ways: lists of cells from the smaller end to the larger one."""
    lines = nx.MultiGraph()
    done: set[frozenset[Cell]] = set()
    for part in nx.connected_components(pixels):
        ends = sorted(cell for cell in part if pixels.degree(cell) != 2) or [min(part)]
        lines.add_nodes_from(ends)
        for start in ends:
            for second in sorted(pixels[start]):
                if frozenset((start, second)) in done:
                    continue
                way = [start, second]
                while way[-1] not in lines:
                    ahead = [cell for cell in sorted(pixels[way[-1]]) if cell != way[-2]]
                    way.append(ahead[0])
                done.update(frozenset(pair) for pair in itertools.pairwise(way))
                lines.add_edge(way[0], way[-1], way=way)
    return lines


def _contracted(lines: nx.MultiGraph) -> nx.MultiGraph:
    """Join crossings that lie close together; ways in between go."""
    while True:
        short = [
            (u, v, key)
            for u, v, key, way in lines.edges(keys=True, data="way")
            if u != v and _length(way) < CROSSING_M and lines.degree(u) > 2 and lines.degree(v) > 2
        ]
        if not short:
            return lines
        u, v, key = min(short)
        middle = lines.edges[u, v, key]["way"]
        lines.remove_edge(u, v, key)
        for _, other, way in list(lines.edges(v, data="way")):
            # The way from v's end on begins with what led from u to v.
            from_v = way if way[0] == v else way[::-1]
            to_v = middle if middle[0] == u else middle[::-1]
            end = u if other == v else other
            joined = to_v[:-1] + from_v if other != v else to_v[:-1] + from_v + to_v[-2::-1]
            lines.add_edge(u, end, way=joined)
        lines.remove_node(v)


def _trim(lines: nx.MultiGraph) -> None:
    """Shorten dead ends by CORNER_M, those that end in one first; what was a crossing of them is none any more."""
    for node in sorted(node for node in lines if lines.degree(node) == 1):
        if node not in lines or lines.degree(node) != 1:
            continue
        (_, other, way) = next(iter(lines.edges(node, data="way")))
        from_end = way if way[0] == node else way[::-1]
        left = from_end[round(CORNER_M / CELL_M) :]
        lines.remove_node(node)
        if len(left) > 2:
            lines.add_edge(left[0], other, way=left)


def _reach_out(graph: FloorGraph, kept: NDArray[np.bool_], number: NDArray[np.intp], reach_m: float) -> None:
    """Add ways to what lies farther than ``reach_m`` from all cells that are kept, farthest first."""
    place = np.full(len(graph.centres), 0)
    place[number[number >= 0]] = np.flatnonzero(number.ravel() >= 0)
    while True:
        sources = number[kept & (number >= 0)]
        cost, previous, _ = dijkstra(
            graph.steps, directed=False, indices=sources, min_only=True, return_predecessors=True
        )
        # Steps beside furniture cost up to three times their length.
        far = np.where(np.isfinite(cost), cost, 0.0)
        cell = int(np.argmax(far))
        if far[cell] <= 1.5 * reach_m:
            return
        # The last bit is seen from where the walker turns.
        while far[cell] > 0.0:
            if far[cell] <= far.max() - 0.5 * reach_m:
                kept.ravel()[place[cell]] = True
            cell = int(previous[cell])


def _both_ways(lines: nx.MultiGraph) -> list[Cell]:
    """Return the cells of a closed walk that takes every way once in each direction; it only turns back at dead ends.

    At every crossing ways are joined so that one turns as little as possible; circuits are then joined where they meet.
    """
    ways = [way for *_, way in lines.edges(data="way")]
    directed = [way for there in ways for way in (there, there[::-1])]
    arriving: dict[Cell, list[int]] = {}
    for k, way in enumerate(directed):
        arriving.setdefault(way[-1], []).append(k)
    following = np.zeros(len(directed), int)
    for incoming in arriving.values():
        # A way's other direction is its neighbour by number.
        outgoing = [k ^ 1 for k in incoming]
        cost = np.array([[_turning(directed, i, j) for j in outgoing] for i in incoming])
        rows, columns = linear_sum_assignment(cost)
        following[np.array(incoming)[rows]] = np.array(outgoing)[columns]
    while True:
        circuit = _circuits(following)
        if not circuit.any():
            break
        swaps = [
            (_turning(directed, i, following[j]) + _turning(directed, j, following[i]), i, j)
            for incoming in arriving.values()
            for i, j in itertools.combinations(incoming, 2)
            if circuit[i] != circuit[j]
        ]
        _, i, j = min(swaps)
        following[[i, j]] = following[[j, i]]
    cells: list[Cell] = []
    k = 0
    for _ in directed:
        cells += directed[k][:-1]
        k = int(following[k])
    return cells


def _circuits(following: NDArray[np.int_]) -> NDArray[np.int_]:
    """Return the number of the circuit to which each way belongs."""
    circuit = np.full(len(following), -1)
    for start in range(len(following)):
        k, number = start, circuit.max() + 1
        while circuit[k] < 0:
            circuit[k] = number
            k = following[k]
    return circuit


def _turning(directed: list[list[Cell]], first: int, second: int) -> float:
    """Return by how much one turns from one way into the next: 0..2, and much more for turning back."""
    if second == first ^ 1:
        return 10.0
    before, after = directed[first], directed[second]
    a = np.subtract(before[-1], before[max(-6, -len(before))])
    b = np.subtract(after[min(5, len(after) - 1)], after[0])
    return 1.0 - float(a @ b) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-9)


def _length(way: list[Cell]) -> float:
    return CELL_M * float(np.linalg.norm(np.diff(np.array(way), axis=0), axis=1).sum())
