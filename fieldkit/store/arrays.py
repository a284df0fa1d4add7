"""The arrays of a run folder: utilities of candidates, reasons of learned scores, and the map from above."""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote, unquote

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import StoreError
from fieldkit.protocol import Protocol
from fieldkit.store.files import atomic_write
from fieldkit.types import Array, PlanView, Reason, VisitPlan

T = TypeVar("T")
Variant = tuple[str, bool | None]
# What is known of a visit (session and id) per policy and occlusion
ByVisit = Mapping[tuple[str, str], Mapping[Variant, T]]
UTILITIES_FILE, REASONS_FILE, PLAN_FILE = "utilities.npz", "reasons.npz", "plan.npz"
_AGAIN = "replay the recording again"


@dataclasses.dataclass(frozen=True)
class RunArrays:
    """What a run's .npz files hold, by session and visit, then by policy and occlusion."""

    utilities: ByVisit[Array]
    reasons: ByVisit[Reason]
    plan_view: PlanView


def write_arrays(folder: Path, plans: Sequence[VisitPlan], plan_view: PlanView) -> None:
    """Write utilities.npz, plan.npz, and reasons.npz where there are any."""
    utilities: dict[str, NDArray[Any]] = {}
    reasons: dict[str, NDArray[Any]] = {}
    for plan in plans:
        place = [plan.session, plan.prior.visit]
        for variant, values in plan.utilities.items():
            utilities[json.dumps([*place, *variant])] = values
        for variant, reason in plan.reasons.items():
            rows = np.column_stack([reason.landmarks, reason.raised]).astype(np.float32)
            reasons[json.dumps([*place, *variant, reason.view])] = rows
    contents: dict[str, dict[str, NDArray[Any]]] = {
        UTILITIES_FILE: utilities,
        PLAN_FILE: {"landmarks": plan_view.landmarks, "cameras": plan_view.cameras},
        **({REASONS_FILE: reasons} if reasons else {}),
    }
    for name, content in contents.items():
        # Keys go into the archive as member names: quoted, so that a session's name cannot act as a path.
        stream = io.BytesIO()
        np.savez_compressed(stream, allow_pickle=False, **{quote(k, safe=""): v for k, v in content.items()})
        atomic_write(folder / name, stream.getvalue())


def read_arrays(path: Path) -> RunArrays:
    """Read the arrays of a run folder; raises StoreError where a file is missing or damaged."""
    utilities: dict[tuple[str, str], dict[Variant, Array]] = {}
    reasons: dict[tuple[str, str], dict[Variant, Reason]] = {}
    try:
        with np.load(path / UTILITIES_FILE, allow_pickle=False) as archive:
            for key in archive.files:
                session, visit, policy, occlusion = json.loads(unquote(key))
                utilities.setdefault((session, visit), {})[policy, occlusion] = archive[key]
        if (path / REASONS_FILE).is_file():
            with np.load(path / REASONS_FILE, allow_pickle=False) as archive:
                for key in archive.files:
                    session, visit, policy, occlusion, view = json.loads(unquote(key))
                    rows = archive[key].astype(np.float32, casting="same_kind").reshape(-1, 4)
                    mine = reasons.setdefault((session, visit), {})
                    mine[policy, occlusion] = Reason(view, rows[:, :3], rows[:, 3])
        with np.load(path / PLAN_FILE, allow_pickle=False) as archive:
            return RunArrays(utilities, reasons, PlanView(archive["landmarks"], archive["cameras"]))
    except Exception as error:  # numpy, zip and zlib raise many types for damaged files
        raise StoreError(f"{path}: {UTILITIES_FILE}, {REASONS_FILE} or {PLAN_FILE}: {error}", hint=_AGAIN) from error


def refuse_unfitting(path: Path, arrays: RunArrays, plans: Sequence[VisitPlan], protocol: Protocol) -> None:
    """Raise StoreError where reasons are of another run: visits, policies or views that this one lacks, or no numbers.

    Utilities that reasons are shown with have to be of the visit's candidates.
    """
    by_visit = {(plan.session, plan.prior.visit): plan for plan in plans}
    for place, reasons in arrays.reasons.items():
        for variant, reason in reasons.items():
            wrong = _wrong(by_visit.get(place), variant, reason, protocol)
            if wrong is not None:
                raise StoreError(f"{path / REASONS_FILE}: {'/'.join(map(str, place))}: {wrong}", hint=_AGAIN)


def _wrong(plan: VisitPlan | None, variant: Variant, reason: Reason, protocol: Protocol) -> str | None:
    """Say what of a reason does not fit its run; None where all does."""
    if plan is None:
        return "is no visit of this run; expected one of priors.csv"
    policy, occlusion = variant
    words = f"{policy} {'with' if occlusion else 'without'} occlusion"
    if policy not in protocol.policies or variant not in plan.utilities:
        return f"{words} has no utilities in this run; expected a policy of {UTILITIES_FILE}"
    views = plan.candidates.view_ids
    if reason.view not in views:
        return f"{words}: view {reason.view!r} is no candidate; expected one of candidates.csv"
    if plan.utilities[variant].shape != (len(views),):
        return f"{words}: utilities of shape {plan.utilities[variant].shape}; expected {len(views)}, one per candidate"
    if not (np.isfinite(reason.landmarks).all() and np.isfinite(reason.raised).all()):
        return f"{words}: holds numbers that are not finite; expected landmarks and how much each raised the score"
    return None
