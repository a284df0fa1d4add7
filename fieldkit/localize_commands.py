"""The command that localizes images, of one camera or of a rig."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from rich.console import Console
from tyro.conf import Positional

from fieldkit.console import ProgressBars, cells, make_table, print_json
from fieldkit.errors import LocalizeError

if TYPE_CHECKING:
    from fieldkit.localize import CameraPrior, RigEstimate
    from fieldkit.types import Estimate

# Heavy rooms are imported inside the command, as in fieldkit.cli

_log = logging.getLogger(__name__)
STAGES = ("extract", "retrieve", "match", "pnp")


def localize(
    images: Positional[Path],
    *,
    map: Path,
    out: Path,
    camera: Path | None = None,
    rig: Path | None = None,
    top_k: int = 20,
    matcher: Literal["nearest", "lightglue"] = "nearest",
    min_confidence: float = 0.5,
    weights: Path | None = None,
    prior_poses: Path | None = None,
    prior_sigma_m: float = 0.5,
    prior_sigma_deg: float = 10.0,
    threads: int | None = None,
    json: bool = False,
    force: bool = False,
) -> None:
    """Localize images in a map; write the poses of the camera, or of the rig, as TUM text.

    Args:
        images: image file or folder of images; with --rig a folder with images/<camera>/<frame>.jpg
        map: map folder
        out: poses.txt to write; a failed image has no line
        camera: camera.toml of all images
        rig: rig.toml, for images that several cameras took at once: they make one pose
        top_k: mapping images that are compared with an image; more than the map has is all of them
        matcher: lightglue for the features that have it: more matches, seconds an image
        min_confidence: poses that are less probably right than this are left out
        weights: folder with the weights of the map's feature
        prior_poses: TUM text with where the camera is believed to be, by the image's name
        prior_sigma_m: standard deviation of its position along each axis
        prior_sigma_deg: standard deviation of its rotation about each axis
        threads: images that are localized at the same time; as many as there are processors where not given
        json: print JSON with status, inliers, covariance and seconds per image
        force: replace an existing file
    """
    from fieldkit import maps, protocol, store
    from fieldkit.localize import Localizer
    from fieldkit.localize.files import localize_files, localize_rig_files

    store.refuse_existing(out, force=force, kind="file")
    _refuse_options(camera, rig, prior_poses)
    rules = protocol.localizer_rules(top_k=top_k, matcher=matcher, min_confidence=min_confidence)
    if rig is not None:
        cameras = store.read_rig(rig)
        localizer = Localizer(maps.load_map(map), rules, weights=weights)
        with ProgressBars() as progress:
            frames = localize_rig_files(localizer, images, cameras, threads=threads, progress=progress)
        store.write_tum(out, [(n.replace(" ", "_"), e.map_from_rig) for n, e in frames if e.map_from_rig is not None])
        _report("frame", [(n, e.status, e.n_matches, e.n_inliers, e.seconds) for n, e in frames], None if json else out)
        if json:
            print_json({"version": 1, "frames": [{"name": n, **_rig_json(e)} for n, e in frames]})
        return
    assert camera is not None
    calibration = store.read_camera(camera)
    priors = None if prior_poses is None else _read_priors(prior_poses, prior_sigma_m, prior_sigma_deg)
    localizer = Localizer(maps.load_map(map), rules, weights=weights)
    with ProgressBars() as progress:
        found = localize_files(localizer, images, calibration, priors=priors, threads=threads, progress=progress)
    store.write_tum(out, [(n.replace(" ", "_"), e.map_from_cam) for n, e in found if e.map_from_cam is not None])
    if priors is not None and any(n not in priors for n, _ in found):
        _log.warning("%d of %d images have no prior", sum(n not in priors for n, _ in found), len(found))
    _report("image", [(n, e.status, e.n_matches, e.n_inliers, e.seconds) for n, e in found], None if json else out)
    if json:
        print_json({"version": 1, "images": [{"name": n, **_estimate_json(e)} for n, e in found]})


def _refuse_options(camera: Path | None, rig: Path | None, prior_poses: Path | None) -> None:
    if (camera is None) == (rig is None):
        raise LocalizeError(
            "--camera and --rig: expected one of the two", hint="give camera.toml, or rig.toml for several cameras"
        )
    if rig is not None and prior_poses is not None:
        raise LocalizeError("--prior-poses with --rig: expected it with --camera", hint="leave it out")


def _read_priors(path: Path, sigma_m: float, sigma_deg: float) -> dict[str, CameraPrior]:
    from fieldkit import store
    from fieldkit.localize import CameraPrior

    if not (0.0 < sigma_m < np.inf and 0.0 < sigma_deg < np.inf):
        raise LocalizeError(
            f"--prior-sigma-m {sigma_m:g}, --prior-sigma-deg {sigma_deg:g}: expected more than 0",
            hint="say how far the camera may be from its prior",
        )
    covariance = np.diag([np.radians(sigma_deg) ** 2] * 3 + [sigma_m**2] * 3)
    return {name: CameraPrior(pose, covariance) for name, pose in store.read_tum(path)}


Row = tuple[str, str, int | Mapping[str, int], int | Mapping[str, int], Mapping[str, float]]


def _report(what: str, rows: Sequence[Row], out: Path | None) -> None:
    """Name what failed on stderr; print a table, unless ``out`` is None, with the median time of every stage below."""
    failed = [f"{name} ({status})" for name, status, *_ in rows if status != "ok"]
    if failed:
        _log.warning("%d of %d %ss failed: %s", len(failed), len(rows), what, ", ".join(failed))
    if out is None:
        return
    table = make_table(what, "status", "matches", "inliers", *(f"{s} ms" for s in STAGES))
    for name, status, matches, inliers, seconds in rows:
        counts = [n if isinstance(n, int) else sum(n.values()) for n in (matches, inliers)]
        table.add_row(*cells([name, status, *counts, *(_ms([seconds.get(s)]) for s in STAGES)]))
    table.add_section()
    columns = [[seconds.get(s) for *_, seconds in rows] for s in STAGES]
    table.add_row(*cells(["median", "", "", "", *map(_ms, columns)]))
    Console().print(table)


def _ms(seconds: Sequence[float | None]) -> str:
    known = [s for s in seconds if s is not None]
    return f"{1e3 * float(np.median(known)):.0f}" if known else "-"


def _estimate_json(estimate: Estimate) -> dict[str, Any]:
    return _pose_json(estimate.map_from_cam, estimate)


def _rig_json(estimate: RigEstimate) -> dict[str, Any]:
    return _pose_json(estimate.map_from_rig, estimate)


def _pose_json(found: Any, estimate: Estimate | RigEstimate) -> dict[str, Any]:
    return {
        "status": estimate.status,
        "position_m": None if found is None else found.translation,
        "quaternion_xyzw": None if found is None else found.rotation.as_quat(),
        "matches": estimate.n_matches,
        "inliers": estimate.n_inliers,
        "confidence": estimate.confidence,
        "covariance": None if estimate.covariance is None else estimate.covariance.ravel(),
        "seconds": dict(estimate.seconds),
    }
