"""Evaluation protocols: declarative TOML files, strict about every key."""

from __future__ import annotations

import importlib.resources
import math
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from fieldkit.errors import ProtocolError, suggestion

POLICY_NAMES = (
    "stowed", "forward", "random", "odometry", "max", "angle", "fim", "mlp", "vpt", "vpt_dino", "vpt_appearance",
    "best_possible",
)  # fmt: skip
HEURISTICS = ("max", "angle", "fim")
LEARNED = ("mlp", "vpt", "vpt_dino", "vpt_appearance")
COUNTING = HEURISTICS + LEARNED
Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
Pitch = Annotated[float, msgspec.Meta(ge=-90, le=90)]


class Threshold(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An image counts as localized when both errors are strictly below: position in m, rotation in deg."""

    position_m: Positive
    rotation_deg: Positive


class CandidateRules(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which recorded views ranking policies choose among, and how visibility is computed at them."""

    kinds: Annotated[tuple[Literal["sweep", "stowed", "forward"], ...], msgspec.Meta(min_length=1)] = ("sweep",)
    min_distance_m: Annotated[float, msgspec.Meta(ge=0)] = 0.1
    max_distance_m: Positive = 5.0
    forward_pitch_deg: Pitch = 0.0
    last_forward: Literal["previous", "body"] = "previous"


class OcclusionRules(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """With and without the filter, and how far behind the surface (in voxels) a landmark still counts as visible."""

    use: Annotated[tuple[bool, ...], msgspec.Meta(min_length=1, max_length=2)] = (False, True)
    tolerance_voxels: Positive = 2.0


class LocalizerRules(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the localizer: global retrieval, matching, PnP, and the confidence below which a pose is none.

    ``top_k`` mapping images are retrieved; more than there are, as 1,000,000, is all of them. ``matcher`` "lightglue"
    matches with the best three of them by that network, for the features that have one.
    """

    top_k: Annotated[int, msgspec.Meta(ge=1)] = 20
    ratio: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.8
    max_reprojection_px: Positive = 12.0
    min_inliers: Annotated[int, msgspec.Meta(ge=4)] = 12
    min_confidence: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.5
    matcher: Literal["nearest", "lightglue"] = "nearest"


class OdometryNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Standard deviations with which the prior's covariance grows along the path.

    ``*_per_m`` and ``yaw_deg_per_turn_deg`` are biases, which grow with distance (m) and turning (deg);
    ``*_per_root_m`` are random walks, which grow with the root of distance.
    """

    position_per_m: Positive = 0.02
    yaw_deg_per_m: Positive = 0.5
    yaw_deg_per_turn_deg: Positive = 0.01
    position_per_root_m: NotNegative = 0.01
    yaw_deg_per_root_m: NotNegative = 0.5


class ArmNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Standard deviations per axis of body_from_cam from joint angles: deg and m.

    ``image_*`` is anew in every image (encoders, sway, stamps), and scaled to what the sightings show. ``camera_*`` and
    ``base_*`` are the same in all images of a visit: the camera in the hand and the zeros of the joints, seen at the
    camera, and the arm on the body.
    """

    image_deg: Positive = 0.2
    image_m: Positive = 0.002
    camera_deg: NotNegative = 0.15
    camera_m: NotNegative = 0.0015
    base_deg: NotNegative = 0.1
    base_m: NotNegative = 0.001


class Expect(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A bound that scoring checks (exit status 3 when missed): recall of a policy at a threshold of the protocol."""

    policy: str
    position_m: Positive
    rotation_deg: Positive
    min_recall: Share = 0.0
    max_recall: Share = 1.0
    occlusion: bool | None = None


class Protocol(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that is fixed before a recording is replayed and scored."""

    name: str
    thresholds: Annotated[tuple[Threshold, ...], msgspec.Meta(min_length=1)]
    policies: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]
    version: Literal[1] = 1
    pose: Literal["cam", "body"] = "body"
    feature: str = "sift"
    seed: Annotated[int, msgspec.Meta(ge=0, lt=2**31)] = 0
    candidates: CandidateRules = CandidateRules()
    occlusion: OcclusionRules = OcclusionRules()
    localizer: LocalizerRules = LocalizerRules()
    odometry: OdometryNoise = OdometryNoise()
    arm: ArmNoise = ArmNoise()
    expect: tuple[Expect, ...] = ()


def known_protocols() -> list[str]:
    """Return the names of the protocols that ship with fieldkit."""
    return sorted(p.name.removesuffix(".toml") for p in _folder().iterdir() if p.name.endswith(".toml"))


def load(name_or_path: str | Path) -> Protocol:
    """Load a protocol by its shipped name or from a TOML file.

    Raises ProtocolError for a missing file, a key, policy or threshold that is unknown, or a value out of range.
    """
    text, source = _read(name_or_path)
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ProtocolError(f"{source}: not valid TOML: {error}", hint="correct the file") from error
    return from_dict(values, source=source)


def from_dict(values: dict[str, Any], *, source: str) -> Protocol:
    """Make a protocol from plain values (of a TOML file or run.json) and check them; errors name ``source``."""
    version = values.get("version", 1)
    if isinstance(version, int) and version > 1:
        raise ProtocolError(f"{source}: version {version}; this fieldkit reads version 1", hint="update fieldkit")
    try:
        protocol = msgspec.convert(values, Protocol)
    except msgspec.ValidationError as error:
        raise ProtocolError(f"{source}: {_explain(str(error))}", hint="correct the protocol") from error
    _check(protocol, source)
    return protocol


def localizer_rules(**values: Any) -> LocalizerRules:
    """Make rules of the localizer from options of a command; raises ProtocolError for a value out of range."""
    try:
        return msgspec.convert(values, LocalizerRules)
    except msgspec.ValidationError as error:
        raise ProtocolError(f"localizer: {error}", hint="correct the option") from error


def to_dict(protocol: Protocol) -> dict[str, Any]:
    """Return plain values that `from_dict` reads back."""
    values: dict[str, Any] = msgspec.to_builtins(protocol)
    return values


def _folder() -> Any:
    packaged = importlib.resources.files("fieldkit") / "_protocols"
    return packaged if packaged.is_dir() else Path(__file__).resolve().parent.parent / "protocols"


def _read(name_or_path: str | Path) -> tuple[str, str]:
    path = Path(name_or_path)
    if path.suffix == ".toml" or path.is_file():
        if not path.is_file():
            raise ProtocolError(f"{path}: no such protocol file", hint=suggestion(str(path), known_protocols()))
        try:
            return path.read_text(encoding="utf-8"), str(path)
        except (OSError, UnicodeDecodeError) as error:
            raise ProtocolError(f"{path}: cannot be read as text; expected TOML", hint="check the file") from error
    if str(name_or_path) not in known_protocols():
        raise ProtocolError(
            f"unknown protocol {str(name_or_path)!r}; expected a name or a .toml file",
            hint=suggestion(str(name_or_path), known_protocols()),
        )
    return (_folder() / f"{name_or_path}.toml").read_text(encoding="utf-8"), f"protocol {name_or_path}"


def _explain(text: str) -> str:
    unknown = re.match(r"Object contains unknown field `(.+?)`(?: - at `(.+)`)?", text)
    if not unknown:
        return text
    where = unknown.group(2) or "$"
    known = _fields_at(where)
    return f"unknown key {unknown.group(1)!r} at {where}; {suggestion(unknown.group(1), known)}"


def _fields_at(where: str) -> list[str]:
    structs: dict[str, type[msgspec.Struct]] = {
        "thresholds": Threshold, "candidates": CandidateRules, "occlusion": OcclusionRules,
        "localizer": LocalizerRules, "odometry": OdometryNoise, "arm": ArmNoise, "expect": Expect,
    }  # fmt: skip
    part = re.match(r"\$\.(\w+)", where)
    return list((structs[part.group(1)] if part else Protocol).__struct_fields__)


def _check(protocol: Protocol, source: str) -> None:
    for name in (*protocol.policies, *(e.policy for e in protocol.expect)):
        if name not in POLICY_NAMES:
            raise ProtocolError(f"{source}: unknown policy {name!r}", hint=suggestion(name, POLICY_NAMES))
    where = _not_finite(to_dict(protocol), "$")
    if where is not None:
        raise ProtocolError(f"{source}: the number at {where} is not finite", hint="correct the protocol")
    lists = (protocol.policies, protocol.thresholds, protocol.occlusion.use, protocol.candidates.kinds)
    for values in lists:
        if len(set(values)) != len(values):
            raise ProtocolError(f"{source}: listed twice in {msgspec.to_builtins(values)}", hint="list it once")
    if protocol.candidates.min_distance_m >= protocol.candidates.max_distance_m:
        raise ProtocolError(
            f"{source}: candidates.min_distance_m is {protocol.candidates.min_distance_m:g}; expected less than "
            f"max_distance_m, {protocol.candidates.max_distance_m:g}",
            hint="correct the protocol",
        )
    for bound in protocol.expect:
        _check_bound(bound, protocol, source)


def _check_bound(bound: Expect, protocol: Protocol, source: str) -> None:
    what = f"{source}: [[expect]] of {bound.policy}"
    if bound.policy not in protocol.policies:
        raise ProtocolError(f"{what}: it is not one of the protocol's policies", hint="add it to policies")
    if Threshold(bound.position_m, bound.rotation_deg) not in protocol.thresholds:
        raise ProtocolError(
            f"{what} at {bound.position_m:g} m / {bound.rotation_deg:g} deg is not one of the protocol's thresholds",
            hint="add it to [[thresholds]]",
        )
    if bound.min_recall > bound.max_recall:
        raise ProtocolError(f"{what}: min_recall exceeds max_recall", hint="correct the bound")


def _not_finite(value: Any, where: str) -> str | None:
    """Return the place of the first number that is not finite: run.json could not hold it."""
    if isinstance(value, dict):
        found = (_not_finite(v, f"{where}.{k}") for k, v in value.items())
    elif isinstance(value, list | tuple):
        found = (_not_finite(v, f"{where}[{i}]") for i, v in enumerate(value))
    else:
        return where if isinstance(value, float) and not math.isfinite(value) else None
    return next((f for f in found if f is not None), None)
