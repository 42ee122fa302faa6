"""Small images: the stack's settings count pixels of a 640x480 image, and so does the model of the sensor's noise."""

from dataclasses import replace
from typing import Any

from simtrack.perception.stack_config import StackConfig
from simtrack.perception.tracking.registration_config import RegistrationConfig, Step
from simtrack.sensors.depth_noise import PRESETS

LIDAR_SEGMENTS = 3
"""Every how many-th scan is segmented: what stands in the way of a robot stands there for longer than half a second."""
FEWEST_RAYS, FEWEST_EDGES = 8, 4
"""However small an image is, so many rays must confirm a pose, and so many silhouette pixels a new object."""
LEAST_SUPPORT = 0.8
"""However few rays meet a new object, this share of them has to confirm it."""


def stack_config(scale: float) -> StackConfig:
    """Settings for images with `scale` times as many pixels a radian: lengths and areas in pixels follow."""
    stack = StackConfig()
    tracker, fit, seen = stack.tracker, stack.tracker.fit, stack.presegmentation
    fit = replace(
        fit,
        pixels=max(FEWEST_RAYS, round(fit.pixels * scale**2)),
        edges=max(FEWEST_EDGES, round(fit.edges * scale)),
        # Shares and means of fewer rays scatter more: as one over the root of their number.
        support=max(LEAST_SUPPORT, 1.0 - (1.0 - fit.support) / scale),
        misfit=1.0 + (fit.misfit - 1.0) / scale,
        good_misfit=1.0 + (fit.good_misfit - 1.0) / scale,
    )
    tracker = replace(
        tracker,
        registration=_registration(tracker.registration, scale),
        fit=fit,
        min_rays=max(FEWEST_RAYS, round(tracker.min_rays * min(scale * 2.0, 1.0))),
    )
    seen = replace(
        seen,
        stride=max(1, round(seen.stride * scale)),
        min_pixels=max(6, round(seen.min_pixels * scale**2)),
        growth=max(1, round(seen.growth * scale)),
        join=seen.join / scale,
    )
    joints = replace(stack.articulation, registration=tracker.registration)
    return replace(
        stack,
        tracker=tracker,
        articulation=joints,
        presegmentation=seen,
        lidar_presegmentation_every=LIDAR_SEGMENTS,
    )


def _registration(config: RegistrationConfig, scale: float) -> RegistrationConfig:
    def scaled(step: Step) -> Step:
        coarsen = max(1, round(step.coarsen * scale))
        return replace(step, edge_reach=max(2, round(step.edge_reach * scale)), coarsen=coarsen)

    return replace(
        config,
        schedule=tuple(scaled(step) for step in config.schedule),
        track_schedule=tuple(scaled(step) for step in config.track_schedule),
        near=scaled(config.near),
        # In small images every step looks at each pixel anyhow: one more at full resolution would tell nothing new.
        finish=None if scale <= 0.5 else config.finish,
        correlation_area=max(1.0, config.correlation_area * scale**2),
        edge_correlation=max(1.0, config.edge_correlation * scale),
    )


def noise_in_small_images(preset: str, scale: float) -> dict[str, Any]:
    """Fields of a depth noise preset that are lengths in pixels of the image, for images `scale` times as large.

    Quantisation is that of the sensor's own disparity image, whose size does not change.
    """
    config = PRESETS[preset]
    half = round((config.correlation_window - 1) / 2 * scale)
    return {
        "correlation_window": 2 * half + 1,
        "lateral_sigma": config.lateral_sigma * scale,
        "lateral_grazing": config.lateral_grazing * scale,
    }
