"""The sensors of a session as settings: what each adds to an exact rendering. An effect that is None is off."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal, get_args

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.errors import suggestion
from fieldkit.store import read_toml, write_toml
from sim_bridge.errors import SynthesisError

# Beyond any camera's: what a slip of the pen, or inf, exceeds.
_MOST = 1e6
Positive = Annotated[float, Meta(gt=0.0, le=_MOST)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
NotNegative = Annotated[float, Meta(ge=0.0, le=_MOST)]
Coefficient = Annotated[float, Meta(ge=-1000.0, le=1000.0)]
Effect = Literal["lens", "exposure", "vignetting", "noise", "blur", "jpeg", "depth_noise", "depth_holes"]


@dataclasses.dataclass(frozen=True, eq=False)
class Motion:
    """How a camera moves at the middle of an exposure: rad/s (3,) and m/s (3,) in its own frame (x right, y down)."""

    angular_rad_s: NDArray[np.float64]
    linear_m_s: NDArray[np.float64]


class Lens(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Distortion: four coefficients k1 k2 p1 p2 (radtan) or k1 k2 k3 k4 (fisheye) in OpenCV's order."""

    kind: Literal["radtan", "fisheye"]
    coefficients: tuple[Coefficient, Coefficient, Coefficient, Coefficient]


