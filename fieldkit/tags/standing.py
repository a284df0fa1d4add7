"""Where a standing robot's body and cameras are in the map: all sightings of known tags as one least-squares problem.

Unknown are the body at the reference, the error of the camera in the hand, which all images share, the steps that the
body made between its stands, and the tags, each with its own covariance as prior. The noise of the arm that is anew in
every image is eliminated into the weights.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2 as chi2_law

from fieldkit.errors import TagError
from fieldkit.frames import Array, Pose, adjoint, log
from fieldkit.protocol import ArmNoise
from fieldkit.tags.fusion import SCALES, Sighting, TagFix, fuse_sightings
from fieldkit.tags.joint import Part, Problem, State, by_steps, by_unknowns, diagonal, image_covariance
from fieldkit.tags.sightings import BodySighting, BodySightings, Place
from fieldkit.tags.tilting import Belief, Other, believe, tilt
from fieldkit.types import TagPose

# Another tag joins in unless it contradicts the named one beyond one in ten thousand (6 degrees of freedom)
AGREES = float(chi2_law.ppf(0.9999, 6))
# Residuals widen the covariance where they exceed their noise beyond one in a hundred
WIDEN = 0.99


@dataclasses.dataclass(frozen=True)
class BodyFix:
    """The body in the map at ``t_ns``, and what is needed to place the cameras of the same visit.

    ``covariance`` is that of map_from_body. ``belief`` has the unknowns: map_from_body as the cameras see it, the
    shared error of the camera, the steps. ``scale`` multiplies the arm's stated noise per image, ``used`` counts the
    sightings per tag id, ``left_out`` names tags that contradict the named one, ``rms_sigma`` is
    the root mean square of what remains, in standard deviations.
    """

    t_ns: int
    map_from_body: Pose
    covariance: Array
    belief: Belief
    steps: tuple[Pose, ...]
    scale: float
    used: dict[int, int]
    left_out: tuple[str, ...]
    rms_sigma: float
    image_covariance: Array

    def map_from_cam(self, place: Place) -> tuple[Pose, Array]:
        """Return the true camera pose of a placed frame and its 6x6 covariance."""
        belief = self.belief
        moved = belief.step_errors.reshape(len(belief.weights), -1) @ by_steps(place, self.steps).T
        body = belief.map_from_body * place.ref_from_body * _exps(moved)
        cam, spread = belief.moments(body * place.body_from_cam * _exps(belief.shared))
        by_unknown = by_unknowns(place, self.steps)
        covariance = by_unknown @ belief.joint @ by_unknown.T + spread + self.scale**2 * self.image_covariance
        return cam, (covariance + covariance.T) / 2


def hand_covariance(arm: ArmNoise) -> Array:
    """Return the 6x6 covariance of body_from_cam as a whole at the camera: per image, shared, and the arm's base."""
    return image_covariance(arm) + diagonal(arm.camera_deg, arm.camera_m) + diagonal(arm.base_deg, arm.base_m)


def locate_body(found: BodySightings, tag: TagPose, *, arm: ArmNoise, others: Sequence[TagPose] = ()) -> BodyFix:
    """Locate the body from sightings of a tag, and of others that agree with it.

    Consensus and planar solutions come from `fuse_sightings` of each tag; where the sightings leave both solutions
    open, the one with the more upright body is taken: the map's z and the body's both point up on a standing robot. No
    prior takes part. Raises TagError when the tag is not seen, there is no solution, or four or more sightings need
    the largest noise of the arm that is allowed: a wrong tag size or wrong kinematics shifts all of them.
    """
    seen = found.of(tag)
    if not seen:
        raise TagError(f"tag {tag.id} ({tag.family}) is never seen: {found.explanation}")
    main, map_from_body, flipped = _alone(found, seen, tag, arm)
    left_out, joined, first = [], [main], None
    for other in others:
        more = found.of(other)
        if not more or other.id == tag.id:
            continue
        try:
            part, its_body, _ = _alone(found, more, other, arm)
        except TagError as error:
            left_out.append(f"tag {other.id}: {error.message}")
            continue
        first = first or _solve(found, [main], map_from_body, arm)
        apart = _apart(first, _solve(found, [part], its_body, arm))
        if apart > AGREES:
            left_out.append(f"tag {other.id} contradicts tag {tag.id} by {math.sqrt(apart):.0f} sigma")
        else:
            joined.append(part)
    # Tags that agree have decided between the planar solutions
    flipped = flipped if len(joined) == 1 else None
    return _solve(found, joined, map_from_body, arm, flipped=flipped, left_out=tuple(left_out))


