"""Meshes of what one scan or one depth image saw lie on what was seen, face it, and bridge nothing."""

import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics, Float64, LidarScan, RgbdFrame
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import Mesh, area, box_mesh, face_normals, transformed
from simtrack.geometry.transforms import transform
from simtrack.perception.mapping import ScanMeshConfig, mesh_of_depth, mesh_of_scan
from simtrack.raycast import RayScene, TriangleMesh
from simtrack.sensors.lidar import VLP16

CAMERA = CameraIntrinsics(160, 120, 140.0, 140.0, 79.5, 59.5)
COARSE = ScanMeshConfig(columns=40)


def image(depth: np.ndarray) -> RgbdFrame:
    return RgbdFrame(0, depth.astype(np.float32), None, CAMERA, np.eye(4))


def tilted_plane(noise: float = 0.0) -> np.ndarray:
    """Depth of the plane z = 2 + 0.4 x."""
    u = np.tile(np.arange(160.0), (120, 1))
    depth = 2.0 / (1.0 - 0.4 * (u - 79.5) / 140.0)
    return depth + noise * np.random.default_rng(0).normal(size=depth.shape)


def scan_of(meshes: list[Mesh], noise: float = 0.0) -> LidarScan:
    """One turn at the origin."""
    shots, scene = VLP16.shots(), RayScene()
    for mesh in meshes:
        scene.add(TriangleMesh(mesh.vertices.astype(np.float32), mesh.faces))
    ranges = scene.cast_rays(np.zeros_like(shots.directions), shots.directions).distances
    ranges = ranges + noise * np.random.default_rng(0).normal(size=len(ranges)).astype(np.float32)
    none = np.zeros(len(shots), np.float32)
    return LidarScan(0, shots.directions, ranges.astype(np.float32), shots.times, shots.rings, none, np.eye(4))


def faces_the_origin(mesh: Mesh) -> bool:
    return bool((np.einsum("ij,ij->i", face_normals(mesh), mesh.triangles.mean(axis=1)) < 0.0).all())


def distances_to(mesh: Mesh, points: Float64) -> Float64:
    scene = RayScene()
    scene.add(TriangleMesh(mesh.vertices.astype(np.float32), mesh.faces))
    return scene.closest_points(points.astype(np.float32)).distances.astype(float)


def test_a_plane_comes_back_from_depth() -> None:
    mesh = mesh_of_depth(image(tilted_plane()), COARSE)
    np.testing.assert_allclose(mesh.vertices[:, 2], 2.0 + 0.4 * mesh.vertices[:, 0], atol=2e-4)
    assert len(mesh.faces) == 2 * (30 - 1) * (40 - 1) and faces_the_origin(mesh)


def test_readings_are_merged_before_they_are_joined() -> None:
    merged = mesh_of_depth(image(tilted_plane(0.01)), COARSE)
    single = mesh_of_depth(image(tilted_plane(0.01)), ScanMeshConfig(min_grazing=0.0))
    errors = [mesh.vertices[:, 2] - 2.0 - 0.4 * mesh.vertices[:, 0] for mesh in (merged, single)]
    assert errors[0].std() < 0.4 * errors[1].std()


def test_nothing_bridges_a_step_in_depth() -> None:
    depth = np.full((120, 160), 3.0)
    depth[30:90, 40:120] = 1.2
    mesh = mesh_of_depth(image(depth))
    assert (np.ptp(mesh.triangles[:, :, 2], axis=1) < 1e-6).all()
    assert {1.2, 3.0} == set(np.round(np.unique(mesh.vertices[:, 2]), 6))


def test_what_is_not_measured_is_not_meshed() -> None:
    depth = tilted_plane()
    depth[:, :80] = 0.0
    depth[60:, :] = np.nan
    mesh = mesh_of_depth(image(depth))
    assert mesh.vertices[:, 0].min() > 0.0 and mesh.vertices[:, 1].max() < 0.0
    keep = np.zeros(depth.shape, bool)
    assert len(mesh_of_depth(image(tilted_plane()), keep=keep).faces) == 0
    keep[:, 80:] = True
    assert mesh_of_depth(image(tilted_plane()), keep=keep).vertices[:, 0].min() > 0.0
    assert len(mesh_of_depth(image(np.full((120, 160), 9.0))).faces) == 0, "farther than max_depth"