class Exposure(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Automatic exposure: the mean grey level (0..1, gamma encoded) that it aims at, and its limits.

    ``white_s`` is the time after which white under ordinary light fills the pixels at gain 1. The time grows up to
    ``longest_s``, then the gain. What results errs by ``error_ev`` (standard deviation, powers of two) and is rounded
    to steps of ``step_ev``. Lamps and windows, white in a rendering, are ``highlights`` times as bright as paper.
    """

    target: Annotated[float, Meta(gt=0.0, lt=1.0)] = 0.45
    white_s: Positive = 0.04
    shortest_s: Positive = 0.0002
    longest_s: Positive = 0.02
    most_gain: Annotated[float, Meta(ge=1.0, le=_MOST)] = 16.0
    error_ev: NotNegative = 0.1
    step_ev: NotNegative = 0.125
    highlights: Annotated[float, Meta(ge=1.0, le=_MOST)] = 3.0

    def __post_init__(self) -> None:
        if self.shortest_s > self.longest_s:
            raise ValueError(f"shortest_s {self.shortest_s:g} is above longest_s {self.longest_s:g}; expected it below")


class Vignetting(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Light lost off the axis: 1 is the cos^4 law of a simple lens, 0 nothing."""

    strength: Share = 0.7


class Noise(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Shot and read noise in electrons: pixels hold ``full_well_e``; gain amplifies both noises."""

    full_well_e: Positive = 9000.0
    read_e: NotNegative = 4.0


class Blur(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Motion blur over the exposure time; ``exposure_s`` where exposure is switched off."""

    exposure_s: Positive = 0.01


class Jpeg(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """JPEG compression with colour at full resolution; switched off, the quality is 100."""

    quality: Annotated[int, Meta(ge=1, le=100)] = 90


class DepthNoise(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Standard deviation of depth: ``floor_m`` plus ``per_m2`` times the depth squared (m); values in steps."""

    floor_m: NotNegative = 0.001
    per_m2: NotNegative = 0.0015
    step_m: Positive = 0.001


class DepthHoles(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where depth is missing: too near or far, around steps of depth, on grazing surfaces, and here and there.

    A neighbour that differs by more than ``edge`` of the depth makes an edge, whose pixels are lost with the chance
    ``edge_share``. Seen at less than ``grazing_deg`` above a surface its pixels are lost.
    """

    near_m: NotNegative = 0.2
    far_m: Positive = 6.0
    edge: Positive = 0.03
    edge_share: Share = 0.8
    grazing_deg: NotNegative = 8.0
    speckle_share: Share = 0.002

    def __post_init__(self) -> None:
        if self.near_m >= self.far_m:
            raise ValueError(f"near_m {self.near_m:g} is not below far_m {self.far_m:g}; expected it nearer")


class ColourSensor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a colour or grey camera adds."""

    lens: Lens | None = None
    exposure: Exposure | None = None
    vignetting: Vignetting | None = None
    noise: Noise | None = None
    blur: Blur | None = None
    jpeg: Jpeg | None = None


class DepthSensor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a depth camera adds."""

    depth_noise: DepthNoise | None = None
    depth_holes: DepthHoles | None = None


class Sensors(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All sensors of a session, as in its ``sensors.toml``; a table that is missing there is off."""

    version: Literal[1] = 1
    hand: ColourSensor = ColourSensor()
    hand_depth: DepthSensor = DepthSensor()
    mapping: ColourSensor = ColourSensor()
    mapping_depth: DepthSensor = DepthSensor()
    photos: ColourSensor = ColourSensor()


# Spot's hand camera, a small module; its driver gives rectified images.
HAND_COLOR = ColourSensor(
    exposure=Exposure(white_s=0.04, longest_s=0.02, most_gain=16.0),
    vignetting=Vignetting(strength=0.7),
    noise=Noise(full_well_e=8000.0, read_e=5.0),
    blur=Blur(),
    jpeg=Jpeg(quality=90),
)
HAND_DEPTH = DepthSensor(depth_noise=DepthNoise(), depth_holes=DepthHoles())
# HoloLens 2: tracking cameras with global shutters that see in dim rooms, and the long-throw depth camera.
VLC = ColourSensor(
    exposure=Exposure(white_s=0.015, longest_s=0.008, most_gain=16.0),
    vignetting=Vignetting(strength=0.8),
    noise=Noise(full_well_e=8000.0, read_e=5.0),
    blur=Blur(exposure_s=0.005),
    jpeg=Jpeg(quality=95),
)
LONG_THROW = DepthSensor(
    depth_noise=DepthNoise(floor_m=0.002, per_m2=0.0005), depth_holes=DepthHoles(near_m=0.3, edge_share=0.6)
)
# A camera with a large sensor, stopped down and held with care; the barrel distortion of an ordinary zoom lens.
DSLR = ColourSensor(
    lens=Lens(kind="radtan", coefficients=(-0.105, 0.062, 0.0007, -0.0005)),
    exposure=Exposure(white_s=0.1, longest_s=0.0125, most_gain=32.0, error_ev=0.15, step_ev=0.33),
    vignetting=Vignetting(strength=0.5),
    noise=Noise(full_well_e=60000.0, read_e=4.0),
    blur=Blur(),
    jpeg=Jpeg(quality=92),
)
STANDARD = Sensors(hand=HAND_COLOR, hand_depth=HAND_DEPTH, mapping=VLC, mapping_depth=LONG_THROW, photos=DSLR)
IDEAL = Sensors()
PRESETS: dict[str, Sensors] = {"standard": STANDARD, "ideal": IDEAL}
# Distortions of a hand camera that can be had by name: an ordinary wide lens, and a fisheye.
LENSES: dict[str, Lens | None] = {
    "none": None,
    "radtan": Lens(kind="radtan", coefficients=(-0.12, 0.08, 0.0006, -0.0004)),
    "fisheye": Lens(kind="fisheye", coefficients=(-0.015, 0.004, -0.001, 0.0002)),
}


def bent(camera: Camera, sensor: ColourSensor) -> Camera:
    """Return the camera with the distortion of the sensor's lens, or as it is when it has none."""
    if sensor.lens is None:
        return camera
    model = "OPENCV" if sensor.lens.kind == "radtan" else "OPENCV_FISHEYE"
    head = (*camera.focal_px, *camera.centre_px)
    return Camera(model, camera.width, camera.height, (*head, *sensor.lens.coefficients))


def load_sensors(name: str) -> Sensors:
    """Return a preset by name, or the sensors of a TOML file; raises SynthesisError or StoreError."""
    if name in PRESETS:
        return PRESETS[name]
    if not name.endswith(".toml"):
        raise SynthesisError(f"unknown sensors {name!r}", hint=f"{suggestion(name, list(PRESETS))}, or a TOML file")
    return read_toml(Path(name), Sensors, what="sensor settings as in a session's sensors.toml")


def with_quality(sensors: Sensors, quality: int) -> Sensors:
    """Return the sensors with another JPEG quality (1 to 100) of the hand camera."""
    hand = msgspec.structs.replace(sensors.hand, jpeg=Jpeg(quality=quality))
    return msgspec.structs.replace(sensors, hand=hand)


def with_lens(sensors: Sensors, name: str) -> Sensors:
    """Return the sensors with another lens of the hand camera; raises SynthesisError for an unknown name."""
    if name not in LENSES:
        raise SynthesisError(f"unknown lens {name!r}", hint=suggestion(name, list(LENSES)))
    hand = msgspec.structs.replace(sensors.hand, lens=LENSES[name])
    return msgspec.structs.replace(sensors, hand=hand)


def write_sensors(path: Path, sensors: Sensors) -> None:
    """Write sensors as TOML; effects that are off are left out."""
    write_toml(path, sensors)


def without(sensors: Sensors, effects: Iterable[str]) -> Sensors:
    """Return the sensors with effects switched off everywhere; raises SynthesisError for an unknown effect."""
    names = list(get_args(Effect))
    off = list(effects)
    for name in off:
        if name not in names:
            raise SynthesisError(f"unknown sensor effect {name!r}", hint=suggestion(name, names))

    def quiet(sensor: msgspec.Struct) -> msgspec.Struct:
        return msgspec.structs.replace(sensor, **{n: None for n in off if n in sensor.__struct_fields__})

    parts = {n: quiet(getattr(sensors, n)) for n in sensors.__struct_fields__ if n != "version"}
    return msgspec.structs.replace(sensors, **parts)