def _alone(
    found: BodySightings, seen: Sequence[BodySighting], tag: TagPose, arm: ArmNoise
) -> tuple[Part, Pose, Other | None]:
    """Return the sightings of one tag that agree, the body that they show by themselves, and a flip's if it is open."""
    total, stands = image_covariance(arm), [s.place.stand for s in seen]
    home = max(sorted(set(stands), reverse=True), key=stands.count)
    sightings = [
        Sighting(s.detection, s.place.frame.camera, s.place.ref_from_cam, total + _step_noise(s.place, found, home))
        for s in seen
    ]
    fix = fuse_sightings(sightings, tag.size_m)
    if len(sightings) >= 4 and fix.scale >= max(SCALES):
        raise TagError(
            f"the {len(sightings)} sightings of tag {tag.id} disagree with kinematics by about {max(SCALES):g} times "
            "their stated noise or more; expected one place of the tag in all of them",
            hint="check size_m of the tag, camera_info and tf",
        )
    used = tuple(s for s, u in zip(seen, fix.used, strict=True) if u)
    chosen = body_in_map(fix, tag)
    flipped = None
    if not fix.is_certain and fix.alternative is not None:
        bodies = [tag.map_from_tag * o.inv() for o in (fix.ref_from_tag, fix.alternative)]
        first = int(tilt(bodies[1]) < tilt(bodies[0]))
        flipped = Other(bodies[1 - first], (1 - 2 * first) * fix.evidence, fix.repeated > 1)
    return Part(tag, used), chosen, flipped


def body_in_map(fix: TagFix, tag: TagPose) -> Pose:
    """Return map_from_body from the tag relative to the body and the tag in the map.

    Where the sightings leave both planar solutions open, the one with the more upright body is taken. No odometry and
    no prior takes part in the choice.
    """
    options = [fix.ref_from_tag]
    if not fix.is_certain and fix.alternative is not None:
        options.append(fix.alternative)
    return min((tag.map_from_tag * o.inv() for o in options), key=tilt)


def _step_noise(place: Place, found: BodySightings, home: int) -> Array:
    """Return the 6x6 covariance of a camera's place by the steps between it and the stand from which most is seen."""
    total = np.zeros((6, 6))
    cam_from_ref = place.ref_from_cam.inv()
    for ref_from_begin, covariance in found.steps[min(place.stand, home) : max(place.stand, home)]:
        effect = adjoint(cam_from_ref * ref_from_begin)
        total += effect @ covariance @ effect.T
    return total


def _apart(one: BodyFix, other: BodyFix) -> float:
    delta = log(one.map_from_body.inv() * other.map_from_body)
    return float(delta @ np.linalg.solve(one.covariance + other.covariance, delta))


def _solve(
    found: BodySightings,
    parts: Sequence[Part],
    map_from_body: Pose,
    arm: ArmNoise,
    *,
    flipped: Other | None = None,
    left_out: tuple[str, ...] = (),
) -> BodyFix:
    problem = Problem(found, parts, arm)
    n = len(problem)
    freedom = 8 * n - 6
    try:
        state, scale = problem.start(map_from_body), 1.0
        for _ in range(2 if n >= 4 else 1):
            state, normal, total, _ = problem.minimise(state, scale)
            if n >= 4:
                scale = min(SCALES, key=lambda s: (_unlikely(problem, state, s), s))
        state, normal, total, _ = problem.minimise(state, scale)
        factor = total / freedom if total > chi2_law.ppf(WIDEN, freedom) else 1.0
        belief = believe(problem, state, scale, normal=normal, factor=factor, other=flipped)
    except np.linalg.LinAlgError as error:
        ids = ", ".join(str(p.tag.id) for p in parts)
        raise TagError(
            f"the {n} sightings of tag {ids} determine no pose ({error}); expected the corners of "
            "squares of the given sizes",
            hint="check size_m of the tag and the camera's calibration",
        ) from error
    mean, spread = belief.moments(belief.map_from_body)
    return BodyFix(
        found.t_ns,
        mean,
        belief.joint[:6, :6] + spread + diagonal(arm.base_deg, arm.base_m),
        belief,
        problem.steps,
        scale,
        {part.tag.id: len(part.sightings) for part in parts},
        left_out,
        math.sqrt(total / (8 * n)),
        problem.image,
    )


def _exps(deltas: Array) -> Pose:
    return Pose.from_components(deltas[:, 3:], Rotation.from_rotvec(deltas[:, :3]))


def _unlikely(problem: Problem, state: State, scale: float) -> float:
    """Return twice the negative restricted log likelihood of a scale of the arm's noise, up to a constant.

    The state is that of another scale: what a Newton step from it gains is taken off.
    """
    normal, gradient, total, logdet = problem.normal(state, scale)
    gain = float(gradient @ np.linalg.solve(normal, gradient))
    return total - gain + logdet + float(np.linalg.slogdet(normal)[1])
