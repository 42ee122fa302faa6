import numpy as np

from simtrack.geometry.projection import NEAREST, bounding_rectangle
from simtrack.geometry.transforms import exp_so3, transform

CAMERA = np.array([500.0, 480.0, 320.0, 240.0])
CORNERS = np.array([[x, y, z] for x in (-0.2, 0.1) for y in (-0.1, 0.3) for z in (-0.05, 0.15)])


def test_the_rectangle_bounds_the_projected_corners() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        T = transform(
            exp_so3(rng.normal(size=3)), (rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), rng.uniform(0.6, 3.0))
        )
        p = CORNERS @ T[:3, :3].T + T[:3, 3]
        pixels = CAMERA[:2] * p[:, :2] / p[:, 2:] + CAMERA[2:]
        shown, *bounds = bounding_rectangle(CORNERS, T, CAMERA)
        assert shown
        np.testing.assert_allclose(bounds, [*pixels.min(axis=0), *pixels.max(axis=0)], rtol=1e-12)


def test_what_reaches_the_camera_has_no_rectangle() -> None:
    for z in (-1.0, 0.0, 0.05 + NEAREST - 1e-6):
        assert not bounding_rectangle(CORNERS, transform(None, (0.0, 0.0, z)), CAMERA)[0]
    assert bounding_rectangle(CORNERS, transform(None, (0.0, 0.0, 0.05 + NEAREST + 1e-6)), CAMERA)[0]
