"""Effects on colours: each does what it says, is off unless asked for, and repeats."""

import numpy as np
import pytest

from simtrack.contracts import Float64
from simtrack.datasets import effect_kernels as kernels
from simtrack.datasets.annotate import Annotator, View
from simtrack.datasets.content import Content
from simtrack.datasets.effects import BayerSensor, Effects, bayer_noise, draw_motion, motion_blur
from simtrack.datasets.recipe import EffectSettings
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import exp_so3, transform
from tests.datasets.tabletop import CAMERA, content, lamp, look_at, owners

VIEW = look_at((0.5, -0.6, 0.5), (0.0, 0.0, 0.05))
SHAPE = (CAMERA.height, CAMERA.width)
QUIET = BayerSensor(full_well=1e9, read_noise=0.0, bits=16)


@pytest.fixture(scope="module")
def scene() -> Content:
    return content((lamp(0.3, -0.1, 0.8),))


@pytest.fixture(scope="module")
def view(scene: Content) -> View:
    return Annotator(CAMERA).look(scene.rays, owners(scene.things), VIEW)


def random_image(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*SHAPE, 3), dtype=np.uint8)


def grey(value: int) -> np.ndarray:
    return np.full((*SHAPE, 3), value, np.uint8)


def applied(settings: EffectSettings, image: np.ndarray, scene: Content, view: View, seed: int = 0) -> np.ndarray:
    effects = Effects(settings, CAMERA, linear=True)
    return effects.apply(image, scene, view, VIEW, np.random.default_rng(seed))


def test_nothing_is_done_unless_asked_for(scene: Content, view: View) -> None:
    image, rng = random_image(), np.random.default_rng(0)
    effects = Effects(EffectSettings(), CAMERA, linear=True)
    assert not effects.active
    assert effects.apply(image, scene, view, VIEW, rng) is image
    assert rng.random() == np.random.default_rng(0).random()


def test_decoding_and_encoding_are_inverse() -> None:
    levels = np.repeat(np.arange(256, dtype=np.uint8), 3).reshape(16, 16, 3)
    light = kernels.decode(levels)
    assert np.array_equal(kernels.encode(light), levels)
    assert light[0, 0, 0] == 0.0 and light[-1, -1, 0] == 1.0
    assert light.ravel()[3 * 188] == pytest.approx(0.5, abs=0.005)  # IEC 61966-2-1
    bounds = kernels.encode(np.array([[[-1.0, 0.0, 7.0]]], np.float32))
    assert bounds.tolist() == [[[0, 0, 255]]]


@pytest.mark.parametrize(
    "settings",
    [
        EffectSettings(soft_shadows=True),
        EffectSettings(motion_blur=(2.0, 6.0)),
        EffectSettings(exposure=(-1.0, 1.0)),
        EffectSettings(white_balance=0.2),
        EffectSettings(bayer_noise=True),
    ],
    ids=["shadows", "blur", "exposure", "balance", "noise"],
)
def test_each_effect_repeats_with_its_seed_and_changes_the_image(
    settings: EffectSettings, scene: Content, view: View
) -> None:
    image = random_image()
    before = image.copy()
    first, again = (applied(settings, image, scene, view, 5) for _ in range(2))
    assert np.array_equal(image, before)
    assert first.dtype == np.uint8 and first.shape == image.shape
    assert np.array_equal(first, again) and not np.array_equal(first, image)
    other = applied(settings, image, scene, view, 6)
    assert np.array_equal(first, other) == settings.soft_shadows


def test_exposure_is_in_stops_and_balance_in_gains(scene: Content, view: View) -> None:
    brighter = applied(EffectSettings(exposure=(1.0, 1.0)), grey(100), scene, view)
    assert kernels.decode(brighter)[0, 0, 0] == pytest.approx(2 * kernels.decode(grey(100))[0, 0, 0], rel=0.01)
    gains = [
        kernels.decode(applied(EffectSettings(white_balance=0.3), grey(100), scene, view, seed))[0, 0]
        / kernels.decode(grey(100))[0, 0]
        for seed in range(30)
    ]
    red, green, blue = np.transpose(gains)
    assert np.allclose(green, 1.0, atol=0.01)
    for gain in (red, blue):
        assert 0.69 < gain.min() < 0.85 and 1.15 < gain.max() < 1.31
    assert abs(np.corrcoef(red, blue)[0, 1]) < 0.6


def test_shadows_darken_light_that_adds_up_in_display_values_more(scene: Content, view: View) -> None:
    """What is left of a display value v under a share s of the light is s v; in linear space that is less."""
    linear, display = (
        Effects(EffectSettings(soft_shadows=True), CAMERA, linear=linear).apply(
            grey(150), scene, view, VIEW, np.random.default_rng(0)
        )
        for linear in (True, False)
    )
    from simtrack.datasets.shadows import remaining_light

    left = remaining_light(scene, view, VIEW, CAMERA)
    shadow = left[..., 0] < 0.6
    assert shadow.sum() > 100 and (linear[~(left[..., 0] < 1.0)] == 150).all()
    assert np.abs(display[shadow] - 150 * left[shadow]).max() < 6
    wanted = kernels.decode(grey(150))[shadow] * left[shadow]
    assert np.abs(kernels.decode(linear)[shadow] - wanted).max() < 0.01


# ---------------------------------------------------------------------------------------------------------- motion blur


def test_no_motion_blurs_nothing_and_even_light_stays_even() -> None:
    light = kernels.decode(random_image())
    depth = np.full(SHAPE, 1.0, np.float32)
    assert np.array_equal(motion_blur(light, depth, CAMERA, np.eye(4)), light)
    even = np.full((*SHAPE, 3), 0.37, np.float32)
    moving = draw_motion(9.0, depth, CAMERA, np.random.default_rng(1))
    assert np.allclose(motion_blur(even, depth, CAMERA, moving), 0.37, atol=1e-6)


