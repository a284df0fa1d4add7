"""What a sweep of the arm says about the camera, its place in the hand, and its stamps; refined on request."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np

from fieldkit.cameras import Camera
from fieldkit.checks.handeye import SweepFit, fit_sweep
from fieldkit.checks.parameters import changed, refinable
from fieldkit.checks.sweep_problem import CAMERA, HAND, LATENCY
from fieldkit.checks.sweeps import Sweep
from fieldkit.errors import TagError
from fieldkit.frames import Array, Pose, exp

SIGMAS = 3.0
# An error of the tags' size that matters
SIZE_PERCENT = 1.0
FOCAL, CENTRE = 7, (9, 10)


@dataclasses.dataclass(frozen=True)
class Finding:
    """One number beside its stated value: deviation and sigma in ``unit``, and the verdict.

    "pass": within so many sigmas. "warn": beyond, by less than ``tolerance``. "fail": beyond, by more. "unknown": the
    sweep does not show it, its sigma exceeds ``tolerance``.
    """

    name: str
    group: str
    unit: str
    deviation: float
    sigma: float
    tolerance: float
    verdict: Literal["pass", "warn", "fail", "unknown"]

    @property
    def sigmas(self) -> float:
        """Deviation in standard deviations."""
        return self.deviation / self.sigma if self.sigma else 0.0


@dataclasses.dataclass(frozen=True)
class ArmCheck:
    """All findings of a sweep, and the fit that they rest on."""

    sweep: Sweep
    fit: SweepFit
    findings: tuple[Finding, ...]

    @property
    def verdict(self) -> Literal["pass", "warn", "fail", "unknown"]:
        """The worst verdict among what the sweep shows; unknown where it shows nothing."""
        verdicts = {f.verdict for f in self.findings}
        return next((v for v in ("fail", "warn", "pass") if v in verdicts), "unknown")


@dataclasses.dataclass(frozen=True)
class Refined:
    """Camera and hand_from_cam as the sweep shows them, hand_from_cam with its 6x6 covariance.

    ``kept`` names what keeps its stated value, since the sweep does not show it. ``hand_from_cam`` is None where tf
    has no fixed transform to the camera. ``latency`` is by how much (s) stamps are late, and its sigma; None where the
    sweep does not show it.
    """

    camera: Camera
    hand_from_cam: Pose | None
    covariance: Array
    rms_px: float
    kept: tuple[str, ...]
    latency: tuple[float, float] | None = None


def check_arm(sweep: Sweep, *, sigmas: float = SIGMAS) -> ArmCheck:
    """Fit a sweep and compare camera, hand_from_cam and stamps with what is stated.

    A deviation counts from ``sigmas`` standard deviations. Raises TagError where the sweep determines nothing.
    """
    fit = fit_sweep(sweep)
    findings = []
    for i, p in enumerate(fit.parameters):
        deviation, sigma = float(fit.values[i]), fit.sigma(i)
        verdict: Literal["pass", "warn", "fail", "unknown"] = "pass"
        if sigma > p.tolerance:
            verdict = "unknown"
        elif abs(deviation) > sigmas * sigma:
            verdict = "fail" if abs(deviation) > p.tolerance else "warn"
        f = p.factor
        findings.append(Finding(p.name, p.group, p.unit, f * deviation, f * sigma, f * p.tolerance, verdict))
    size, sigma = (100 * v for v in fit.size)
    told: Literal["pass", "warn", "fail", "unknown"] = "pass"
    if sigma > SIZE_PERCENT:
        told = "unknown"
    elif abs(size) > sigmas * sigma:
        told = "fail" if abs(size) > SIZE_PERCENT else "warn"
    findings.append(Finding("size of the tags", "tags", "%", size, sigma, SIZE_PERCENT, told))
    return ArmCheck(sweep, fit, tuple(findings))


def refine_arm(check: ArmCheck, *, what: Literal["camera", "hand"]) -> Refined:
    """Return camera and hand_from_cam as the sweep shows them, fitted together.

    What of the camera the sweep does not show keeps its stated value, and the rest is fitted again. Raises TagError
    where it does not show what is to be refined: of the camera focal length and centre, of the hand all six numbers.
    """
    kept, covariance = _what_shows(check.fit)
    needed = range(*HAND.indices(len(covariance))) if what == "hand" else (FOCAL, *CENTRE)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    hidden = [p for i, p in enumerate(check.fit.parameters) if i in needed and (i in kept or sigma[i] > p.tolerance)]
    if hidden:
        known = {p.name: p.factor * check.fit.sigma(i) for i, p in enumerate(check.fit.parameters)}
        listed = ", ".join(
            f"{p.name} (known to {known[p.name]:.3g} {p.unit} only, {p.factor * p.tolerance:.3g} matter)"
            for p in hidden
        )
        raise TagError(
            f"{check.sweep.path}: the sweep does not show {listed}; expected it to, to refine the {what}",
            hint="turn the hand about several axes, and let the tag wander all over the image",
        )
    mount = check.sweep.kinematics.mount
    if what == "hand" and mount is None:
        raise TagError(
            f"{check.sweep.path}: tf moves the camera itself, in {check.sweep.kinematics.steps[-1][0]!r}; expected a "
            "fixed transform from the hand to refine",
            hint="record the camera's transform on tf_static",
        )
    fit = fit_sweep(check.sweep, fixed=kept) if kept else check.fit
    camera = changed(refinable(check.sweep.camera), fit.values[CAMERA])
    names = tuple(fit.parameters[i].name for i in sorted(kept))
    hand = None if mount is None else mount[1] * exp(fit.values[HAND])
    late = (float(fit.values[LATENCY]), fit.sigma(LATENCY))
    shown = late if late[1] <= fit.parameters[LATENCY].tolerance else None
    return Refined(camera, hand, fit.covariance[HAND, HAND], fit.rms_px[1], names, shown)


def _what_shows(fit: SweepFit) -> tuple[frozenset[int], Array]:
    """Fix what of the camera does not show, the least of it first; return what that is, and the covariance then.

    With a value fixed the others' covariance is the conditional one.
    """
    tolerance = np.array([p.tolerance for p in fit.parameters])
    cameras = np.arange(*CAMERA.indices(len(tolerance)))
    covariance, kept = fit.covariance.copy(), frozenset[int]()
    while True:
        excess = np.sqrt(np.maximum(np.diag(covariance), 0.0)) / tolerance
        worst = int(cameras[np.argmax(excess[cameras])])
        if excess[worst] <= 1.0:
            return kept, covariance
        column = covariance[:, worst].copy()
        covariance -= np.outer(column, column) / column[worst]
        covariance[worst], covariance[:, worst] = 0.0, 0.0
        kept |= {worst}
