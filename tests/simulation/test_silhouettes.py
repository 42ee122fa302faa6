import numpy as np

from simtrack.contracts import CameraIntrinsics
from simtrack.geometry.transforms import transform
from simtrack.simulation.silhouettes import RAYS, silhouette_rays

CAMERA = CameraIntrinsics(160, 120, 150.0, 150.0, 79.5, 59.5)
BOX = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)])


def _rays(*positions: tuple[float, float, float]):
    poses = np.array([transform(None, position) for position in positions])
    return silhouette_rays(np.tile(BOX, (len(positions), 1, 1)), poses, CAMERA)


def test_rays_cover_the_projected_box_on_the_pixel_grid() -> None:
    owners, rays, flat, area = _rays((0.0, 0.0, 1.0))
    pixels = rays[:, :2] * 150.0 + (79.5, 59.5)
    stride = round(float(np.sqrt(area[0])))
    assert (owners == 0).all()
    np.testing.assert_array_equal(flat, pixels.round() @ (1, CAMERA.width))
    np.testing.assert_allclose(pixels, pixels.round(), atol=1e-4)
    half = 150.0 * 0.1 / 0.9  # of the nearer side
    assert pixels[:, 0].min() <= 79.5 - half and pixels[:, 0].max() >= 79.5 + half - stride
    assert abs(len(rays) * stride**2 / (2 * half) ** 2 - 1.0) < 0.3


def test_large_silhouettes_are_sampled_more_coarsely() -> None:
    owners, _, _, area = _rays((0.0, 0.0, 0.4), (0.0, 0.0, 2.0))
    counts = np.bincount(owners)
    assert area[0] > 1.0 and area[1] == 1.0
    assert counts[0] < 4 * RAYS


def test_what_lies_beside_the_image_or_behind_the_camera_has_no_rays() -> None:
    owners, _, flat, area = _rays((5.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.53, 0.0, 1.0), (0.0, -3.0, 1.0))
    assert set(owners.tolist()) == {2}
    assert (flat >= 0).any() and (flat == -1).any()  # half of it is in the image
    assert np.flatnonzero(area).tolist() == [2]
