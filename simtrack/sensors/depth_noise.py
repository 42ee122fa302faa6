"""How depth cameras err: axial and lateral noise, quantisation, shadows, losses; presets of known sensors.

Sources: Nguyen, Izadi, Lovell, *Modeling Kinect Sensor Noise for Improved 3D Reconstruction and Tracking*, 3DIMPVT 2012
(axial and lateral noise); Handa, Whelan, McDonald, Davison, *A Benchmark for RGB-D Visual Odometry, 3D Reconstruction
and SLAM*, ICRA 2014 (simkinect). What is marked as a choice of this project has no measurement behind it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import numpy.typing as npt

from simtrack.contracts import CameraIntrinsics, Float32, Float64
from simtrack.errors import InvalidValueError, UnknownNameError

if TYPE_CHECKING:
    from simtrack.sensors.depth_kernels import Parameters

LATERAL_MODES = ("none", "edges", "everywhere")
"""Where pixels read the depth of a neighbour."""

SIMKINECT_BIAS = -0.5 * 100.0 / 35130.0
"""1/m: the simkinect preset reads z wrong by about this times z^2, because its formula adds 0.5 before it rounds."""


@dataclass(frozen=True, slots=True)
class DepthNoiseConfig:
    """How a depth camera errs; every part can be switched off by itself. The defaults are the preset ``xtion``."""

    axial_offset: float = 0.0012
    """Metres: sigma_z = axial_offset + axial_quadratic (z - axial_origin)^2, of the reading as a whole: what Nguyen et
    al. measured includes quantisation, so the noise added before rounding has the rounding's variance removed."""
    axial_quadratic: float = 0.0019
    """1/m."""
    axial_origin: float = 0.4
    """Metres."""
    axial_grazing: float = 0.0001
    """Beyond 60 deg of incidence sigma_z grows by axial_grazing / sqrt(z) theta^2 / (pi/2 - theta)^2; 0 = off."""
    max_incidence: float = np.deg2rad(80.0)
    """Radians: theta is clamped here in both formulas, which diverge at 90 deg."""
    correlated_share: float = 0.4
    """Share of the axial variance that is correlated between neighbours (structured light matches windows); the rest is
    white. Plane residuals of a PrimeSense camera correlate by 0.2 to 0.35 at 1 to 8 px, rounding included."""
    correlation_window: int = 9
    """Pixels, odd: width of the normalised window that smooths the correlated part."""
    lateral: str = "edges"
    """Where pixels read a neighbour's depth: ``none``, ``edges`` (at depth edges) or ``everywhere``."""
    lateral_sigma: float = 0.8
    """Pixels: sigma_L = lateral_sigma + lateral_grazing theta / (pi/2 - theta)."""
    lateral_grazing: float = 0.035
    """Pixels."""
    edge_disparity: float = 0.25
    """Pixels of disparity (at `focal` and `quantisation_baseline`): second difference that makes a depth edge."""
    disparity_step: float = 0.125
    """Pixels: disparity is rounded to multiples of it; 0 = not at all."""
    focal: float = 577.0
    """Pixels, of the sensor's own disparity image."""
    quantisation_baseline: float = 0.075
    """Metres, with which disparity is computed."""
    shadow_baseline: float = 0.075
    """Metres from camera to projector along +x of the image, negative for one on the other side; what the projector
    cannot see has no reading. 0 = off. Only what is in the image casts a shadow."""
    grazing_dropout: float = np.deg2rad(82.0)
    """Radians of incidence at which half of the readings are lost; pi/2 = off. A choice of this project."""
    grazing_width: float = np.deg2rad(1.5)
    """Radians over which that loss sets in (logistic). A choice of this project."""
    albedo_floor: float = 0.04
    """Infrared albedo at which half of the readings at `max_range` are lost; that albedo falls with the square of the
    depth. Needs an albedo image; 0 = off. A choice of this project."""
    dropout: float = 0.0005
    """Share of readings lost for no reason. A choice of this project."""
    flying_pixels: float = 0.0
    """Share of pixels at depth edges that mix the depths on both sides (time of flight). A choice of this project."""
    simkinect: bool = False
    """Last step of Handa et al.: z = 35130 / round(35130 / round(100 z) + N(0, 1/6) + 0.5) / 100."""
    min_range: float = 0.4
    """Metres; nearer surfaces give no reading."""
    max_range: float = 8.0
    """Metres; farther surfaces give no reading."""

    def __post_init__(self) -> None:
        amounts = (
            "axial_offset axial_quadratic axial_origin axial_grazing lateral_sigma lateral_grazing edge_disparity "
            "disparity_step albedo_floor"
        )
        for name in amounts.split():
            if not 0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(name, getattr(self, name), ">= 0 and finite")
        for name in ("correlated_share", "dropout", "flying_pixels"):
            if not 0 <= getattr(self, name) <= 1:
                raise InvalidValueError(name, getattr(self, name), "a share, 0..1")
        for name in ("focal", "quantisation_baseline", "grazing_width"):
            if not 0 < getattr(self, name) < np.inf:
                raise InvalidValueError(name, getattr(self, name), "> 0 and finite")
        if not 0 <= self.max_incidence < np.pi / 2 or not 0 < self.grazing_dropout <= np.pi / 2:
            value = (self.max_incidence, self.grazing_dropout)
            raise InvalidValueError("max_incidence, grazing_dropout", value, "radians below pi/2 (dropout: up to pi/2)")
        if self.correlation_window < 1 or self.correlation_window % 2 == 0:
            raise InvalidValueError("correlation_window", self.correlation_window, "an odd number of pixels >= 1")
        if not np.isfinite(self.shadow_baseline):
            raise InvalidValueError("shadow_baseline", self.shadow_baseline, "finite metres")
        if self.lateral not in LATERAL_MODES:
            raise UnknownNameError("lateral mode", self.lateral, LATERAL_MODES)
        if not 0 <= self.min_range < self.max_range:
            raise InvalidValueError("min_range, max_range", (self.min_range, self.max_range), "0 <= min < max")

    def sigma(self, z: npt.ArrayLike, theta: npt.ArrayLike = 0.0) -> Float64:
        """Standard deviation of a reading, metres, at depth z (metres) and incidence theta (radians); broadcasts."""
        depth, angle = np.asarray(z, dtype=np.float64), np.clip(np.abs(theta), 0.0, self.max_incidence)
        sigma = self.axial_offset + self.axial_quadratic * (depth - self.axial_origin) ** 2
        grazing = self.axial_grazing / np.sqrt(np.maximum(depth, 1e-3)) * angle**2 / (np.pi / 2 - angle) ** 2
        return np.asarray(sigma + np.where(angle > np.deg2rad(60.0), grazing, 0.0))


