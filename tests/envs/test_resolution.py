import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics
from simtrack.envs.resolution import noise_in_small_images, stack_config
from simtrack.perception.stack_config import StackConfig
from simtrack.sensors.depth_noise import PRESETS, apply_depth_noise


def test_at_full_size_the_settings_are_the_usual_ones() -> None:
    full, usual = stack_config(1.0), StackConfig()
    assert full.tracker == usual.tracker and full.presegmentation == usual.presegmentation


@pytest.mark.parametrize("scale", [0.175, 0.25, 0.5])
def test_settings_stay_usable_however_small_the_image(scale: float) -> None:
    stack = stack_config(scale)
    steps = [*stack.tracker.registration.schedule, *stack.tracker.registration.track_schedule]
    assert all(step.edge_reach >= 2 and step.coarsen >= 1 for step in steps)
    assert stack.presegmentation.stride >= 1 and stack.tracker.min_rays >= 1 and stack.tracker.fit.pixels >= 8


def test_noise_does_not_grow_because_an_image_is_small() -> None:
    """Depth of a plane: the same spread of readings, pixel by pixel, at any size."""
    spreads = []
    for scale in (1.0, 0.25):
        camera = CameraIntrinsics(*(round(640 * scale), round(480 * scale)), *[577.0 * scale] * 2, *[100.0 * scale] * 2)
        values = noise_in_small_images("xtion", scale)
        config = PRESETS["xtion"].__class__(**values)
        flat = np.full((camera.height, camera.width), 1.5, np.float32)
        read = apply_depth_noise(flat, None, camera, config, np.random.default_rng(0))
        spreads.append(float(np.std(read[read > 0])))
    assert spreads[1] == pytest.approx(spreads[0], rel=0.15)
