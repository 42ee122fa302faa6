"""The search for poses: its laws, and detections whose keypoints alone would not do."""

from collections.abc import Iterator

import numpy as np
import pytest

from simtrack.contracts import Detection, Float32, Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import angle_between, exp_so3, transform
from simtrack.objects import load_object
from simtrack.perception.detection import search_kernels as kernels
from simtrack.perception.detection.evidence import Evidence, PoseSearchConfig, rotation_grid
from simtrack.perception.detection.pnp import project_points, solve_pose
from simtrack.perception.detection.pose_search import STEPS, PoseSearch
from simtrack.perception.tracking.association import rotation_apart
from tests.perception.tracking.scenes import INTRINSICS, BenchWorld, in_camera, on_bench

CAMERA = np.array([INTRINSICS.fx, INTRINSICS.fy, INTRINSICS.cx, INTRINSICS.cy])
DRILL, BOX = load_object("powerdrill"), load_object("klt3147")
PLACES = {"powerdrill": (DRILL, on_bench(DRILL, 0.25, -0.1, 0.7)), "klt3147": (BOX, on_bench(BOX, -0.2, 0.1, 0.4))}


@pytest.fixture(scope="module")
def depth() -> Float32:
    world = BenchWorld()
    for model, T in PLACES.values():
        world.add(model, T)
    return world.depth()


@pytest.fixture(scope="module")
def search() -> Iterator[PoseSearch]:
    search = PoseSearch({name: model for name, (model, _) in PLACES.items()})
    yield search
    search.close()


def detected(name: str, error: Float64 | float = 0.0, sigma: float = 1.0) -> Detection:
    """An object's true box, and its keypoints with errors (9, 2), pixels."""
    model, T = PLACES[name]
    pixels = project_points(in_camera(T), np.asarray(model.mesh.vertices, float), INTRINSICS)
    box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
    keypoints = project_points(in_camera(T), model.keypoints, INTRINSICS) + error
    return Detection(name, keypoints, np.full(9, sigma), box, 0.9)


def errors(T: Float64, name: str) -> tuple[float, float]:
    """Metres and degrees."""
    model, T_map = PLACES[name]
    apart = rotation_apart(T, in_camera(T_map), model)
    return float(np.linalg.norm(T[:3, 3] - in_camera(T_map)[:3, 3])), float(np.rad2deg(apart))


def test_the_grid_of_orientations_leaves_no_gap() -> None:
    grid, rng = rotation_grid(1200), np.random.default_rng(0)
    assert np.allclose(grid @ grid.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(grid), 1.0)
    for _ in range(100):
        R = exp_so3(2.0 * rng.standard_normal(3))
        nearest = grid[np.argmax(np.einsum("nij,ij->n", grid, R))]
        assert angle_between(R, nearest) < np.deg2rad(22.0)


@pytest.mark.parametrize("name", PLACES)
def test_a_true_orientation_is_put_in_its_place(name: str, depth: Float32, search: PoseSearch) -> None:
    T, shown = in_camera(PLACES[name][1]), search.shown(name)
    e = Evidence.of(detected(name), shown, depth, INTRINSICS, PoseSearchConfig())
    assert e is not None
    others = T[:3, :3] @ np.array([exp_so3(0.5 * axis) for axis in np.eye(3)])
    shifts, costs = np.empty((4, 3)), np.empty(4)
    kernels.place_and_judge(
        np.concatenate([T[None, :3, :3], others]), e.keypoints, e.pixels, e.sigma, e.rays, e.solve, e.distance,
        e.outline, e.box, e.box_sigma, e.size, CAMERA, shifts, costs,
    )  # fmt: skip
    assert np.linalg.norm(shifts[0] - T[:3, 3]) < 0.005  # the middle of the box is no keypoint, and pulls a little
    assert e.cost(T[:3, :3], T[:3, 3]) < 0.1
    assert np.all(costs[1:] > 5.0 * costs[0])
    assert np.isclose(costs[2], e.cost(others[1], shifts[2]))
    assert e.cost(T[:3, :3], np.array([0.0, 0.0, -1.0])) == np.inf