def _off(**changes: float | str | bool) -> DepthNoiseConfig:
    """A config with every part off but the given ones."""
    nothing: dict[str, float | str | bool] = {
        "axial_offset": 0.0, "axial_quadratic": 0.0, "axial_origin": 0.0, "axial_grazing": 0.0,
        "correlated_share": 0.0, "correlation_window": 1, "lateral": "none", "disparity_step": 0.0,
        "shadow_baseline": 0.0, "grazing_dropout": np.pi / 2, "albedo_floor": 0.0, "dropout": 0.0, "min_range": 0.0,
        "max_range": 1e6,
    }  # fmt: skip
    return DepthNoiseConfig(**(nothing | changes))  # pyright: ignore[reportArgumentType]


PRESETS: Mapping[str, DepthNoiseConfig] = MappingProxyType(
    {
        "xtion": DepthNoiseConfig(),
        # Biased as published: reads short by about 1.4 z^2 mm (see SIMKINECT_BIAS).
        "simkinect": _off(
            lateral="everywhere", lateral_sigma=0.5, lateral_grazing=0.0, disparity_step=0.125, simkinect=True,
            min_range=0.4, max_range=8.0,
        ),
        # Time of flight, approximate: 1.5 mm at 1 m growing with z^2, flying pixels at edges.
        "kinect_v2": _off(
            axial_quadratic=0.0015, focal=366.0, flying_pixels=0.5, grazing_dropout=np.deg2rad(85.0),
            dropout=0.0005, min_range=0.5, max_range=4.5,
        ),
        # Active stereo, approximate: 0.1 px of subpixel noise at f = 640 px and a baseline of 50 mm, window matching.
        "realsense": _off(
            axial_quadratic=0.1 / (640.0 * 0.05), correlated_share=0.6, correlation_window=9, lateral="edges",
            disparity_step=1.0 / 32.0, focal=640.0, quantisation_baseline=0.05, shadow_baseline=0.05,
            grazing_dropout=np.deg2rad(84.0), dropout=0.001, min_range=0.3, max_range=6.0,
        ),
        "ideal": _off(),
    }
)  # fmt: skip
"""Known sensors by name."""


def preset(name: str) -> DepthNoiseConfig:
    """The preset called `name`; UnknownNameError lists the known ones."""
    if name not in PRESETS:
        raise UnknownNameError("depth noise preset", name, PRESETS)
    return PRESETS[name]


def axial_sigma(z: npt.ArrayLike, theta: npt.ArrayLike = 0.0) -> Float64:
    """Standard deviation, metres, of an Xtion's depth reading: the estimator's own model of its sensor.

    Args:
        z: depth, metres.
        theta: incidence, radians from the surface's normal; clamped at 80 deg.
    """
    return PRESETS["xtion"].sigma(z, theta)


DepthDraws: TypeAlias = tuple[Float32, npt.NDArray[np.uint32], Float32]
"""The random numbers of one image, see `draw_depth_noise`."""