def test_a_room_comes_back_from_one_turn() -> None:
    room = box_mesh((4.0, 6.0, 2.0))
    mesh = mesh_of_scan(scan_of([room]))
    assert faces_the_origin(mesh) and len(mesh.faces) > 5000
    on_it = mesh.triangles.mean(axis=1)
    assert np.quantile(distances_to(room, on_it), 0.99) < 0.02, "corners are cut by what lies between two rings"
    # The lasers see the walls up to 15 degrees: that band is covered.
    seen = 2.0 * (4.0 + 6.0) * 2.0 * np.tan(np.deg2rad(15.0)) * 2.0
    assert area(mesh) > 0.8 * seen


def test_nothing_is_made_up_beyond_the_rings() -> None:
    """Between walls, a lidar of 15 degrees up and down sees nothing level: its view gets neither lid nor bottom."""
    mesh = mesh_of_scan(scan_of([box_mesh((4.0, 6.0, 2.4))], 0.005))
    assert (np.abs(mesh.vertices[:, 2]) < 1.0).all() and (np.abs(face_normals(mesh)[:, 2]) < 0.5).all()


def test_noise_does_not_tear_a_scan() -> None:
    room = box_mesh((4.0, 6.0, 2.0))
    clean, noisy = (mesh_of_scan(scan_of([room], noise)) for noise in (0.0, 0.01))
    assert area(noisy) > 0.9 * area(clean)
    assert np.median(distances_to(room, noisy.triangles.mean(axis=1))) < 0.01


def test_nothing_bridges_a_thing_and_the_wall_behind_it() -> None:
    room = box_mesh((8.0, 8.0, 6.0))
    box = transformed(box_mesh((0.6, 0.6, 0.6)), transform(None, (1.5, 0.0, 0.0)))
    mesh = mesh_of_scan(scan_of([room, box]))
    middle = mesh.triangles.mean(axis=1)
    astray = np.minimum(distances_to(room, middle), distances_to(box, middle)) > 0.1
    assert np.mean(astray) < 0.005


def test_the_order_of_shots_does_not_matter() -> None:
    scan = scan_of([box_mesh((4.0, 6.0, 2.0))], 0.01)
    order = np.random.default_rng(1).permutation(len(scan.ranges))
    none = np.zeros(len(order), np.float32)
    rings = none.astype(np.uint8)
    mixed = LidarScan(0, scan.directions[order], scan.ranges[order], none, rings, none, np.eye(4))
    a, b = mesh_of_scan(scan), mesh_of_scan(mixed)
    assert len(a.faces) == pytest.approx(len(b.faces), abs=4)
    assert np.quantile(distances_to(a, b.vertices), 0.999) < 1e-3


def test_scans_without_a_surface_give_empty_meshes() -> None:
    shots = VLP16.shots()
    for kept in (0, 3, 16):
        count = kept
        none = np.zeros(count, np.float32)
        ranges = np.full(count, 2.0, np.float32)
        ring = np.zeros(count, np.uint8)
        scan = LidarScan(0, shots.directions[:count], ranges, none, ring, none, np.eye(4))
        assert mesh_of_scan(scan).faces.shape[1] == 3
    level = shots.directions.copy()
    level[:, 2] = 0.0
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    flat = LidarScan(0, level, np.full(len(level), 2.0, np.float32), shots.times, shots.rings, shots.times, np.eye(4))
    assert len(mesh_of_scan(flat).faces) == 0, "one ring sees no surface"
    lost = LidarScan(
        0, level, np.full(len(level), np.inf, np.float32), shots.times, shots.rings, shots.times, np.eye(4)
    )
    assert len(mesh_of_scan(lost).faces) == 0


def test_settings_outside_their_domain_are_named() -> None:
    for name, value in (("columns", 1), ("max_edge", 0.0), ("min_grazing", 2.0), ("azimuth_cell", float("nan"))):
        with pytest.raises(InvalidValueError, match=name):
            ScanMeshConfig(**{name: value})  # type: ignore[arg-type]