def smear(T_end_start: Float64, depth: float) -> np.ndarray:
    """(H, W), a white dot in the middle of the image after a motion."""
    light = np.zeros((*SHAPE, 3), np.float32)
    light[60, 80] = 1.0
    return motion_blur(light, np.full(SHAPE, depth, np.float32), CAMERA, T_end_start)[..., 0]


@pytest.mark.parametrize(
    ("T", "depth", "along"),
    [
        (transform(exp_so3(np.array([0.0, 0.08, 0.0]))), 1.0, (12.0, 0.0)),
        (transform(exp_so3(np.array([0.06, 0.0, 0.0]))), 0.0, (0.0, -9.0)),
        (transform(None, (0.06, 0.06, 0.0)), 0.9, (10.0, 10.0)),
        (transform(None, (0.06, 0.0, 0.0)), 1.8, (5.0, 0.0)),
    ],
    ids=["turn", "turn, far away", "move", "move, twice as far away"],
)
def test_a_dot_is_smeared_along_its_motion_about_where_it_was(
    T: Float64, depth: float, along: tuple[float, float]
) -> None:
    blurred = smear(T, depth)
    rows, columns = np.nonzero(blurred)
    weights = blurred[rows, columns] / blurred.sum()
    assert blurred.sum() == pytest.approx(1.0, abs=0.15)  # light is not lost
    assert (weights @ columns, weights @ rows) == pytest.approx((80, 60), abs=0.6)
    assert (np.ptp(columns) + 1, np.ptp(rows) + 1) == pytest.approx((abs(along[0]) + 1, abs(along[1]) + 1), abs=1.1)
    if all(along):
        assert np.corrcoef(columns, rows)[0, 1] * np.sign(along[0] * along[1]) > 0.9


def test_the_drawn_motion_moves_the_image_as_far_as_asked(view: View) -> None:
    for seed in range(20):
        T = draw_motion(7.0, view.depth, CAMERA, np.random.default_rng(seed))
        middle = np.array([0.0, 0.0, np.median(view.depth[view.depth > 0]), 1.0])
        moved = T @ middle
        assert np.hypot(moved[0], moved[1]) / moved[2] * CAMERA.fx == pytest.approx(7.0, rel=0.12)
    assert np.isfinite(draw_motion(3.0, np.zeros(SHAPE, np.float32), CAMERA, np.random.default_rng(0))).all()


# ------------------------------------------------------------------------------------------------------------- sensor


def test_a_sensor_without_noise_shows_smooth_colours_as_they_are() -> None:
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]] / 200.0
    light = np.stack([0.1 + 0.5 * u, 0.2 + 0.5 * v, 0.7 - 0.5 * u], axis=2).astype(np.float32)
    read = bayer_noise(light, QUIET, 1.0, np.random.default_rng(0))
    assert np.abs(read - light)[2:-2, 2:-2].max() < 0.005
    for channel in range(3):  # each colour lands in its own channel
        pure = np.zeros((*SHAPE, 3), np.float32)
        pure[..., channel] = 0.5
        assert np.abs(bayer_noise(pure, QUIET, 1.0, np.random.default_rng(0)) - pure)[2:-2, 2:-2].max() < 1e-3


def test_noise_has_the_variance_of_photons_and_reading() -> None:
    """Of the counts before demosaicing: EMVA 1288's photon transfer, (e + read^2) / full well^2."""
    sensor = BayerSensor(full_well=4000.0, read_noise=8.0, bits=16, red_gain=2.0, blue_gain=2.0)
    normal = np.random.default_rng(3).standard_normal((400, 400), dtype=np.float32)
    top = (1 << 16) - 1
    balance = np.array([0.5, 1.0, 0.5], np.float32)
    for value in (0.1, 0.4):
        light = np.full((400, 400, 3), value, np.float32)
        counts = kernels.expose(light, normal, balance, np.float32(4000.0), np.float32(8.0), top) / top
        for site, share in ((counts[::2, ::2], 0.5), (counts[::2, 1::2], 1.0), (counts[1::2, 1::2], 0.5)):
            electrons = 4000.0 * share * value
            assert site.mean() == pytest.approx(share * value, rel=0.005)
            assert site.std() == pytest.approx(np.sqrt(electrons + 64.0) / 4000.0, rel=0.03)
    noisy = [bayer_noise(light, sensor, gain, np.random.default_rng(1)).std() for gain in (1.0, 4.0)]
    assert noisy[1] > 1.7 * noisy[0]  # a quarter of the photons, twice the noise
    assert bayer_noise(light, sensor, 1.0, np.random.default_rng(1)).mean() == pytest.approx(0.4, rel=0.01)


def test_white_stays_white() -> None:
    """A sensor has headroom in the colours that are raised, and no cast where it saturates."""
    read = bayer_noise(np.full((*SHAPE, 3), 1.0, np.float32), BayerSensor(), 1.0, np.random.default_rng(0))
    assert np.abs(read.mean(axis=(0, 1)) - 1.0).max() < 0.02
    glare = bayer_noise(np.full((*SHAPE, 3), 5.0, np.float32), BayerSensor(), 1.0, np.random.default_rng(0))
    assert (kernels.encode(glare) == 255).all()


@pytest.mark.parametrize(
    ("field", "value"), [("full_well", 0.0), ("read_noise", -1.0), ("bits", 20), ("most_gain", float("nan"))]
)
def test_impossible_sensors_are_refused(field: str, value: float) -> None:
    with pytest.raises(InvalidValueError, match=field):
        BayerSensor(**{field: value})  # pyright: ignore[reportArgumentType]
