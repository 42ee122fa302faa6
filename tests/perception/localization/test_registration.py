import numpy as np
import pytest

from simtrack.contracts import StaticMap
from simtrack.errors import InvalidValueError, MeshError
from simtrack.geometry.transforms import difference, exp_so3, perturb, transform, transform_planar
from simtrack.perception.localization.assessment import assess, lead
from simtrack.perception.localization.config import LocalizerConfig, MotionConfig, RegistrationConfig, SearchConfig
from simtrack.perception.localization.measurement import Measurement, deskew
from simtrack.perception.localization.motion import OdometryTrack
from simtrack.perception.localization.registration import register
from simtrack.perception.localization.surface import MapSurface, smoothed_normals

TRUE = transform_planar(3.0, 2.5, 0.3)


def measure(world, T: np.ndarray, seed: int = 0) -> Measurement:
    scan = world.scan(lambda t: T, 0.0, np.random.default_rng(seed))
    return deskew(scan, OdometryTrack(MotionConfig()), 0.008, 0.3, 100.0)


def off_by(T: np.ndarray, metres: float, degrees: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A start that is off horizontally, and its covariance."""
    heading, yaw = rng.uniform(0, 2 * np.pi), np.radians(degrees) * rng.choice([-1, 1])
    start = perturb(T, np.array([metres * np.cos(heading), metres * np.sin(heading), 0, 0, 0, yaw]))
    return start, np.diag(np.square([metres, metres, 0.01, 0.01, 0.01, np.radians(degrees)]))


def cost(T, points, planes, weights, kernel) -> float:
    e = (planes[:, :3] * (points @ T[:3, :3].T + T[:3, 3])).sum(1) - planes[:, 3]
    return float((0.5 * weights * e**2 * kernel**2 / (kernel**2 + e**2)).sum())


def test_gradient_and_information_are_the_derivatives_of_the_robust_cost() -> None:
    from simtrack.perception.localization.correspondences import ROWS, any_normals, normal_equations

    rng = np.random.default_rng(1)
    T_cast = transform(exp_so3(rng.normal(size=3)), rng.normal(size=3))
    T = perturb(T_cast, np.array([0.05, -0.1, 0.02, 0.03, -0.02, 0.08]))
    points = rng.normal(size=(200, 3)) * 3
    normals = rng.normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    offsets = (normals * (points @ T[:3, :3].T + T[:3, 3])).sum(1) + 0.01 * rng.normal(size=200)
    planes, weights = np.column_stack([normals, offsets]), rng.uniform(1, 5, 200)
    pairs = np.empty((ROWS, 300), np.float32)  # with columns that do not count
    pairs[:3, :200], pairs[3:6, :200] = T_cast[:3, :3] @ points.T, normals.T
    pairs[6, :200] = (normals * (points @ T_cast[:3, :3].T + T_cast[:3, 3])).sum(1) - offsets
    pairs[7, :200], pairs[:, 200:] = weights, np.nan
    motion, shift = T[:3, :3] @ T_cast[:3, :3].T - np.eye(3), T[:3, 3] - T_cast[:3, 3]
    info, gradient, stats = normal_equations(pairs, pairs[7], 200, motion, shift, 0.05)
    step = 1e-6
    numeric = [
        (
            cost(perturb(T, step * e), points, planes, weights, 0.05)
            - cost(perturb(T, -step * e), points, planes, weights, 0.05)
        )
        / (2 * step)
        for e in np.eye(6)
    ]
    assert gradient == pytest.approx(np.array(numeric), rel=1e-4, abs=1e-3)
    q = points @ T[:3, :3].T
    J = np.column_stack([normals, np.cross(q, normals)])
    e = (planes[:, :3] * (q + T[:3, 3])).sum(1) - offsets
    kernel = (0.05**2 / (0.05**2 + e**2)) ** 2
    assert info == pytest.approx(J.T @ ((weights * kernel)[:, None] * J), rel=1e-4, abs=1e-2)
    assert stats == pytest.approx([kernel.sum(), (kernel * e**2).sum()], rel=1e-4)

    feigned, lever = any_normals(pairs, pairs[7], 200, 0.05)
    q, kernel = pairs[:3, :200].T, (0.05**2 / (0.05**2 + pairs[6, :200] ** 2)) ** 2
    average = np.zeros((6, 6))  # over three orthogonal normals B n n^T B^T sums to B B^T
    for axis in np.eye(3):
        K = np.column_stack([np.tile(axis, (200, 1)), np.cross(q, axis)])
        average += K.T @ ((weights * kernel)[:, None] * K)
    assert feigned == pytest.approx(average, rel=1e-4, abs=1e-2)
    assert lever**2 == pytest.approx((kernel * (q**2).sum(1)).sum() / kernel.sum(), rel=1e-4)


def test_tilt_of_the_floor_prior_has_the_identity_as_its_derivative() -> None:
    from simtrack.perception.localization.solver import floor_deviation

    T = transform_planar(1.0, 2.0, 0.7)
    for k in (2, 3, 4):
        xi = np.eye(6)[k] * 1e-6
        assert floor_deviation(perturb(T, xi), 0.0) == pytest.approx(xi, abs=1e-11)


@pytest.mark.parametrize("seed", range(4))
def test_converges_to_the_truth_without_noise(exact_lab, seed: int) -> None:
    surface, shots = MapSurface(exact_lab.static_map), measure(exact_lab, TRUE)
    start, covariance = off_by(TRUE, 0.02, 5.0, np.random.default_rng(seed))
    found = register(shots, surface, start, covariance, RegistrationConfig())
    error = difference(found.T_map_base, TRUE)
    assert found.converged
    assert np.linalg.norm(error[:3]) < 1e-4
    assert np.degrees(np.linalg.norm(error[3:])) < 0.05


@pytest.mark.parametrize("seed", range(4))
def test_two_ray_casts_suffice_from_ten_centimetres(exact_lab, seed: int) -> None:
    surface, shots = MapSurface(exact_lab.static_map), measure(exact_lab, TRUE)
    start, covariance = off_by(TRUE, 0.10, 3.0, np.random.default_rng(seed))
    found = register(shots, surface, start, covariance, RegistrationConfig(), strides=(1, 1))
    assert np.linalg.norm(difference(found.T_map_base, TRUE)[:3]) < 5e-4


def test_moved_furniture_and_noise_leave_millimetres(lab_world) -> None:
    surface, shots = MapSurface(lab_world.static_map), measure(lab_world, TRUE)
    start, covariance = off_by(TRUE, 0.2, 5.0, np.random.default_rng(2))
    found = register(shots, surface, start, covariance, RegistrationConfig(strides=(5, 3, 2, 2)))
    error = difference(found.T_map_base, TRUE)
    assert np.linalg.norm(error[:2]) < 0.005
    assert np.degrees(abs(error[5])) < 0.1
    assert found.observed == 6
    assert 0.85 < assess(shots, surface, found.T_map_base).structure < 1.0


def test_a_bare_corridor_leaves_its_direction_to_the_prediction(corridor_world) -> None:
    surface = MapSurface(corridor_world.static_map)
    T = transform_planar(150.0, 0.9, 0.0)
    shots = measure(corridor_world, T)
    start = perturb(T, np.array([0.08, 0.05, 0, 0, 0, 0.02]))
    covariance = np.diag(np.square([0.1, 0.1, 0.01, 0.01, 0.01, 0.05]))
    found = register(shots, surface, start, covariance, RegistrationConfig())
    assert found.observed == 5
    error = difference(found.T_map_base, T)
    assert error[0] == pytest.approx(0.08, abs=2e-3)
    assert abs(error[1]) < 0.005
    assert np.degrees(abs(error[5])) < 0.1
    sigma = np.sqrt(np.diag(found.covariance))
    assert sigma[0] == pytest.approx(0.1, rel=0.05)
    assert sigma[1] < 0.01


def test_too_few_shots_leave_the_prediction(lab_world) -> None:
    surface, shots = MapSurface(lab_world.static_map), measure(lab_world, TRUE)
    covariance = np.eye(6) * 1e-4
    found = register(shots.thinned(1000), surface, TRUE, covariance, RegistrationConfig())
    assert not found.converged
    assert np.abs(found.T_map_base - TRUE).max() < 1e-12


def test_assessment_tells_walls_that_are_seen_through(lab_world) -> None:
    surface, shots = MapSurface(lab_world.static_map), measure(lab_world, TRUE)
    right, wrong = assess(shots, surface, TRUE), assess(shots, surface, transform_planar(1.5, 1.5, 2.0))
    assert right.score > wrong.score + 0.4
    assert wrong.through > 0.1 > right.through
    ahead, differing = lead([right.verdicts], [wrong.verdicts])
    assert ahead > 0.8
    assert differing > 0.3
    assert lead([wrong.verdicts], [right.verdicts])[0] == -ahead


def test_smoothing_denoises_normals_and_keeps_creases(lab_world, exact_lab) -> None:
    noisy, faces = lab_world.static_map.vertices, lab_world.static_map.faces
    corners = noisy[faces].astype(float)
    raw = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    raw /= np.linalg.norm(raw, axis=1)[:, None]
    true = np.round(raw)

    def tilt(normals: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.arccos(np.clip((normals * true).sum(1), -1, 1)) ** 2)))

    assert tilt(smoothed_normals(noisy, faces)) < 0.5 * tilt(raw)
    exact = smoothed_normals(exact_lab.static_map.vertices, exact_lab.static_map.faces)
    assert np.abs(np.abs(exact).max(axis=1) - 1.0).max() < 1e-6


def test_a_broken_map_is_refused() -> None:
    faces = np.array([[0, 1, 2]], np.int32)
    with pytest.raises(MeshError, match="static map"):
        MapSurface(StaticMap(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)))
    with pytest.raises(MeshError, match="finite"):
        MapSurface(StaticMap(np.full((3, 3), np.nan, np.float32), faces))


@pytest.mark.parametrize(
    "make",
    [
        lambda: RegistrationConfig(strides=()),
        lambda: RegistrationConfig(range_sigma=0.0),
        lambda: MotionConfig(horizon=float("nan")),
        lambda: SearchConfig(points=(1,)),
        lambda: SearchConfig(heights=(2.0, 1.0)),
        lambda: LocalizerConfig(min_range=-1.0),
    ],
)
def test_settings_outside_their_domain_are_refused(make) -> None:
    with pytest.raises(InvalidValueError):
        make()


def test_furniture_that_was_taken_away_does_not_blind(exact_lab) -> None:
    """The robot stands where the survey has a cupboard, before one more that is gone too."""
    from dataclasses import replace

    from simtrack.geometry.meshes import box_mesh
    from simtrack.geometry.transforms import apply

    survey = exact_lab.static_map
    vertices, faces = [survey.vertices], [survey.faces]
    for x in (3.0, 4.2):
        box = box_mesh(np.array([0.8, 0.8, 2.0]))
        faces.append(box.faces + sum(len(v) for v in vertices))
        vertices.append(apply(transform_planar(x, 2.5, 0.0), np.add(box.vertices, (0.0, 0.0, 1.0))).astype(np.float32))
    crowded = replace(survey, vertices=np.concatenate(vertices), faces=np.concatenate(faces).astype(np.int32))
    surface, shots = MapSurface(crowded), measure(exact_lab, TRUE)
    start, covariance = off_by(TRUE, 0.05, 2.0, np.random.default_rng(5))
    found = register(shots, surface, start, covariance, RegistrationConfig())
    assert np.linalg.norm(difference(found.T_map_base, TRUE)[:3]) < 2e-3
    judged = assess(shots, surface, found.T_map_base)
    assert judged.structure > 0.85
    assert judged.through < 0.05
    assert np.count_nonzero(judged.verdicts == 1) > 500