def test_rays_are_turned_instead_of_the_model() -> None:
    rng = np.random.default_rng(1)
    T = np.array([transform(exp_so3(rng.standard_normal(3)), rng.standard_normal(3)) for _ in range(2)])
    directions = rng.standard_normal((5, 3)).astype(np.float32)
    origins, turned, back = np.empty((10, 3), np.float32), np.empty((10, 3), np.float32), np.empty((10, 3))
    kernels.rays_of(T[:, :3, :3].copy(), T[:, :3, 3].copy(), directions, origins, turned)
    for h in range(2):
        of = slice(5 * h, 5 * h + 5)
        assert np.allclose(turned[of] @ T[h, :3, :3].T, directions, atol=1e-6)
        assert np.allclose(origins[of] @ T[h, :3, :3].T + T[h, :3, 3], 0.0, atol=1e-6)
    kernels.normals_of(T[:, :3, :3].copy(), turned, back)
    assert np.allclose(back, np.tile(directions, (2, 1)), atol=1e-6)


def test_casts_slide_to_where_most_of_them_agree() -> None:
    """A fifth of the rays sees an occluder, a tenth the background; one cast misses altogether."""
    rng = np.random.default_rng(2)
    model = (1.0 + 0.05 * rng.random(200)).astype(np.float32)
    readings = model + np.float32(0.08)
    readings[:40] -= 0.15
    readings[40:60] += 1.0
    readings[60:70] = 0.0
    distances = np.stack([model, np.full(200, np.inf, np.float32)])
    shifts, scores = np.empty(2), np.empty(2)
    kernels.slide(distances, readings, 0.3, 0.012, 0.4, np.ones(2), 1e3, shifts, scores)
    assert abs(shifts[0] - 0.08) < 0.015
    assert np.isclose(scores[0], 130 - 20 - 0.4 * 40, atol=0.01)
    assert scores[1] == pytest.approx(0.0, abs=1e-3)


def test_silhouettes_want_a_step_behind_them() -> None:
    """Three rays in the middle row of a 3 x 5 grid meet a model: a step beside two of their eight neighbours."""
    distances = np.full((1, 15), np.inf, np.float32)
    distances[0, 6:9] = 1.0
    readings = np.ones(15, np.float32)
    readings[[5, 12]] = 1.5
    readings[1] = 0.0
    out = np.zeros((1, 2), np.int64)
    kernels.borders(distances, readings, 5, 0.02, out)
    assert out.tolist() == [[2, 5]]


@pytest.mark.parametrize("name", PLACES)
def test_keypoints_that_are_too_poor_for_pnp_do_with_depth(name: str, depth: Float32, search: PoseSearch) -> None:
    """Errors of a seventh of the box: PnP is decimetres or tens of degrees off, or finds nothing."""
    rng, poor, good = np.random.default_rng(3), 0, 0
    box = detected(name).box
    sigma = float((box[2:] - box[:2]).max()) / 7.0
    for _ in range(6):
        detection = detected(name, rng.normal(0.0, sigma, (9, 2)), sigma)
        solved = solve_pose(detection, PLACES[name][0], INTRINSICS, 5)
        found = search.search(detection, depth, INTRINSICS, 5, solved) or []
        assert {(h.class_name, h.stamp, h.score) for h in found} == {(name, 5, 0.9)}
        metres, degrees = errors(found[0].T_camera_object, name)
        good += metres < 0.01 and degrees < 8.0
        metres, degrees = errors(solved[0].T_camera_object, name) if solved else (np.inf, np.inf)
        poor += metres > 0.03 or degrees > 10.0
        assert np.all(np.linalg.eigvalsh(found[0].covariance) > 0.0)
    assert good >= 5
    assert poor >= 4


