"""What a sweep of the arm says about the camera, its place in the hand, and its stamps; refined on request."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np

from fieldkit.cameras import Camera
from fieldkit.checks.handeye import SweepFit, fit_sweep
from fieldkit.checks.parameters import changed, refinable, require_positive
from fieldkit.checks.sweep_problem import CAMERA, GRID, HAND, LATENCY
from fieldkit.checks.sweeps import Sweep
from fieldkit.errors import TagError
from fieldkit.frames import Array, Pose, exp

Verdict = Literal["pass", "warn", "fail", "unknown"]
SIGMAS = 3.0
# An error of the tags' size that matters
SIZE_PERCENT = 1.0
FOCAL, CENTRE = 7, (9, 10)
# What remains exceeds the noise that was found by more than unmodelled corners of a sound recording do; and so large a
# share of its sightings fits the others
EXCESS, LEAST_USED = 3.0, 0.5
CONTRADICTION_HINT = "check size_m of the tags, tf and the camera, and that no tag moved"


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
    verdict: Verdict

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
    def contradiction(self) -> str | None:
        """What is wrong with the recording as a whole, where no arm and no values of all this explain it."""
        return _contradiction(self.fit)

    @property
    def verdict(self) -> Verdict:
        """The worst verdict among what the sweep shows; unknown where it shows nothing."""
        if self.contradiction is not None:
            return "fail"
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

    A deviation counts from ``sigmas`` standard deviations. Raises TagError where the sweep determines nothing, or for
    ``sigmas`` that are no number above 0.
    """
    require_positive("--sigmas", sigmas)
    fit = fit_sweep(sweep)
    findings = []
    for i, p in enumerate(fit.parameters):
        deviation, sigma, f = float(fit.values[i]), fit.sigma(i), p.factor
        verdict = "unknown" if sigma > p.tolerance else _verdict(deviation, sigma, p.tolerance, sigmas)
        findings.append(Finding(p.name, p.group, p.unit, f * deviation, f * sigma, f * p.tolerance, verdict))
    size, sigma = (100 * v for v in fit.size)
    told = _verdict(size, sigma, SIZE_PERCENT, sigmas)
    # A size that the fit could not take as stated is never passed over
    told = "unknown" if told != "fail" and sigma > SIZE_PERCENT else told
    findings.append(Finding("size of the tags", "tags", "%", size, sigma, SIZE_PERCENT, told))
    return ArmCheck(sweep, fit, tuple(findings))


def _verdict(deviation: float, sigma: float, tolerance: float, sigmas: float) -> Verdict:
    if abs(deviation) <= sigmas * sigma:
        return "pass"
    return "fail" if abs(deviation) > tolerance else "warn"


def _contradiction(fit: SweepFit) -> str | None:
    """Say where a fit ends beyond what arm, stamps and blur may be; None where it does not."""
    noise, ends = fit.noise, []
    if noise.arm >= GRID["arm"][-1]:
        ends.append(f"the arm needs {noise.arm:g} times its noise or more")
    if noise.jitter_s >= GRID["jitter_s"][-1]:
        ends.append(f"stamps jitter by {1e3 * noise.jitter_s:g} ms or more")
    if noise.blur_s >= GRID["blur_s"][-1]:
        ends.append(f"corners err by {1e3 * noise.blur_s:g} ms of their motion or more")
    if noise.corner_px >= GRID["corner_px"][-1]:
        ends.append(f"corners err by {noise.corner_px:g} px or more")
    if fit.excess > EXCESS:
        ends.append(f"what remains is {fit.excess:.1f} times all noise")
    if fit.used.mean() < LEAST_USED:
        ends.append(f"{int((~fit.used).sum())} of {len(fit.used)} sightings fit no others")
    if not ends:
        return None
    return (
        f"the recording contradicts itself beyond any arm's noise: {', '.join(ends)}; expected every tag at one place "
        "in all images of a stand"
    )


def refine_arm(check: ArmCheck, *, what: Literal["camera", "hand"]) -> Refined:
    """Return camera and hand_from_cam as the sweep shows them, fitted together.

    What of the camera the sweep does not show keeps its stated value, and the rest is fitted again. Raises TagError
    where it does not show what is to be refined: of the camera focal length and centre, of the hand all six numbers.
    """
    if check.contradiction is not None:
        raise TagError(f"{check.sweep.path}: {check.contradiction}, to refine the {what}", hint=CONTRADICTION_HINT)
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