def apply_depth_noise(
    depth_true: Float32,
    normals: Float32 | None,
    intrinsics: CameraIntrinsics,
    config: DepthNoiseConfig,
    rng: np.random.Generator,
    albedo: Float32 | None = None,
    draws: DepthDraws | None = None,
) -> Float32:
    """What the sensor reads of a true depth image.

    All random numbers of a frame are drawn before the image is looked at, the same number for every image of a size.

    Args:
        depth_true: (H, W), metres along the optical axis; 0, negative or non-finite = nothing there.
        normals: (H, W, 3), unit, camera frame, either side; None takes them from the depth image's own differences.
        intrinsics: of the image.
        config: the noise.
        rng: the source of randomness.
        albedo: (H, W), 0..1 in the infrared, or None for no losses on dark surfaces.
        draws: from `draw_depth_noise`, for an image of this size; None draws from `rng` now.

    Returns:
        (H, W) float32, metres, 0 = no reading, never NaN.

    Raises:
        InvalidValueError: the arrays' shapes do not match the intrinsics.
    """
    from simtrack.sensors import depth_kernels as kernels

    shape = (intrinsics.height, intrinsics.width)
    depth = np.ascontiguousarray(depth_true, np.float32)
    for name, array, wanted in (
        ("depth_true", depth, shape),
        ("normals", normals, (*shape, 3)),
        ("albedo", albedo, shape),
    ):
        if array is not None and array.shape != wanted:
            raise InvalidValueError(name, array.shape, f"shape {wanted}, as the intrinsics say")
    axial, shifts, uniform = draw_depth_noise(intrinsics, config, rng) if draws is None else draws
    parameters = _kernel_parameters(config)
    camera = (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy)
    inverse = kernels.inverse_depth(depth)
    if normals is None:
        cosines = kernels.cosines_from_depth(inverse, *camera)
    else:
        cosines = kernels.cosines_from_normals(np.ascontiguousarray(normals, np.float32), *camera)
    hidden, source, dark = np.zeros(shape, np.bool_), np.empty(0, np.int32), np.empty(0, np.float32)
    if config.shadow_baseline != 0:
        side = (
            1 if config.shadow_baseline > 0 else -1
        )  # a projector on the left is one on the right of the mirror image
        reach = np.float32(intrinsics.fx * abs(config.shadow_baseline))
        hidden = np.ascontiguousarray(
            kernels.projector_shadow(np.ascontiguousarray(inverse[:, ::side]), reach)[:, ::side]
        )
    if config.lateral != "none" or config.flying_pixels > 0:
        threshold = np.float32(config.edge_disparity / (config.focal * config.quantisation_baseline))
        edges = kernels.depth_edges(inverse, threshold)
        if config.lateral != "none":
            everywhere = config.lateral == "everywhere"
            source = kernels.sources(cosines, edges, shifts, kernels.normal_quantiles(), everywhere, parameters).ravel()
        if config.flying_pixels > 0:
            inverse = kernels.fly(inverse, edges, uniform[1], config.flying_pixels)
    if albedo is not None:
        dark = np.ascontiguousarray(albedo, np.float32).ravel()
    flat = (inverse.ravel(), cosines.ravel(), hidden.ravel(), source, dark, axial.ravel(), uniform[0].ravel())
    return kernels.read_depth(*flat, config.simkinect, parameters).reshape(shape)


@lru_cache(maxsize=8)
def _kernel_parameters(config: DepthNoiseConfig) -> "Parameters":
    from simtrack.sensors.depth_kernels import Parameters

    grazing_cosine = np.cos(config.grazing_dropout - 8.0 * config.grazing_width)
    return Parameters(
        *np.array(
            [
                config.axial_offset, config.axial_quadratic, config.axial_origin, config.axial_grazing,
                config.max_incidence, config.lateral_sigma, config.lateral_grazing,
                config.disparity_step / (config.focal * config.quantisation_baseline),
                config.grazing_dropout, config.grazing_width,
                grazing_cosine if config.grazing_dropout < np.pi / 2 else -1.0,
                config.albedo_floor / config.max_range**2, config.dropout, config.flying_pixels,
                config.min_range, config.max_range,
            ],
            np.float32,
        )
    )  # fmt: skip


def draw_depth_noise(intrinsics: CameraIntrinsics, config: DepthNoiseConfig, rng: np.random.Generator) -> DepthDraws:
    """The randomness of one image, which does not depend on what is in it: so it can be drawn ahead of time.

    Returns axial noise (H, W) of unit variance, random bits (H, W) for lateral shifts, uniform numbers (1 or 2, H, W).
    """
    from simtrack.sensors import depth_kernels as kernels

    shape = (intrinsics.height, intrinsics.width)
    axial = np.zeros((0, 0), np.float32)
    if config.simkinect or config.axial_offset or config.axial_quadratic or config.axial_grazing:
        axial = rng.standard_normal(shape, dtype=np.float32)
        if config.correlated_share > 0 and config.correlation_window > 1:
            # A weighted sum of this many uniform numbers is normal for all purposes, and they are cheaper to draw.
            pad = config.correlation_window - 1
            white = rng.random((shape[0] + pad, shape[1] + pad), dtype=np.float32)
            kernels.blend_correlated(axial, white, kernels.window(config.correlation_window), config.correlated_share)
    shifts = np.zeros((0, 0), np.uint32)
    if config.lateral != "none":
        shifts = rng.integers(1 << 32, size=shape, dtype=np.uint32)
    return axial, shifts, rng.random((2 if config.flying_pixels > 0 else 1, *shape), dtype=np.float32)
