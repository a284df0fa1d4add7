"""CSV tables of poses, covariances and numbers that read back to the same bits."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import FieldkitError, StoreError
from fieldkit.frames import Pose, pose
from fieldkit.store.files import atomic_write, read_text

Row = Mapping[str, str]
R = TypeVar("R")
POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
COVARIANCE = tuple(f"c{i}{j}" for i in range(6) for j in range(6))


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, object]]) -> None:
    """Write a CSV table; missing and None cells are empty, floats keep every bit (repr)."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow([_cell(row.get(c)) for c in columns])
    atomic_write(path, text.getvalue())


def read_table(path: Path, columns: Sequence[str], parse: Callable[[Row], R]) -> list[R]:
    """Read a CSV table row by row; raises StoreError with the line of what is wrong."""
    reader = csv.DictReader(io.StringIO(read_text(path, what="a table of a run folder")))
    missing = [c for c in columns if c not in (reader.fieldnames or [])]
    if missing:
        raise StoreError(f"{path}: lacks the columns {', '.join(missing)}", hint="replay the recording again")
    result = []
    for row in reader:
        try:
            if None in row.values():
                raise ValueError("the line is cut off")
            result.append(parse(row))
        except (ValueError, TypeError, FieldkitError) as error:
            raise StoreError(f"{path}: line {reader.line_num}: {error}", hint="replay the recording again") from error
    return result


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    return repr(float(value)) if isinstance(value, float | np.floating) else str(value)


def pose_cells(a_from_b: Pose | None, *, prefix: str = "") -> dict[str, object]:
    """Return the seven cells of a pose; empty for None. The quaternion is written as it is, to keep every bit."""
    if a_from_b is None:
        return {}
    values = [*a_from_b.translation, *a_from_b.rotation.as_quat()]
    return {prefix + name: float(v) for name, v in zip(POSE, values, strict=True)}


def pose_of(row: Row, *, prefix: str = "") -> Pose | None:
    """Read the seven cells of a pose; None when they are empty."""
    if row[prefix + POSE[0]] == "":
        return None
    values = [float(row[prefix + name]) for name in POSE]
    return pose(values[:3], values[3:])


def needed_pose(row: Row, *, prefix: str = "") -> Pose:
    """Read the seven cells of a pose that must be there."""
    result = pose_of(row, prefix=prefix)
    if result is None:
        raise StoreError("the pose is missing")
    return result


def covariance_cells(covariance: NDArray[np.float64] | None) -> dict[str, object]:
    """Return the 36 cells of a covariance; empty for None."""
    if covariance is None:
        return {}
    return {name: float(v) for name, v in zip(COVARIANCE, covariance.ravel(), strict=True)}


def covariance_of(row: Row) -> NDArray[np.float64] | None:
    """Read the 36 cells of a covariance; None when they are empty."""
    if row[COVARIANCE[0]] == "":
        return None
    return np.array([float(row[name]) for name in COVARIANCE]).reshape(6, 6)


def optional_bool(cell: str) -> bool | None:
    """Read true, false or an empty cell."""
    if cell not in ("", "true", "false"):
        raise ValueError(f"{cell!r}; expected true, false or nothing")
    return None if cell == "" else cell == "true"
