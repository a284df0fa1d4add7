"""A tree of static and moving transforms that is asked for one transform at one time; no ROS needed."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fieldkit.errors import FrameError
from fieldkit.frames import Pose, interpolate


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


def _pose(row: Sequence[float] | NDArray[np.float64]) -> Pose:
    return Pose.from_components(np.asarray(row[:3]), Rotation.from_quat(np.asarray(row[3:])))


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

    def lookup(self, target: str, source: str, *, t_ns: int) -> Pose:
        """Return target_from_source at a time, interpolated between samples.

        Raises FrameError that names the frames when they are not connected, when the time lies before the first or
        after the last sample of a transform on the way, or in a gap longer than ``max_gap_ns``.
        """
        target, source = clean_frame(target), clean_frame(source)
        up_source, up_target = self._ancestors(source, t_ns), self._ancestors(target, t_ns)
        common = next((frame for frame in up_source if frame in up_target), None)
        if common is None:
            known = ", ".join(self.frames[:12]) + (", ..." if len(self.frames) > 12 else "")
            raise FrameError(
                f"tf does not connect {source!r} (below {up_source[-1]!r}) with {target!r} (below {up_target[-1]!r}); "
                f"frames: {known or 'none'}"
            )
        common_from_source = self._climb(up_source[: up_source.index(common) + 1], t_ns)
        common_from_target = self._climb(up_target[: up_target.index(common) + 1], t_ns)
        return common_from_target.inv() * common_from_source

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

    def _climb(self, chain: list[str], t_ns: int) -> Pose:
        result = Pose.identity()
        for child, parent in itertools.pairwise(chain):
            result = self._sample(parent, child, t_ns) * result
        return result

    def _sample(self, parent: str, child: str, t_ns: int) -> Pose:
        track = self._moving.get(child, {}).get(parent)
        if track is None:
            return _pose(self._static[child][1])
        stamps, rows = track.ordered()
        right = int(np.searchsorted(stamps, t_ns))
        if right < len(stamps) and stamps[right] == t_ns:
            return _pose(rows[right])
        what = f"tf {parent!r} from {child!r} at {t_ns / 1e9:.3f} s"
        if right in (0, len(stamps)):
            span = f"{stamps[0] / 1e9:.3f} .. {stamps[-1] / 1e9:.3f} s"
            raise FrameError(f"{what}: outside of its samples {span}; it is never extrapolated")
        t0, t1 = int(stamps[right - 1]), int(stamps[right])
        if t1 - t0 > self.max_gap_ns:
            raise FrameError(f"{what}: in a gap of {(t1 - t0) / 1e9:.2f} s; at most {self.max_gap_ns / 1e9:.2f} s")
        return interpolate(_pose(rows[right - 1]), _pose(rows[right]), (t_ns - t0) / (t1 - t0))


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
