"""The command that checks tags, and what sees them, with what a lab has."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from tyro.conf import Positional
from tyro.conf import UseAppendAction as Repeated

from fieldkit.console import ProgressBars, cells, make_table, print_json
from fieldkit.errors import TagError

if TYPE_CHECKING:
    from fieldkit.checks import ArmCheck, DistanceCheck, Refined, ScaleCheck
    from fieldkit.store import Corrections
    from fieldkit.types import TagMap

# Heavy rooms are imported inside the commands, as in fieldkit.cli

_log = logging.getLogger(__name__)


def tags_check(
    tags: Positional[Path],
    *,
    distance: Repeated[tuple[tuple[str, str, float], ...]] = (),
    tape_sigma_m: float = 0.002,
    recording: Path | None = None,
    camera: Path | None = None,
    hand: Path | None = None,
    layout: str | None = None,
    size_m: Repeated[tuple[str, ...]] = (),
    sigmas: float = 3.0,
    refine_camera: Path | None = None,
    refine_hand: Path | None = None,
    json: bool = False,
    force: bool = False,
) -> int:
    """Check tags with a tape measure, or camera, hand and stamps with the tags; exit with 3 when a check fails.

    Args:
        tags: tags.toml
        distance: two tags (3, or 3@w02 for its place at a visit) and the metres between their centres; may be repeated
        tape_sigma_m: standard deviation of the tape measure in m
        recording: bag or session folder in which the arm camera sees tags from many poses while the robot stands
        camera: camera.toml to check in place of what the recording states
        hand: hand.toml to check in place of what the recording states
        layout: names of topics and frames of the recording; found by itself when not given
        size_m: edge length in m of tags that tags.toml lacks, or ID:SIZE for one tag; may be repeated
        sigmas: a deviation from what is stated counts from so many standard deviations
        refine_camera: camera.toml to write: the arm camera as the recording shows it
        refine_hand: hand.toml to write: the camera in the hand as the recording shows it
        json: print JSON
        force: replace existing files
    """
    from fieldkit import store
    from fieldkit.checks import require_positive
    from fieldkit.tags import check_families

    require_positive("--sigmas", sigmas)
    require_positive("--tape-sigma-m", tape_sigma_m)
    outputs = [path for path in (refine_camera, refine_hand) if path is not None]
    for path in outputs:
        store.refuse_existing(path, force=force, kind="file")
    loaded = store.read_tags(tags)
    check_families(loaded)
    of_arm = bool(outputs) or camera is not None or hand is not None
    if recording is None and (of_arm or not distance):
        raise _nothing_to_check(tags, "--recording" if of_arm else "--distance A B METRES or --recording")
    given = store.read_corrections(camera=camera, hand=hand)
    report: dict[str, Any] = {"version": 1}
    verdicts: list[str] = []
    if distance:
        checks, scale = _distances(loaded, distance, tape_sigma_m=tape_sigma_m)
        report |= _distances_json(checks, scale)
        verdicts += [scale.verdict, *(c.verdict for c in checks)]
        if not json:
            _print_distances(checks, scale)
    if recording is not None:
        found = _check_arm(loaded, recording, given=given, layout=layout, sizes=size_m, sigmas=sigmas)
        report["arm"] = _arm_json(found)
        verdicts.append(found.verdict)
        if not json:
            _print_arm(found)
        _refine(found, given, camera=refine_camera, hand=refine_hand)
    if json:
        print_json(report)
    return 3 if "fail" in verdicts else 0


def _nothing_to_check(tags: Path, expected: str) -> TagError:
    hint = "measure between two tags, or record a sweep of the arm over one"
    return TagError(f"{tags}: nothing to check; expected {expected}", hint=hint)


def _check_arm(
    tags: TagMap,
    recording: Path,
    *,
    given: Corrections,
    layout: str | None,
    sizes: tuple[str, ...],
    sigmas: float,
) -> ArmCheck:
    from fieldkit.bags import open_arm
    from fieldkit.calibrate import parse_sizes
    from fieldkit.checks import check_arm, find_sweep

    sizes_m: dict[int | None, float] = {t.id: t.size_m for t in tags.tags}
    sizes_m |= parse_sizes(sizes) if sizes else {}
    opened = open_arm(recording, layout=layout, corrections=given)
    for warning in opened.warnings:
        _log.warning("%s: %s", recording, warning)
    with ProgressBars() as progress:
        families = tuple(dict.fromkeys(t.family for t in tags.tags)) or ("tag36h11",)
        sweep = find_sweep(opened, sizes_m, families=families, progress=progress)
    for why, count in sweep.left_out.items():
        _log.info("%s: left out %d images or sightings %s", recording, count, why)
    return check_arm(sweep, sigmas=sigmas)


def _refine(found: ArmCheck, given: Corrections, *, camera: Path | None, hand: Path | None) -> None:
    """Write what is to be refined; both are fitted before either is written."""
    from fieldkit import store
    from fieldkit.checks import refine_arm

    cameras = None if camera is None else refine_arm(found, what="camera")
    hands = None if hand is None else refine_arm(found, what="hand")
    refined = cameras or hands
    if refined is not None and refined.kept:
        _log.warning("%s: not shown, as stated: %s", found.sweep.path, ", ".join(refined.kept))
    if camera is not None and cameras is not None:
        store.write_camera(camera, cameras.camera, rms_px=cameras.rms_px)
        _log.info("wrote %s", camera)
    if hand is not None and hands is not None and hands.hand_from_cam is not None:
        kinematics = found.sweep.kinematics
        assert kinematics.mount is not None
        frames = (kinematics.mount[0], kinematics.camera_frame)
        latency = _total_latency(given, hands)
        store.write_hand(hand, store.Hand(*frames, hands.hand_from_cam, hands.covariance, latency))
        _log.info("wrote %s", hand)
    for group, path in (("camera", camera), ("hand", hand)):
        off = [f.name for f in found.findings if f.group == group and f.verdict in ("warn", "fail")]
        if refined is not None and path is None and off:
            _log.warning(
                "%s: %s differs too (%s): what was refined belongs to a refined %s; give --refine-%s, too",
                found.sweep.path, group, ", ".join(off), group, group,
            )  # fmt: skip


def _total_latency(given: Corrections, refined: Refined) -> tuple[float, float] | None:
    """Return by how much stamps are late in all: what was given, and what was found beyond it, where that is shown."""
    known = None if given.hand is None else given.hand.latency
    if refined.latency is None:
        return known
    return refined.latency[0] + given.late_ns / 1e9, refined.latency[1]


def _print_arm(found: ArmCheck) -> None:
    from fieldkit.checks import CONTRADICTION_HINT

    fit, sweep = found.fit, found.sweep
    title = (
        f"{sweep.path}: {int(fit.used.sum())} of {len(sweep)} sightings in {len(sweep.stands)} stands; residuals "
        f"{fit.rms_px[0]:.2f} px as stated, {fit.rms_px[1]:.2f} px as found"
    )
    table = make_table("what", "deviation", "sigma", "sigmas", "matters from", "unit", "verdict", title=title)
    for f in found.findings:
        digits = "{:+.4f}" if not f.unit else "{:+.2f}"
        numbers = [digits.format(f.deviation), digits.format(f.sigma)[1:], f"{f.sigmas:+.1f}", f"{f.tolerance:.3g}"]
        verdict = "not observed" if f.verdict == "unknown" else f.verdict
        table.add_row(
            *cells([f.name, *(["-"] * 3 if f.verdict == "unknown" else numbers[:3]), numbers[3], f.unit, verdict])
        )
    console = Console(width=max(120, Console().width))
    console.print(table)
    noise = fit.noise
    words = (
        f"arm {noise.arm:g} times 0.2 deg and 2 mm, time {1e3 * noise.jitter_s:g} ms, blur {1e3 * noise.blur_s:g} ms"
    )
    words += f", corners {noise.corner_px:g} px more than stated" if noise.corner_px else ""
    if found.contradiction is not None:
        console.print(f"{found.contradiction}; {CONTRADICTION_HINT}", markup=False)
    console.print(f"noise shown: {words}; verdict: {found.verdict}", markup=False)


def _arm_json(found: ArmCheck) -> dict[str, Any]:
    fit, kinematics = found.fit, found.sweep.kinematics
    rows = [
        {
            "name": f.name,
            "of": f.group,
            "unit": f.unit,
            "deviation": f.deviation,
            "sigma": f.sigma,
            "sigmas": f.sigmas,
            "tolerance": f.tolerance,
            "verdict": f.verdict,
        }
        for f in found.findings
    ]
    return {
        "recording": found.sweep.path,
        "verdict": found.verdict,
        "n_sightings": len(found.sweep),
        "n_used": int(fit.used.sum()),
        "n_stands": len(found.sweep.stands),
        "rms_px": {"stated": fit.rms_px[0], "found": fit.rms_px[1]},
        "noise": dataclasses.asdict(fit.noise),
        "contradiction": found.contradiction,
        "frames": {"body": kinematics.body_frame, "camera": kinematics.camera_frame},
        "left_out": dict(found.sweep.left_out),
        "findings": rows,
    }


def _distances(
    tags: TagMap, distances: tuple[tuple[str, str, float], ...], *, tape_sigma_m: float
) -> tuple[tuple[DistanceCheck, ...], ScaleCheck]:
    from fieldkit.checks import Tape, check_distances, parse_tag

    tapes = [Tape(parse_tag(a), parse_tag(b), metres) for a, b, metres in distances]
    return check_distances(tags, tapes, tape_sigma_m=tape_sigma_m)


def _print_distances(checks: tuple[DistanceCheck, ...], scale: ScaleCheck) -> None:
    table = make_table("tags", "tape m", "map m", "difference mm", "sigma mm", "%", "sigma %", "verdict", "why")
    for c in checks:
        names = f"{c.tape.a} to {c.tape.b}"
        lengths = [f"{c.tape.measured_m:.3f}", f"{c.map_m:.4f}"]
        millimetres = [f"{1e3 * c.difference_m:+.1f}", f"{1e3 * c.sigma_m:.1f}"]
        shares = [f"{100 * c.share:+.2f}", f"{100 * c.sigma_share:.2f}"]
        table.add_row(*cells([names, *lengths, *millimetres, *shares, c.verdict, c.reason]))
    console = Console(width=max(120, Console().width))
    console.print(table)
    spread = f"; the distances differ from one scale by {scale.sigmas:.1f} sigma" if len(checks) > 1 else ""
    words = f"{100 * scale.error:+.2f} % (sigma {100 * scale.sigma:.2f} %){spread}"
    console.print(f"scale error of the map that this would mean: {words}: {scale.verdict}", markup=False)


def _distances_json(checks: tuple[DistanceCheck, ...], scale: ScaleCheck) -> dict[str, Any]:
    rows = [
        {
            "a": str(c.tape.a),
            "b": str(c.tape.b),
            "tape_m": c.tape.measured_m,
            "map_m": c.map_m,
            "difference_m": c.difference_m,
            "sigma_m": c.sigma_m,
            "difference_percent": 100 * c.share,
            "sigma_percent": 100 * c.sigma_share,
            "verdict": c.verdict,
            "reason": c.reason,
        }
        for c in checks
    ]
    whole = {
        "error_percent": 100 * scale.error,
        "sigma_percent": 100 * scale.sigma,
        "spread_sigmas": scale.sigmas,
        "verdict": scale.verdict,
    }
    return {"distances": rows, "scale": whole}