def test_a_refinement_does_not_slide_onto_a_hand(depth: Float32, search: PoseSearch) -> None:
    """Something close before a part of an object draws the solver, against keypoints and silhouette."""
    rng, held = np.random.default_rng(5), depth.copy()
    T, shown, detection = in_camera(PLACES["klt3147"][1]), search.shown("klt3147"), detected("klt3147")
    u0, v0, u1, v1 = detection.box.astype(int)
    part = held[v0 : v0 + 7 * (v1 - v0) // 10, u0:u1]
    part[part < T[2, 3] + 0.15] -= 0.025
    e = Evidence.of(detection, shown, held, INTRINSICS, search.config)
    assert e is not None
    starts = np.array([T @ transform(exp_so3(rng.normal(0.0, 0.05, 3)), rng.normal(0.0, 0.003, 3)) for _ in range(24)])
    before, moved = search._judge(e, shown, starts)[0], starts.copy()
    search._refine(e, shown, moved, STEPS)
    slid = search._judge(e, shown, moved)[0] > before + search.config.slip
    poses, costs, supports = search._refined(e, shown, starts)
    assert slid.any()
    assert np.all(costs[slid] <= before[slid])
    assert np.array_equal(poses[~slid], moved[~slid])
    again = search._judge(e, shown, poses)
    assert np.allclose(again[0], costs) and np.allclose(again[1], supports)


def test_without_any_keypoint_box_and_depth_are_left(depth: Float32, search: PoseSearch) -> None:
    detection = detected("powerdrill")
    detection.keypoints[:] = np.nan
    found = search.search(detection, depth, INTRINSICS, 0)
    assert found
    assert all(h.reprojection_error == 0.0 and np.isfinite(h.covariance).all() for h in found)


def test_few_keypoints_are_enough(depth: Float32, search: PoseSearch) -> None:
    detection = detected("powerdrill")
    detection.keypoints[3:] = np.nan
    assert solve_pose(detection, DRILL, INTRINSICS, 0) == []
    found = search.search(detection, depth, INTRINSICS, 0)
    assert found
    metres, degrees = errors(found[0].T_camera_object, "powerdrill")
    assert metres < 0.01
    assert degrees < 8.0


def test_hypotheses_differ_and_are_no_more_than_asked_for(depth: Float32, search: PoseSearch) -> None:
    found = search.search(detected("klt3147", sigma=40.0), depth, INTRINSICS, 0) or []
    assert 2 <= len(found) <= search.config.kept
    for k, h in enumerate(found):
        for other in found[:k]:
            assert rotation_apart(h.T_camera_object, other.T_camera_object, BOX) >= search.config.distinct - 1e-9


def test_a_search_repeats(depth: Float32, search: PoseSearch) -> None:
    detection = detected("powerdrill", np.random.default_rng(4).normal(0.0, 4.0, (9, 2)), 4.0)
    first, second = (search.search(detection, depth, INTRINSICS, 0) or [] for _ in range(2))
    assert first
    assert [h.T_camera_object.tobytes() for h in first] == [h.T_camera_object.tobytes() for h in second]


def test_without_depth_or_a_box_of_its_own_there_is_no_search(depth: Float32, search: PoseSearch) -> None:
    detection = detected("powerdrill")
    assert search.search(detection, np.zeros_like(depth), INTRINSICS, 0) is None
    k = detection.keypoints
    for box in (
        np.concatenate([k.min(axis=0), k.max(axis=0)]),
        np.full(4, np.nan),
        np.array([-90.0, -90.0, -50.0, -60.0]),
    ):
        assert search.search(Detection("powerdrill", k, np.ones(9), box, 0.9), depth, INTRINSICS, 0) is None


def test_a_thing_that_is_not_there_has_no_pose(depth: Float32, search: PoseSearch) -> None:
    """A drill is claimed to float a decimetre before the bench, where the camera sees through it."""
    true, closer = detected("powerdrill"), depth.copy()
    assert search.search(true, closer, INTRINSICS, 0)
    closer[closer < in_camera(PLACES["powerdrill"][1])[2, 3] + 0.2] += 2.0
    assert search.search(true, closer, INTRINSICS, 0) == []


def test_settings_are_checked() -> None:
    with pytest.raises(InvalidValueError, match=r"PoseSearchConfig\.reach"):
        PoseSearchConfig(reach=-0.1)
    with pytest.raises(InvalidValueError, match=r"PoseSearchConfig\.cast"):
        PoseSearchConfig(cast=0)
