import numpy as np
import pytest

from simtrack.geometry.transforms import apply, is_rigid
from simtrack.objects.tiago import CAMERA, HEAD_PAN, HEAD_TILT, LIDAR, TORSO, TUCKED, tiago


def test_parents_come_first_and_names_are_unique() -> None:
    names: list[str] = []
    for link in tiago().links:
        assert link.parent in names or (not names and link.parent == "")
        assert link.name not in names
        names.append(link.name)


def test_published_sizes_and_limits() -> None:
    joints = {joint.name: joint for joint in tiago().joints}
    assert (joints[TORSO].lower, joints[TORSO].upper) == (0.0, 0.35)
    assert (joints[HEAD_PAN].lower, joints[HEAD_PAN].upper) == (-1.24, 1.24)
    assert (joints[HEAD_TILT].lower, joints[HEAD_TILT].upper) == (-0.98, 0.72)
    assert sum(name.startswith("arm_") for name in joints) == 7
    base = tiago().links[0]
    assert np.ptp(base.vertices[:, 1]) == pytest.approx(0.54, abs=0.01)
    assert sum(link.mass for link in tiago().links) == pytest.approx(72, abs=1)
    assert all(len(link.faces) < 400 for link in tiago().links)
    for joint in joints.values():
        assert joint.lower <= TUCKED.get(joint.name, 0.0) <= joint.upper


@pytest.mark.parametrize(("lift", "height"), [(0.0, 1.10), (0.35, 1.45)])
def test_camera_is_an_optical_frame_at_the_published_height(lift: float, height: float) -> None:
    T = tiago().forward({TORSO: lift})[CAMERA]
    assert is_rigid(T)
    assert T[2, 3] == pytest.approx(height, abs=0.005)
    np.testing.assert_allclose(T[:3, :3], [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-12)
    down = tiago().forward({HEAD_TILT: -0.5})[CAMERA]
    assert down[2, 2] == pytest.approx(-np.sin(0.5))  # negative tilt looks down
    left = tiago().forward({HEAD_PAN: 0.5})[CAMERA]
    assert left[1, 2] == pytest.approx(np.sin(0.5))


def test_the_tucked_arm_stays_out_of_the_cameras_usual_view() -> None:
    for lift in (0.0, 0.15, 0.35):
        poses = tiago().forward({**TUCKED, TORSO: lift, HEAD_TILT: -0.6})
        T_camera_base = np.linalg.inv(poses[CAMERA])
        for link in tiago().links:
            if link.name.startswith(("arm", "gripper")):
                points = apply(T_camera_base @ poses[link.name], link.vertices)
                assert not np.any((points[:, 2] > 0.05) & (points[:, 1] / points[:, 2] < 240 / 577))


def test_the_lidar_sees_out_but_the_body_hides_a_sector() -> None:
    from simtrack.raycast import RayScene, TriangleMesh

    poses = tiago().forward({**TUCKED, TORSO: 0.3})
    with RayScene() as scene:
        for link in tiago().links:
            if len(link.faces):
                scene.add(TriangleMesh(link.vertices, link.faces), poses[link.name])
        azimuth = np.linspace(-np.pi, np.pi, 720, endpoint=False)
        hidden = []
        for elevation in np.radians([-15, -7, 0, 7, 15]):
            rays = np.stack(
                [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                 np.full(720, np.sin(elevation))], axis=1,
            )  # fmt: skip
            origin = np.broadcast_to(poses[LIDAR][:3, 3], rays.shape)
            hidden.append(scene.cast_rays(origin, rays, min_distance=0.06).hit)
    share = np.mean(hidden)
    assert 0.05 < share < 0.35
    behind = np.abs(azimuth) > 2.0
    assert not np.any(np.array(hidden)[:, behind])


def test_the_pose_of_one_link_is_that_among_all() -> None:
    robot = tiago()
    positions = {joint.name: 0.5 * (joint.lower + joint.upper) + 0.1 for joint in robot.joints}
    poses = robot.forward(positions)
    for link in robot.links:
        assert np.array_equal(robot.pose(link.name, positions), poses[link.name])
