"""What sensors add to renderings: every effect follows its law, can be switched off, and repeats."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from numpy.typing import NDArray

from fieldkit.cameras import Camera
from fieldkit.errors import FieldkitError
from sim_bridge import cli
from sim_bridge.sensors import (
    IDEAL,
    LENSES,
    PRESETS,
    STANDARD,
    ColourSensor,
    DepthSensor,
    Motion,
    bent,
    effects,
    encode,
    expose,
    load_sensors,
    sense_depth,
    with_lens,
    without,
    write_sensors,
)
from sim_bridge.sensors.colour import GAMMA
from sim_bridge.sensors.models import (
    Blur,
    DepthHoles,
    DepthNoise,
    Effect,
    Exposure,
    Jpeg,
    Noise,
    Vignetting,
)

CAMERA = Camera("PINHOLE", 640, 480, (552.03, 552.03, 320.0, 240.0))
DEPTH = Camera("PINHOLE", 160, 120, (140.0, 140.0, 80.0, 60.0))
STILL = Motion(np.zeros(3), np.zeros(3))
EXACT = Exposure(error_ev=0.0, step_ev=0.0, highlights=1.0)


def rng(seed: int = 7) -> np.random.Generator:
    return np.random.default_rng(seed)


def flat(level: int) -> npt.NDArray[np.uint8]:
    return np.full((480, 640, 3), level, np.uint8)


def picture(*, low: int = 20, high: int = 235) -> npt.NDArray[np.uint8]:
    """Blocks of colours, each 20 pixels wide."""
    blocks = rng(1).integers(low, high, (24, 32, 3)).astype(np.uint8)
    return np.kron(blocks, np.ones((20, 20, 1), np.uint8))


def light(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    return np.asarray((image / 255.0) ** GAMMA, dtype=np.float64)


def test_an_ideal_sensor_changes_nothing() -> None:
    image = picture()
    fast = Motion(np.array([0.0, 2.0, 0.0]), np.zeros(3))
    assert np.array_equal(expose(image, IDEAL.hand, camera=CAMERA, rng=rng(), motion=fast), image)
    depth = np.full((120, 160), 2.0, np.float32)
    assert np.array_equal(sense_depth(depth, IDEAL.hand_depth, camera=DEPTH, rng=rng()), depth)


def test_grey_levels_survive_the_way_through_linear_light() -> None:
    ramp = np.tile(np.arange(256, dtype=np.uint8), (480, 3))[:, :640]
    sensor = ColourSensor(vignetting=Vignetting(strength=0.0))
    assert np.abs(expose(ramp, sensor, camera=CAMERA, rng=rng()).astype(int) - ramp).max() <= 1


@pytest.mark.parametrize("gain_ev", [0, 3])
def test_noise_variance_is_linear_in_the_collected_electrons(gain_ev: int) -> None:
    noise = Noise(full_well_e=8000.0, read_e=20.0)
    # The exposure control is held: four parts of the image see 1, 2, 4 and 8 parts of light.
    shares = np.array([0.08, 0.16, 0.32, 0.64])
    levels = np.rint(255 * (shares / 2**gain_ev) ** (1 / GAMMA)).astype(np.uint8)
    image = np.repeat(np.kron(levels, np.ones((480, 160), np.uint8))[..., None], 3, axis=2)
    target = float((np.minimum((levels / 255.0) ** GAMMA * 2**gain_ev, 1.0) ** (1 / GAMMA)).mean())
    exposure = Exposure(error_ev=0.0, step_ev=0.0, highlights=1.0, target=target, white_s=0.01, longest_s=0.01)
    values = light(expose(image, ColourSensor(exposure=exposure, noise=noise), camera=CAMERA, rng=rng()))
    parts = np.split(values, 4, axis=1)
    gain = 2.0**gain_ev
    electrons = np.array([p.mean() for p in parts]) * noise.full_well_e / gain
    variance = np.array([p.var() for p in parts]) * (noise.full_well_e / gain) ** 2
    expected = electrons + noise.read_e**2
    assert np.allclose(variance, expected, rtol=0.06)
    slope = np.polyfit(electrons, variance, 1)[0]
    assert slope == pytest.approx(1.0, abs=0.08)


def test_noise_is_independent_between_pixels_and_channels() -> None:
    values = expose(flat(150), ColourSensor(noise=Noise(full_well_e=1000.0)), camera=CAMERA, rng=rng()) - 150.0
    values -= values.mean()
    for a, b in ((values[:, 1:], values[:, :-1]), (values[1:], values[:-1]), (values[..., 0], values[..., 1])):
        assert abs((a * b).mean() / values.var()) < 0.01
    middle = np.abs(values) < values.std()
    assert middle.mean() == pytest.approx(0.6827, abs=0.03)


def test_vignetting_follows_the_fourth_power_of_the_cosine() -> None:
    values = light(expose(flat(200), ColourSensor(vignetting=Vignetting(strength=1.0)), camera=CAMERA, rng=rng()))
    for column, row in ((0, 0), (639, 240), (320, 479), (100, 50)):
        ray = CAMERA.unproject([[column + 0.5, row + 0.5]])[0]
        cosine = 1.0 / np.linalg.norm(ray)
        assert values[row, column, 0] / values[240, 320, 0] == pytest.approx(cosine**4, abs=0.02)


def test_vignetting_of_a_fisheye_goes_by_the_true_angle() -> None:
    camera = bent(CAMERA, ColourSensor(lens=LENSES["fisheye"]))
    values = light(expose(flat(200), ColourSensor(vignetting=Vignetting(strength=1.0)), camera=camera, rng=rng()))
    cosine = 1.0 / np.linalg.norm(camera.unproject([[0.5, 0.5]])[0])
    assert values[0, 0, 0] / values[240, 320, 0] == pytest.approx(cosine**4, abs=0.02)


@pytest.mark.parametrize("brightness", [0.4, 0.6, 1.0])
def test_exposure_reaches_its_target(brightness: float) -> None:
    image = effects.grey((picture() * brightness).astype(np.uint8))
    shown = expose(image, ColourSensor(exposure=EXACT, vignetting=Vignetting()), camera=CAMERA, rng=rng())
    assert shown.mean() / 255 == pytest.approx(EXACT.target, abs=0.02)


def test_darkness_is_exposed_longer_then_amplified_and_noisier() -> None:
    sensor = ColourSensor(exposure=EXACT, noise=Noise())
    noises = []
    for level in (200, 110, 60):
        shown = expose(flat(level), sensor, camera=CAMERA, rng=rng())
        noises.append(float(shown.std()))
        assert shown.mean() / 255 == pytest.approx(EXACT.target, abs=0.03)
    assert noises[0] < noises[1] < noises[2]
    assert noises[2] > 2.5 * noises[0]


def test_exposure_has_its_limits() -> None:
    shown = expose(flat(8), ColourSensor(exposure=EXACT), camera=CAMERA, rng=rng())
    assert 8 < shown.mean() < 0.5 * 255 * EXACT.target


def test_exposure_errs_and_is_rounded_to_steps() -> None:
    erring = msgspec.structs.replace(EXACT, error_ev=0.2)
    means = [
        light(expose(flat(120)[..., 0], ColourSensor(exposure=erring), camera=CAMERA, rng=rng(s))).mean()
        for s in range(60)
    ]
    assert np.log2(means).std() == pytest.approx(0.2, rel=0.3)
    stepped = msgspec.structs.replace(EXACT, error_ev=0.2, step_ev=1.0)
    found = {
        int(expose(flat(120)[..., 0], ColourSensor(exposure=stepped), camera=CAMERA, rng=rng(s))[0, 0])
        for s in range(30)
    }
    assert len(found) <= 3


def test_bright_windows_clip_and_darken_the_rest() -> None:
    image = picture(low=20, high=180)
    window = image.copy()
    window[100:300, 200:400] = 255
    sensor = ColourSensor(exposure=Exposure(error_ev=0.0, step_ev=0.0))
    plain, shown = (expose(i, sensor, camera=CAMERA, rng=rng()) for i in (image, window))
    assert (shown[100:300, 200:400] == 255).all()
    assert shown[320:].mean() < 0.9 * plain[320:].mean()


def line(width: int = 1) -> npt.NDArray[np.uint8]:
    image = np.zeros((480, 640), np.uint8)
    image[:, 320 : 320 + width] = 255
    return image


@pytest.mark.parametrize("length_px", [0.7, 2.0, 5.3, 17.0])
def test_a_turning_camera_blurs_by_its_rate_times_exposure_times_focal_length(length_px: float) -> None:
    exposure_s, focal = 0.012, CAMERA.focal_px[0]
    motion = Motion(np.array([0.0, length_px / (focal * exposure_s), 0.0]), np.zeros(3))
    sensor = ColourSensor(blur=Blur(exposure_s=exposure_s))
    profile = light(expose(line(), sensor, camera=CAMERA, rng=rng(), motion=motion))[240]
    columns = np.arange(640) + 0.5
    middle = (profile * columns).sum() / profile.sum()
    variance = (profile * (columns - middle) ** 2).sum() / profile.sum()
    assert middle == pytest.approx(320.5, abs=0.02)
    assert np.sqrt(12 * variance) == pytest.approx(length_px, rel=0.03)


def test_a_camera_that_moves_aside_blurs_near_things_more() -> None:
    depth = np.full((480, 640), 1.0, np.float32)
    depth[240:] = 4.0
    sensor = ColourSensor(blur=Blur(exposure_s=0.02))
    motion = Motion(np.zeros(3), np.array([0.6, 0.0, 0.0]))
    shown = expose(line(), sensor, camera=CAMERA, rng=rng(), motion=motion, depth_m=depth)
    wide = [int((shown[row] > 0).sum()) for row in (100, 400)]
    near_px = 0.6 * 0.02 * CAMERA.focal_px[0]
    assert wide[0] == pytest.approx(near_px, abs=2)
    assert wide[1] == pytest.approx(near_px / 4, abs=2)


def test_a_camera_that_rolls_blurs_around_its_axis() -> None:
    motion = Motion(np.array([0.0, 0.0, 1.5]), np.zeros(3))
    image = np.zeros((480, 640), np.uint8)
    image[236:244] = 255
    shown = expose(image, ColourSensor(blur=Blur(exposure_s=0.02)), camera=CAMERA, rng=rng(), motion=motion)
    heights = [int((shown[:, x] > 20).sum()) for x in (320, 600)]
    assert heights[0] == 8
    assert heights[1] == pytest.approx(8 + 280 * 1.5 * 0.02, abs=2)


def test_a_point_moves_against_the_turn_of_the_camera() -> None:
    """Blur is symmetric, so the sign of a path only shows where turning and moving cancel."""
    depth = np.full((480, 640), 2.0, np.float32)
    speed = Motion(np.array([0.0, 0.5, 0.0]), np.array([-1.0, 0.0, 0.0]))
    sensor = ColourSensor(blur=Blur(exposure_s=0.02))
    shown = expose(line(), sensor, camera=CAMERA, rng=rng(), motion=speed, depth_m=depth)
    assert np.array_equal(shown[240], line()[240])


def test_no_motion_no_blur() -> None:
    image = picture()
    assert np.array_equal(expose(image, ColourSensor(blur=Blur()), camera=CAMERA, rng=rng(), motion=STILL), image)


def test_without_compression_jpeg_loses_almost_nothing() -> None:
    image = cv2.GaussianBlur(picture(), (0, 0), 3)
    losses = []
    for sensor in (ColourSensor(), ColourSensor(jpeg=Jpeg(quality=90)), ColourSensor(jpeg=Jpeg(quality=30))):
        data = np.frombuffer(encode(image, sensor), np.uint8)
        back = cv2.cvtColor(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR)), cv2.COLOR_BGR2RGB)
        losses.append(float(np.abs(back.astype(int) - image).mean()))
    assert losses[0] < 1.0
    assert losses[0] < losses[1] < losses[2]


def test_the_same_generator_gives_the_same_bytes_for_colour_and_grey() -> None:
    depth = np.full((480, 640), 2.0, np.float32)
    motion = Motion(np.array([0.1, 0.4, 0.2]), np.array([0.3, 0.0, 0.1]))

    def shot(seed: int, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return expose(image, STANDARD.hand, camera=CAMERA, rng=rng(seed), motion=motion, depth_m=depth)

    for image in (picture(), effects.grey(picture())):
        assert shot(1, image).shape == image.shape
        assert np.array_equal(shot(1, image), shot(1, image))
        assert not np.array_equal(shot(1, image), shot(2, image))


@pytest.mark.parametrize("effect", ["exposure", "vignetting", "noise", "blur"])
def test_each_switch_changes_the_image_and_nothing_else_does(effect: str) -> None:
    motion = Motion(np.array([0.0, 0.8, 0.0]), np.zeros(3))
    lit, off = STANDARD.hand, without(STANDARD, [effect]).hand
    assert getattr(off, effect) is None
    assert all(getattr(off, n) == getattr(lit, n) for n in lit.__struct_fields__ if n != effect)
    with_it, without_it = (expose(picture(), s, camera=CAMERA, rng=rng(), motion=motion) for s in (lit, off))
    assert not np.array_equal(with_it, without_it)


def plane(angle_deg: float, *, step_m: float = 0.0) -> NDArray[np.float32]:
    """Depth of a surface that is seen at an angle above it, and of a nearer one on its right half."""
    tilt = np.radians(90.0 - angle_deg)
    rays = DEPTH.unproject(np.stack(np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5), axis=-1).reshape(-1, 2))
    normal = np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    depth = (3.0 * normal[2] / (rays @ normal)).reshape(120, 160)
    depth[:, 80:] -= step_m
    return np.asarray(depth, dtype=np.float32)


def test_depth_noise_grows_with_the_square_of_depth() -> None:
    noise = DepthNoise(floor_m=0.002, per_m2=0.003, step_m=0.0001)
    for z in (0.5, 1.5, 4.0):
        depth = np.full((120, 160), z, np.float32)
        error = sense_depth(depth, DepthSensor(depth_noise=noise), camera=DEPTH, rng=rng()) - depth
        assert error.std() == pytest.approx(0.002 + 0.003 * z * z, rel=0.03)
        assert abs(error.mean()) < 3 * error.std() / np.sqrt(error.size)


def test_depth_comes_in_steps_and_nothing_stays_nothing() -> None:
    depth = np.full((120, 160), 1.2345, np.float32)
    depth[:10] = 0.0
    found = sense_depth(depth, DepthSensor(depth_noise=DepthNoise(step_m=0.01)), camera=DEPTH, rng=rng())
    assert np.allclose(found / 0.01, np.rint(found / 0.01), atol=1e-3)
    assert (found[:10] == 0).all()


HOLES = DepthSensor(depth_holes=DepthHoles(speckle_share=0.0, edge_share=1.0, far_m=6.0, near_m=0.3))


def test_depth_has_holes_at_edges_only() -> None:
    found = sense_depth(plane(90.0, step_m=1.0), HOLES, camera=DEPTH, rng=rng())
    assert (found[:, 79:81] == 0).all()
    assert (found[:, :78] > 0).all()
    assert (found[:, 82:] > 0).all()


@pytest.mark.parametrize(("angle_deg", "lost"), [(60.0, False), (30.0, False), (3.0, True)])
def test_depth_has_holes_where_a_surface_is_grazed(angle_deg: float, lost: bool) -> None:
    depth = plane(angle_deg)
    settings = DepthSensor(depth_holes=DepthHoles(speckle_share=0.0, far_m=100.0, near_m=0.0, edge=10.0))
    found = sense_depth(depth, settings, camera=DEPTH, rng=rng())
    assert (found[58:62, 70:90] == 0).all() == lost
    assert (found[58:62, 70:90] == 0).any() == lost


def test_depth_has_holes_far_and_near_and_here_and_there() -> None:
    for z, seen in ((0.2, False), (1.0, True), (5.9, True), (6.1, False)):
        found = sense_depth(np.full((120, 160), z, np.float32), HOLES, camera=DEPTH, rng=rng())
        assert (found > 0).all() == seen
    speckled = DepthSensor(depth_holes=DepthHoles(speckle_share=0.05))
    found = sense_depth(np.full((120, 160), 2.0, np.float32), speckled, camera=DEPTH, rng=rng())
    assert (found == 0).mean() == pytest.approx(0.05, abs=0.01)


@pytest.mark.parametrize("name", list(PRESETS))
def test_sensors_survive_their_file(tmp_path: Path, name: str) -> None:
    path = tmp_path / "sensors.toml"
    for sensors in (PRESETS[name], with_lens(PRESETS[name], "fisheye")):
        write_sensors(path, sensors)
        assert load_sensors(str(path)) == sensors
    assert load_sensors(name) == PRESETS[name]


@pytest.mark.parametrize("kind", list(LENSES))
def test_a_lens_bends_the_camera_and_keeps_its_middle(kind: str) -> None:
    camera = bent(CAMERA, with_lens(STANDARD, kind).hand)
    assert camera.is_pinhole == (kind == "none")
    assert camera.focal_px == CAMERA.focal_px
    middle, inside = camera.project([[0.0, 0.0, 1.0]])
    assert inside.all()
    assert np.allclose(middle, [camera.centre_px])


@pytest.mark.parametrize("effect", get_args(Effect))
def test_every_effect_can_be_switched_off_everywhere(effect: str) -> None:
    off = without(with_lens(STANDARD, "radtan"), [effect])
    assert off != STANDARD
    parts = (getattr(off, n) for n in off.__struct_fields__ if n != "version")
    assert all(getattr(part, effect, None) is None for part in parts)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("version = 1\n[hand.exposure]\ntarget = 1.5\n", r"Expected `float` < 1.0 - at `\$\.hand\.exposure\.target`"),
        ("version = 1\n[hand.glare]\n", r"unknown field `glare`"),
        ("version = 2\n", r"version 2; this fieldkit reads version 1"),
        ("version = 1\n[hand.lens]\nkind = 'prism'\ncoefficients = [0, 0, 0, 0]\n", "Invalid enum value 'prism'"),
        ("version = 1\n[hand.lens]\nkind = 'radtan'\ncoefficients = [nan, 0, 0, 0]\n", r"at `\$\.hand\.lens\.coeff"),
        ("version = 1\n[hand.exposure]\nwhite_s = inf\n", r"at `\$\.hand\.exposure\.white_s`"),
        (
            "version = 1\n[hand.exposure]\nshortest_s = 0.1\nlongest_s = 0.01\n",
            "shortest_s 0.1 is above longest_s 0.01",
        ),
        ("version = 1\n[hand_depth.depth_holes]\nnear_m = 7.0\n", "near_m 7 is not below far_m 6"),
    ],
)
def test_a_bad_sensors_file_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "own.toml"
    path.write_text(text)
    with pytest.raises(FieldkitError, match=message):
        load_sensors(str(path))


def test_unknown_names_are_refused() -> None:
    with pytest.raises(FieldkitError, match="unknown sensors 'standart'; did you mean 'standard'"):
        load_sensors("standart")
    with pytest.raises(FieldkitError, match="unknown sensor effect 'blurr'; did you mean 'blur'"):
        without(STANDARD, ["blurr"])
    with pytest.raises(FieldkitError, match="unknown lens 'prism'"):
        with_lens(STANDARD, "prism")
    with pytest.raises(FieldkitError, match=r"none\.toml: no such file"):
        load_sensors("none.toml")


def test_a_lens_that_cannot_be_drawn_is_refused_before_anything_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "own.toml"
    path.write_text("version = 1\n[hand.lens]\nkind = 'radtan'\ncoefficients = [-0.6, 0, 0, 0]\n")
    with pytest.raises(SystemExit) as ended:
        cli.main(["synthesize", "--sensors", str(path), "--out", str(tmp_path / "out")])
    assert ended.value.code == 1
    assert f"{path}: [hand.lens]: camera OPENCV 640x480: field of view too wide" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--quality", "80", "--without", "jpeg"], "--quality sets what --without jpeg switches off"),
        (["--lens", "fisheye", "--without", "lens"], "--lens sets what --without lens switches off"),
    ],
)
def test_what_is_switched_off_cannot_be_set(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["synthesize", "--out", str(tmp_path / "out"), *words])
    assert ended.value.code == 1
    assert message in capsys.readouterr().err
