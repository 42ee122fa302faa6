"""Laws of joints found by ray tracing: a cupboard with a door and a drawer, seen by a small depth camera."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.contracts import Articulation, CameraIntrinsics, Float32, Float64, RgbdFrame, StaticMap, TrackStatus
from simtrack.geometry.meshes import Mesh, box_mesh, concatenate, transformed
from simtrack.geometry.transforms import apply, inverse, look_at, transform
from simtrack.perception.tracking.articulation import (
    ArticulationTracker,
    joint_column,
    motion,
    uniform_variance,
)
from simtrack.perception.tracking.correspondences import Points
from simtrack.raycast import RayBundle, RayScene, TriangleMesh
from simtrack.recordings import archive

CAMERA = CameraIntrinsics(160, 120, 140.0, 140.0, 79.5, 59.5)
T_MAP_CAMERA = look_at(np.array([-1.5, -0.7, 1.5]), np.array([0.0, 0.0, 0.85]))
NOISE = 0.003
"""Metres, of each reading."""


def block(low: tuple[float, float, float], high: tuple[float, float, float]) -> Mesh:
    a, b = np.array(low), np.array(high)
    return transformed(box_mesh(b - a), transform(None, (a + b) / 2))


CASE = concatenate(
    [
        block((0.0, -0.3, 0.4), (0.5, -0.28, 1.4)),
        block((0.0, 0.28, 0.4), (0.5, 0.3, 1.4)),
        block((0.48, -0.28, 0.4), (0.5, 0.28, 1.4)),
        block((0.0, -0.28, 0.4), (0.5, 0.28, 0.42)),
        block((0.0, -0.28, 0.8), (0.5, 0.28, 0.82)),
        block((-3.0, -3.0, -0.01), (3.0, 3.0, 0.0)),
        block((1.5, -3.0, 0.0), (1.52, 3.0, 2.5)),
    ]
)
LEAF = concatenate([block((-0.022, -0.3, 0.81), (-0.002, 0.3, 1.4)), block((-0.06, -0.26, 1.0), (-0.022, -0.24, 1.2))])
TRAY = concatenate([block((-0.02, -0.3, 0.42), (-0.002, 0.3, 0.79)), block((0.0, -0.27, 0.43), (0.4, 0.27, 0.45))])
UP, OUT = np.array([0.0, 0.0, 1.0]), np.array([-1.0, 0.0, 0.0])
DOOR = Articulation(
    "case/door", "cupboard", "revolute", np.array([-0.002, 0.3, 1.0]), -UP, 0.0, 1.75,
    LEAF.vertices.astype(np.float32), LEAF.faces,
)  # fmt: skip
DRAWER = Articulation(
    "case/drawer", "cupboard", "prismatic", np.zeros(3), OUT, 0.0, 0.35, TRAY.vertices.astype(np.float32), TRAY.faces
)
MAP = StaticMap(CASE.vertices.astype(np.float32), CASE.faces, articulations=(DOOR, DRAWER))
ARM = block((-0.6, -0.35, 0.95), (-0.5, 0.1, 1.1))
"""Something before the door."""


def image(positions: tuple[float, float], rng: np.random.Generator, *, before: Mesh | None = None) -> Float32:
    """Depth of the true cupboard, with noise."""
    scene = RayScene()
    scene.add(TriangleMesh(MAP.vertices, MAP.faces), instance=0)
    for k, (part, q) in enumerate(zip(MAP.articulations, positions, strict=True), 1):
        scene.add(TriangleMesh(part.vertices, part.faces), motion(part, q), instance=k)
    if before is not None:
        scene.add(TriangleMesh(before.vertices.astype(np.float32), before.faces), instance=3)
    hits = scene.cast(RayBundle.from_camera(CAMERA), T_MAP_CAMERA)
    depth = hits.distances.astype(float)
    depth = np.where(np.isfinite(depth) & (depth < 6.0), depth + NOISE * rng.standard_normal(len(depth)), 0.0)
    scene.close()
    return depth.reshape(120, 160).astype(np.float32)


def frame(stamp: int, depth: Float32) -> RgbdFrame:
    return RgbdFrame(stamp, depth, None, CAMERA, np.eye(4))


CERTAIN = 1e-8 * np.eye(6)


@given(st.integers(0, 2**32 - 1), st.sampled_from([DOOR, DRAWER]), st.floats(0.0, 0.3))
def test_the_column_is_the_derivative_of_the_points_along_their_normals(
    seed: int, part: Articulation, position: float
) -> None:
    rng = np.random.default_rng(seed)
    T_camera_map = inverse(T_MAP_CAMERA)
    local, normals = rng.uniform(-1.0, 1.0, (5, 3)), rng.standard_normal((5, 3))

    def at(q: float) -> Float64:
        return apply(T_camera_map @ motion(part, q), local)

    points = Points.room(5)
    points.model[:], points.normal[:] = at(position), normals
    h = 1e-6
    numeric = np.sum(normals * (at(position + h) - at(position - h)), axis=1) / (2.0 * h)
    np.testing.assert_allclose(joint_column(points, 5, part, T_camera_map), numeric, atol=1e-7)


@settings(max_examples=6)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.05, 0.4, 0.7, 1.2, 1.6, 1.75]), st.floats(0.0, 0.35))
def test_never_seen_joints_are_found_anywhere_in_their_range(seed: int, door: float, drawer: float) -> None:
    rng = np.random.default_rng(seed)
    tracker = ArticulationTracker(MAP)
    joints = tracker.estimates(0)
    for stamp in range(6):
        joints = tracker.update(frame(stamp * 100_000_000, image((door, drawer), rng)), T_MAP_CAMERA, CERTAIN)
    tracker.close()
    assert all(joint.status is TrackStatus.CONFIRMED for joint in joints)
    assert abs(joints[0].position - door) < np.radians(1.0) and abs(joints[1].position - drawer) < 0.01
    for joint, truth in zip(joints, (door, drawer), strict=True):
        assert abs(joint.position - truth) < 4.0 * np.sqrt(joint.variance)


def test_a_moving_door_is_followed_within_its_limits() -> None:
    """Half-way the camera sees the leaf edge-on."""
    rng, tracker, errors = np.random.default_rng(1), ArticulationTracker(MAP), []
    for k in range(60):
        truth = min(max(0.0, 0.06 * (k - 6)), 1.75)
        joints = tracker.update(frame(k * 100_000_000, image((truth, 0.0), rng)), T_MAP_CAMERA, CERTAIN)
        assert DOOR.lower <= joints[0].position <= DOOR.upper
        errors.append(abs(joints[0].position - truth))
        assert errors[-1] < 4.0 * np.sqrt(joints[0].variance)
    tracker.close()
    assert np.percentile(errors[4:], 95) < np.radians(1.0) and np.max(errors[4:]) < np.radians(5.0)


def test_what_stands_before_a_door_does_not_pull_it_and_unseen_ones_become_uncertain() -> None:
    rng, tracker = np.random.default_rng(2), ArticulationTracker(MAP)
    joints = tracker.estimates(0)
    for k in range(6):
        tracker.update(frame(k * 100_000_000, image((0.7, 0.0), rng)), T_MAP_CAMERA, CERTAIN)
    for k in range(6, 12):
        joints = tracker.update(frame(k * 100_000_000, image((0.7, 0.0), rng, before=ARM)), T_MAP_CAMERA, CERTAIN)
        assert abs(joints[0].position - 0.7) < np.radians(1.0)
    seen, wall = joints[0], block((-1.0, -1.0, 0.0), (-0.98, 1.0, 2.0))
    deviations = [seen.variance]
    for k in range(12, 40):
        depth = image((0.7, 0.0), rng, before=wall)
        hidden = tracker.update(frame(k * 100_000_000, depth), T_MAP_CAMERA, CERTAIN)[0]
        assert hidden.status is TrackStatus.OCCLUDED and hidden.last_seen == seen.last_seen
        assert hidden.position == pytest.approx(seen.position, abs=0.02)
        deviations.append(hidden.variance)
    tracker.close()
    assert np.all(np.diff(deviations) > 0.0) and deviations[-1] <= uniform_variance(DOOR)


def test_own_pixels_say_nothing() -> None:
    rng, tracker = np.random.default_rng(3), ArticulationTracker(MAP)
    depth = image((0.7, 0.2), rng)
    joints = tracker.update(frame(0, depth), T_MAP_CAMERA, CERTAIN, np.ones(depth.shape, bool))
    tracker.close()
    for joint, part in zip(joints, MAP.articulations, strict=True):
        assert joint.last_seen is None and joint.variance == uniform_variance(part)


def test_a_door_that_was_moved_unseen_is_found_again() -> None:
    rng, tracker = np.random.default_rng(4), ArticulationTracker(MAP)
    joints = tracker.estimates(0)
    for k, truth in enumerate([0.2] * 5 + [1.3] * 5):
        joints = tracker.update(frame(k * 100_000_000, image((truth, 0.0), rng)), T_MAP_CAMERA, CERTAIN)
    tracker.close()
    assert abs(joints[0].position - 1.3) < np.radians(1.0)


def test_fit_leaves_the_belief_as_it_is() -> None:
    rng, tracker = np.random.default_rng(5), ArticulationTracker(replace(MAP, articulations=(DRAWER,)))
    before = tracker.estimates(0)
    found = tracker.fit(0, image((0.0, 0.2), rng), CAMERA, T_MAP_CAMERA, 0.17)
    assert abs(found.position - 0.2) < 0.005 and found.support > 0.9 and tracker.estimates(0) == before
    tracker.close()


def test_maps_with_joints_survive_a_recording() -> None:
    read = archive.decode(StaticMap, archive.encode(MAP))
    for one, other in zip(read.articulations, MAP.articulations, strict=True):
        assert (one.name, one.kind, one.lower, one.upper) == (other.name, other.kind, other.lower, other.upper)
        np.testing.assert_array_equal(one.vertices, other.vertices)
    with pytest.raises(archive.ArchiveError, match="expected one of 'revolute', 'prismatic'"):
        archive.decode(StaticMap, archive.encode(replace(MAP, articulations=(replace(DOOR, kind="ball"),))))
