"""What makes rendered colours look photographed: shadows, motion blur, exposure, a sensor's noise and mosaic, balance.

Light is linear in between: an 8-bit image is decoded, shaded, blurred, exposed, read by the sensor, balanced and
encoded again. All labels stay those of the middle of the exposure.
"""

from dataclasses import dataclass

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float32, Float64, Uint8
from simtrack.datasets import effect_kernels as kernels
from simtrack.datasets.annotate import View
from simtrack.datasets.content import Content
from simtrack.datasets.recipe import EffectSettings
from simtrack.datasets.shadows import remaining_light
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import exp_so3, transform

DISPLAY_GAMMA = 2.2
"""Renderers that add light up in display values darken there; the linear image then falls with this power of it."""
FAR = 1e3
"""Metres: how far away what has no depth is taken to be."""


@dataclass(frozen=True, slots=True)
class BayerSensor:
    """A colour sensor by the linear camera model of EMVA 1288 (release 4.0), under a pattern of red, green and blue.

    A choice of this project: figures of a small CMOS camera of 2 to 3 um pixels.
    """

    full_well: float = 8000.0
    """Electrons of a pixel that is white at the lowest gain."""
    read_noise: float = 6.0
    """Electrons, standard deviation."""
    bits: int = 10
    """Of the converter."""
    red_gain: float = 1.9
    """By which red is raised to balance white: by so much less light is under the red filter."""
    blue_gain: float = 1.6
    """Likewise."""
    most_gain: float = 8.0
    """Highest analogue gain; a frame's is drawn between 1 and this, evenly in stops. It lowers the full well."""

    def __post_init__(self) -> None:
        for name in ("full_well", "red_gain", "blue_gain", "most_gain"):
            if not 1.0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(f"BayerSensor.{name}", getattr(self, name), "a finite number >= 1")
        if not 0.0 <= self.read_noise < np.inf:
            raise InvalidValueError("BayerSensor.read_noise", self.read_noise, "a finite number >= 0, electrons")
        if not 6 <= self.bits <= 16:
            raise InvalidValueError("BayerSensor.bits", self.bits, "6..16")


class Effects:
    """Applies what a recipe asks for; nothing is drawn from the random source for what is off."""

    def __init__(
        self,
        settings: EffectSettings,
        intrinsics: CameraIntrinsics,
        linear: bool,
        sensor: BayerSensor | None = None,
    ) -> None:
        """Choose the effects.

        Args:
            settings: which, of the recipe. Antialiasing is the renderers' (samples a pixel).
            intrinsics: of the images.
            linear: whether the renderer adds light up in linear space (pyrender) or in display values (MuJoCo).
            sensor: that reads images if there is to be noise; a usual one if None.
        """
        self._settings, self._intrinsics = settings, intrinsics
        self._shadow_power = 1.0 if linear else DISPLAY_GAMMA
        self._sensor = sensor or BayerSensor()

    @property
    def active(self) -> bool:
        """Whether `apply` changes anything."""
        settings = self._settings
        amounts = *settings.exposure, settings.white_balance, settings.motion_blur[1]
        return bool(settings.soft_shadows or settings.bayer_noise or any(amounts))

    def apply(self, rgb: Uint8, content: Content, view: View, T_map_camera: Float64, rng: np.random.Generator) -> Uint8:
        """The image (H, W, 3) as a camera would have taken it.

        Args:
            rgb: (H, W, 3), sRGB, as rendered without shadows.
            content: the scene.
            view: of it, from `Annotator.look`.
            T_map_camera: (4, 4), at the middle of the exposure.
            rng: decides on motion, exposure, noise and white balance.
        """
        settings = self._settings
        if not self.active:
            return rgb
        light = kernels.decode(rgb)
        if settings.soft_shadows:
            left = remaining_light(content, view, T_map_camera, self._intrinsics)
            kernels.darken(light, left, np.float32(self._shadow_power))
        if settings.motion_blur[1] > 0.0:
            pixels = rng.uniform(*settings.motion_blur)
            T_end_start = draw_motion(pixels, view.depth, self._intrinsics, rng)
            light = motion_blur(light, view.depth, self._intrinsics, T_end_start)
        if any(settings.exposure):
            light *= np.float32(2.0 ** rng.uniform(*settings.exposure))
        if settings.bayer_noise:
            gain = float(2.0 ** rng.uniform(0.0, np.log2(self._sensor.most_gain)))
            light = bayer_noise(light, self._sensor, gain, rng)
        if settings.white_balance:
            red, blue = 1.0 + settings.white_balance * rng.uniform(-1.0, 1.0, 2)
            light *= np.array([red, 1.0, blue], np.float32)
        return kernels.encode(light)


def motion_blur(light: Float32, depth: Float32, intrinsics: CameraIntrinsics, T_end_start: Float64) -> Float32:
    """Blur what a camera sees that moves while its shutter is open, about the middle of its motion.

    Args:
        light: (H, W, 3), linear.
        depth: (H, W), metres along the optical axis; 0 = far away.
        intrinsics: of both.
        T_end_start: (4, 4), the start's camera frame seen from the end's: small.
    """
    camera = (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy)
    return kernels.blur(light, depth, np.ascontiguousarray(T_end_start, np.float64), camera, FAR)


def draw_motion(pixels: float, depth: Float32, intrinsics: CameraIntrinsics, rng: np.random.Generator) -> Float64:
    """(4, 4) T_end_start of a camera that turns and moves sideways, so that the image moves by about `pixels`.

    The share of the turn is drawn, and the direction; what is nearer than the median depth moves farther.
    """
    seen = depth[::8, ::8]
    seen = seen[seen > 0.0]
    middle = float(np.median(seen)) if len(seen) else 1.0
    angle, turned = rng.uniform(0.0, 2.0 * np.pi), rng.uniform()
    x, y = np.cos(angle) * pixels / intrinsics.fx, np.sin(angle) * pixels / intrinsics.fy
    turn = exp_so3(turned * np.array([-y, x, 0.0]))
    return transform(turn, (1.0 - turned) * middle * np.array([x, y, 0.0]))


def bayer_noise(light: Float32, sensor: BayerSensor, gain: float, rng: np.random.Generator) -> Float32:
    """Read a linear image (H, W, 3), 1 = white, through a pattern RG/GB with photon and read noise, and demosaic it.

    Photon noise is taken as normal, with the variance of Poisson's. What exceeds white saturates before the balance.
    """
    import cv2

    normal = rng.standard_normal(light.shape[:2], dtype=np.float32)
    top = (1 << sensor.bits) - 1
    balance = np.array([1.0 / sensor.red_gain, 1.0, 1.0 / sensor.blue_gain], np.float32)
    raw = kernels.expose(
        light, normal, balance, np.float32(sensor.full_well / gain), np.float32(sensor.read_noise), top
    )
    cv2.setNumThreads(1)
    counts = cv2.demosaicing(raw, cv2.COLOR_BayerBG2RGB)  # OpenCV names patterns after their second row and column
    return counts.astype(np.float32) / (np.float32(top) * balance)
