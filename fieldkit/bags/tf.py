"""A tree of static and moving transforms that is asked for one transform at one time; no ROS needed."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fieldkit.errors import FrameError
from fieldkit.frames import Pose, position_quaternion


def clean_frame(name: str) -> str:
    """Return a frame's name without the leading slash that ROS 1 allowed."""
    return name.lstrip("/")


@dataclasses.dataclass
class _Track:
    """Samples of one parent_from_child in the order of arrival: stamps, and rows x y z qx qy qz qw."""

    t_ns: list[int] = dataclasses.field(default_factory=list)
    rows: list[tuple[float, ...]] = dataclasses.field(default_factory=list)
    _ordered: tuple[NDArray[np.int64], NDArray[np.float64]] | None = None

    def add(self, t_ns: int, row: tuple[float, ...]) -> None:
        self.t_ns.append(t_ns)
        self.rows.append(row)
        self._ordered = None

    def ordered(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return stamps, strictly increasing, and rows; of equal stamps the first sample counts, as in tf2."""
        if self._ordered is None:
            stamps, first = np.unique(np.array(self.t_ns, dtype=np.int64), return_index=True)
            self._ordered = stamps, np.array(self.rows, dtype=np.float64)[first]
        return self._ordered


class TfBuffer:
    """All transforms of a recording. Never extrapolates, and bridges at most ``max_gap_ns`` between samples."""

    def __init__(self, *, max_gap_ns: int = 500_000_000) -> None:
        self.max_gap_ns = max_gap_ns
        self._static: dict[str, tuple[str, tuple[float, ...]]] = {}
        self._moving: dict[str, dict[str, _Track]] = {}

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames, sorted."""
        names = set(self._static) | set(self._moving) | {parent for parent, _ in self._static.values()}
        return tuple(sorted(names | {parent for tracks in self._moving.values() for parent in tracks}))

    def add_static(
        self, parent: str, child: str, position_m: Sequence[float], quaternion_xyzw: Sequence[float]
    ) -> None:
        """Add parent_from_child for all times; a later one replaces it. Raises FrameError for impossible numbers."""
        above, below, row = _row(parent, child, position_m, quaternion_xyzw)
        self._static[below] = above, row

    def add(
        self, parent: str, child: str, t_ns: int, *, position_m: Sequence[float], quaternion_xyzw: Sequence[float]
    ) -> None:
        """Add parent_from_child at one time. Raises FrameError for impossible numbers."""
        above, below, row = _row(parent, child, position_m, quaternion_xyzw)
        tracks = self._moving.setdefault(below, {})
        if above not in tracks:
            tracks[above] = _Track()
        tracks[above].add(t_ns, row)

    def replace_static(self, a: str, b: str, a_from_b: Pose) -> None:
        """Replace the fixed transform between two neighbouring frames, whichever of them hangs below the other."""
        below = a if self._static.get(a, ("",))[0] == b else b
        above, placed = (a, a_from_b) if below == b else (b, a_from_b.inv())
        self.add_static(above, below, *position_quaternion(placed))

    def lookup(self, target: str, source: str, *, t_ns: int) -> Pose:
        """Return target_from_source at a time, interpolated between samples.

        Raises FrameError that names the frames when they are not connected, when the time lies before the first or
        after the last sample of a transform on the way, or in a gap longer than ``max_gap_ns``.
        """
        found = self.lookup_all(target, source, t_ns=[t_ns])[0]
        if isinstance(found, FrameError):
            raise found
        return found

    def lookup_all(self, target: str, source: str, *, t_ns: Sequence[int]) -> list[Pose | FrameError]:
        """Return target_from_source for many times at once; where `lookup` would raise, the error stands instead."""
        found: dict[int, Pose | FrameError] = {}
        groups: dict[tuple[tuple[str, ...], tuple[str, ...]], list[int]] = {}
        for index, t in enumerate(t_ns):
            try:
                groups.setdefault(self._way(clean_frame(target), clean_frame(source), t), []).append(index)
            except FrameError as error:
                found[index] = error
        for (down, up), indices in groups.items():
            stamps = np.array([t_ns[i] for i in indices], dtype=np.int64)
            errors: dict[int, FrameError] = {}
            poses = self._climb(down, stamps, errors).inv() * self._climb(up, stamps, errors)
            for place, index in enumerate(indices):
                found[index] = errors[place] if place in errors else poses[place]
        return [found[index] for index in range(len(t_ns))]

    def chain(self, target: str, source: str, *, t_ns: int) -> tuple[tuple[str, str, bool], ...]:
        """Return the steps from target to source as (frame, next frame, whether the step between them can move).

        target_from_source is the product of frame_from_next over all steps. Raises FrameError where they are not
        connected.
        """
        down, up = self._way(clean_frame(target), clean_frame(source), t_ns)
        frames = (*down, *reversed(up[:-1]))
        return tuple(
            (a, b, any(a in self._moving.get(c, {}) or b in self._moving.get(c, {}) for c in (a, b)))
            for a, b in itertools.pairwise(frames)
        )

    def interval_ns(self, a: str, b: str) -> int:
        """Return the median time between two samples of the transform between two neighbouring frames."""
        tracks = [self._moving.get(child, {}).get(parent) for parent, child in ((a, b), (b, a))]
        stamps = [t.ordered()[0] for t in tracks if t is not None]
        return int(np.median(np.diff(stamps[0]))) if stamps and len(stamps[0]) > 1 else 0

    def _way(self, target: str, source: str, t_ns: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the frames from target, and from source, up to the first that they have in common."""
        up_source, up_target = self._ancestors(source, t_ns), self._ancestors(target, t_ns)
        common = next((frame for frame in up_source if frame in up_target), None)
        if common is None:
            known = ", ".join(self.frames[:12]) + (", ..." if len(self.frames) > 12 else "")
            raise FrameError(
                f"tf does not connect {source!r} (below {up_source[-1]!r}) with {target!r} (below {up_target[-1]!r}); "
                f"frames: {known or 'none'}"
            )
        up, down = up_source[: up_source.index(common) + 1], up_target[: up_target.index(common) + 1]
        return tuple(down), tuple(up)

    def _ancestors(self, frame: str, t_ns: int) -> list[str]:
        chain = [frame]
        while (parent := self._parent(chain[-1], t_ns)) is not None:
            if parent in chain:
                raise FrameError(f"tf has a loop: {' below '.join([*chain, parent])}")
            chain.append(parent)
        return chain

    def _parent(self, child: str, t_ns: int) -> str | None:
        tracks = self._moving.get(child)
        if not tracks:
            return self._static[child][0] if child in self._static else None
        if len(tracks) == 1:
            return next(iter(tracks))
        # A frame that was moved to another parent belongs to the one that spoke last before the time asked for
        latest = {parent: track.ordered()[0] for parent, track in tracks.items()}
        past = {p: int(stamps[np.searchsorted(stamps, t_ns, side="right") - 1]) for p, stamps in latest.items()}
        return max(past, key=lambda p: (past[p] <= t_ns, past[p]))

    def _climb(self, chain: Sequence[str], stamps: NDArray[np.int64], errors: dict[int, FrameError]) -> Pose:
        result = Pose.identity(len(stamps))
        for child, parent in itertools.pairwise(chain):
            result = self._sample(parent, child, stamps, errors) * result
        return result

    def _sample(self, parent: str, child: str, stamps: NDArray[np.int64], errors: dict[int, FrameError]) -> Pose:
        """Return parent_from_child at every stamp; where there is none, note why, and put any pose in its place."""
        track = self._moving.get(child, {}).get(parent)
        if track is None:
            return _poses(np.array([self._static[child][1]]))
        times, rows = track.ordered()
        right = np.minimum(np.searchsorted(times, stamps), len(times) - 1)
        left = np.where(times[right] == stamps, right, np.maximum(right - 1, 0))
        outside = (stamps < times[0]) | (stamps > times[-1])
        gap = ~outside & (times[right] - times[left] > self.max_gap_ns)
        for place in np.flatnonzero(outside | gap):
            what = f"tf {parent!r} from {child!r} at {stamps[place] / 1e9:.3f} s"
            span_s = (times[right[place]] - times[left[place]]) / 1e9
            why = (
                f"outside of its samples {times[0] / 1e9:.3f} .. {times[-1] / 1e9:.3f} s; it is never extrapolated"
                if outside[place]
                else f"in a gap of {span_s:.2f} s; at most {self.max_gap_ns / 1e9:.2f} s"
            )
            errors.setdefault(int(place), FrameError(f"{what}: {why}"))
        fraction = np.where(outside, 0.0, (stamps - times[left]) / np.maximum(times[right] - times[left], 1))
        return _between(_poses(rows[left]), _poses(rows[right]), fraction[:, None])


def _poses(rows: NDArray[np.float64]) -> Pose:
    return Pose.from_components(rows[:, :3], Rotation.from_quat(rows[:, 3:]))


def _between(first: Pose, second: Pose, fraction: NDArray[np.float64]) -> Pose:
    """Return the poses between n pairs, as `fieldkit.frames.interpolate` does for one pair; fraction is (n, 1)."""
    turn = (first.rotation.inv() * second.rotation).as_rotvec()
    xyz = (1.0 - fraction) * first.translation + fraction * second.translation
    return Pose.from_components(xyz, first.rotation * Rotation.from_rotvec(fraction * turn))


def _row(
    parent: str, child: str, position_m: Sequence[float], quaternion_xyzw: Sequence[float]
) -> tuple[str, str, tuple[float, ...]]:
    (x, y, z), (qx, qy, qz, qw) = position_m, quaternion_xyzw
    above, below = clean_frame(parent), clean_frame(child)
    # Written so that nan fails it too
    if not (abs(x) + abs(y) + abs(z) < 1e9 and 0.9 < qx * qx + qy * qy + qz * qz + qw * qw < 1.1):
        numbers = (*position_m, *quaternion_xyzw)
        raise FrameError(f"tf {above!r} from {below!r} is {numbers}; expected finite numbers and a unit quaternion")
    if above == below:
        raise FrameError(f"tf {above!r} from {below!r}: a frame below itself")
    return above, below, (x, y, z, qx, qy, qz, qw)
