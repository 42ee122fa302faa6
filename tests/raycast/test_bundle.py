"""Bundles: every ray once, in the caller's order, whatever the packing."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.contracts import CameraIntrinsics
from simtrack.errors import InvalidValueError
from simtrack.raycast import RayBundle, RayScene, TriangleMesh
from simtrack.raycast.kernels import GROUP

CAMERA = CameraIntrinsics(64, 48, 60.0, 55.0, 31.0, 24.0)


def assert_packed(bundle: RayBundle) -> None:
    """Every ray is in some packet, and lanes hold the direction of their ray."""
    assert set(bundle.order.tolist()) == set(range(len(bundle)))
    width = bundle.packed.shape[2] if len(bundle) else 1
    assert len(bundle.order) == -(-len(bundle) // width) * width or bundle.pixels is None
    lanes = bundle.packed.transpose(0, 2, 1).reshape(-1, 3)
    np.testing.assert_array_equal(lanes, bundle.directions[bundle.order])


def test_directions_go_through_pixel_centres() -> None:
    bundle = RayBundle.from_camera(CAMERA)
    assert_packed(bundle)
    assert bundle.pixels is not None
    v, u = np.divmod(bundle.pixels, CAMERA.width)
    np.testing.assert_array_equal(bundle.pixels, np.arange(64 * 48))
    np.testing.assert_allclose(bundle.directions[:, 0] * CAMERA.fx + CAMERA.cx, u, atol=1e-4)
    np.testing.assert_allclose(bundle.directions[:, 1] * CAMERA.fy + CAMERA.cy, v, atol=1e-4)
    assert (bundle.directions[:, 2] == 1).all()


def test_full_image_packets_are_tiles() -> None:
    bundle = RayBundle.from_camera(CAMERA)
    assert bundle.pixels is not None
    width = bundle.packed.shape[2]
    v, u = np.divmod(bundle.pixels[bundle.order].reshape(-1, width), CAMERA.width)
    assert (np.ptp(u, axis=1) == 3).all()
    assert (np.ptp(v, axis=1) == (1 if width == 8 else 3)).all()


def test_strided_windows_take_multiples_of_the_stride() -> None:
    bundle = RayBundle.from_camera(CAMERA, stride=4, window=(5, -3, 30, 1000))
    assert_packed(bundle)
    assert bundle.pixels is not None
    v, u = np.divmod(bundle.pixels, CAMERA.width)
    assert sorted(set(u.tolist())) == [8, 12, 16, 20, 24, 28]
    assert sorted(set(v.tolist())) == list(range(0, 48, 4))
    assert bundle.shape == (12, 6)


@given(st.lists(st.integers(0, 64 * 48 - 1), max_size=200))
@settings(max_examples=50)
def test_any_pixels_keep_their_order(pixels: list[int]) -> None:
    bundle = RayBundle.from_pixels(CAMERA, pixels)
    assert bundle.pixels is not None
    assert bundle.pixels.tolist() == pixels
    assert_packed(bundle)


def test_windows_are_united_without_duplicates() -> None:
    windows = [(0, 0, 20, 20), (10, 10, 40, 30), (60, 40, 80, 90)]
    bundle = RayBundle.from_windows(CAMERA, windows, [1, 2, 1])
    mask = np.zeros((48, 64), bool)
    mask[:20, :20] = mask[40:, 60:] = True
    mask[10:30:2, 10:40:2] = True
    assert bundle.pixels is not None
    np.testing.assert_array_equal(bundle.pixels, np.flatnonzero(mask))
    assert len(RayBundle.from_windows(CAMERA, [], 2)) == 0
    assert len(RayBundle.from_camera(CAMERA, window=(70, 0, 90, 10))) == 0


def test_packing_does_not_change_results() -> None:
    rng = np.random.default_rng(0)
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=2.0)
    directions = rng.normal(size=(1001, 3))
    rings = rng.integers(0, 16, 1001)
    with RayScene() as scene:
        scene.add(TriangleMesh(mesh.vertices, mesh.faces))
        plain = scene.cast(RayBundle.from_directions(directions), np.eye(4))
        bundle = RayBundle.from_directions(directions, groups=rings)
        assert_packed(bundle)
        grouped = scene.cast(bundle, np.eye(4))
        single = scene.cast_rays(np.zeros((1001, 3)), directions, packing=bundle)
    np.testing.assert_allclose(grouped.distances, plain.distances, atol=1e-5)
    np.testing.assert_allclose(single.distances, plain.distances, atol=1e-5)
    ring_of = rings[bundle.order].reshape(-1, bundle.packed.shape[2])
    assert (ring_of == ring_of[:, :1]).all()


def test_misuse_is_told() -> None:
    with pytest.raises(InvalidValueError, match="stride"):
        RayBundle.from_camera(CAMERA, stride=0)
    with pytest.raises(InvalidValueError, match="pixels"):
        RayBundle.from_pixels(CAMERA, [64 * 48])
    with pytest.raises(InvalidValueError, match="directions"):
        RayBundle.from_directions([[0.0, np.nan, 1.0]])
    with pytest.raises(InvalidValueError, match="groups"):
        RayBundle.from_directions(np.eye(3), groups=[1])
    with pytest.raises(InvalidValueError, match="strides"):
        RayBundle.from_windows(CAMERA, [(0, 0, 5, 5)], [1, 2])


def test_lanes_of_a_packet_are_in_the_callers_order() -> None:
    """So that rays side by side in a row of pixels are side by side in a packet."""
    shuffled = np.random.default_rng(0).permutation(64 * 48)[:1003]
    for bundle in (RayBundle.from_camera(CAMERA), RayBundle.from_pixels(CAMERA, shuffled)):
        assert (np.diff(bundle.order.reshape(-1, bundle.packed.shape[2]), axis=1) >= 0).all()


def test_cones_hold_their_rays() -> None:
    rng = np.random.default_rng(0)
    bundles = [
        RayBundle.from_camera(CAMERA),
        RayBundle.from_windows(CAMERA, [(3, 5, 40, 33), (20, 10, 64, 48)], [1, 4]),
        RayBundle.from_directions(rng.normal(size=(777, 3))),
        RayBundle.from_directions(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])),
        RayBundle.from_directions(np.tile([0.3, -2.0, 0.1], (100, 1))),
    ]
    for bundle in bundles:
        width = bundle.packed.shape[2]
        rays = bundle.directions[bundle.order].astype(float)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        group = np.arange(len(rays)) // (GROUP * width)
        cones = bundle.cones.astype(float)
        assert len(cones) == group[-1] + 1
        assert (np.einsum("ij,ij->i", rays, cones[group, :3]) >= cones[group, 3] - 1e-6).all()
        np.testing.assert_allclose(np.hypot(cones[:, 3], cones[:, 4]), 1.0, atol=1e-6)
        np.testing.assert_allclose(cones[:, 5], 1.0 - cones[:, 3], atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(cones[:, :3], axis=1), 1.0, atol=1e-6)


@given(st.integers(0, 2**31), st.integers(1, 3))
@settings(max_examples=40)
def test_windows_hold_the_union_of_their_grids(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.integers(-20, 80, (count, 2, 2))
    windows = [(int(a[0]), int(a[1]), int(b[0]), int(b[1])) for a, b in np.sort(corners, axis=1)]
    strides = rng.integers(1, 6, count).tolist()
    bundle = RayBundle.from_windows(CAMERA, windows, strides)
    expected = np.zeros((48, 64), bool)
    v, u = np.mgrid[:48, :64]
    for (u0, v0, u1, v1), step in zip(windows, strides, strict=True):
        expected |= (u >= u0) & (u < u1) & (v >= v0) & (v < v1) & (u % step == 0) & (v % step == 0)
    assert bundle.pixels is not None
    np.testing.assert_array_equal(bundle.pixels, np.flatnonzero(expected))
