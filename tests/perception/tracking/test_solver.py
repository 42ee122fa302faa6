import numpy as np

from simtrack.geometry.transforms import exp_so3, perturb
from simtrack.perception.tracking import solver
from simtrack.perception.tracking.correspondences import Edges, Points, mark_around, no_marks, take_marked
from simtrack.perception.tracking.normal_equations import edge_normal_equations, point_normal_equations

CAMERA = np.array([577.0, 577.0, 319.5, 239.5])


def test_rotation_equals_rodrigues() -> None:
    rng = np.random.default_rng(0)
    for phi in [*rng.standard_normal((5, 3)), np.zeros(3), 1e-9 * np.ones(3)]:
        np.testing.assert_allclose(solver.rotation(phi), exp_so3(phi), atol=1e-12)


def _points(rng: np.random.Generator, count: int = 40):
    model = rng.uniform(-0.1, 0.1, (count, 3)) + np.array([0, 0, 1.0])
    normal = rng.standard_normal((count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return model + 0.002 * rng.standard_normal((count, 3)), model, normal


def _residuals(measured, model, normal, centre, xi):
    R = exp_so3(xi[3:])
    moved = centre + (model - centre) @ R.T + xi[:3]
    return np.einsum("ij,ij->i", normal @ R.T, measured - moved)


def test_point_gradient_is_that_of_the_cost() -> None:
    rng = np.random.default_rng(1)
    measured, model, normal = _points(rng)
    centre = np.array([0.01, -0.02, 1.0])
    H, g, stats = np.zeros((1, 6, 6)), np.zeros((1, 6)), np.zeros((1, 4))
    n = len(model)
    points = Points(measured, model, normal, np.full(n, 1e4), np.zeros(n, np.int32))
    point_normal_equations(
        points, n, np.ones(1, bool), centre[None], np.eye(3)[None], np.zeros((1, 3)), 1e6, H, g, stats
    )
    step = 1e-6
    for i in range(6):
        xi = np.zeros(6)
        xi[i] = step
        plus = 0.5e4 * np.sum(_residuals(measured, model, normal, centre, xi) ** 2)
        minus = 0.5e4 * np.sum(_residuals(measured, model, normal, centre, -xi) ** 2)
        # H xi = g solves the step that lowers the cost, so g is the negative gradient; the normal's turn adds a
        # second-order term that Gauss-Newton leaves out.
        assert abs((minus - plus) / (2 * step) - g[0, i]) < 0.02 * np.abs(g).max() + 1e-3


def test_silhouette_gradient_is_that_of_the_projection() -> None:
    rng = np.random.default_rng(2)
    count = 30
    point = rng.uniform(-0.1, 0.1, (count, 3)) + np.array([0, 0, 1.2])
    direction = rng.standard_normal((count, 2))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    offset = rng.uniform(-2, 2, count)
    centre = np.array([0.0, 0.02, 1.2])

    def cost(xi: np.ndarray) -> float:
        moved = centre + (point - centre) @ exp_so3(xi[3:]).T + xi[:3]
        shift = CAMERA[:2] * (moved[:, :2] / moved[:, 2:] - point[:, :2] / point[:, 2:])
        return 0.5 * float(np.sum((offset - np.einsum("ij,ij->i", direction, shift)) ** 2))

    H, g = np.zeros((1, 6, 6)), np.zeros((1, 6))
    edges = Edges(point, direction, offset, np.ones(count), np.zeros(count, np.int32))
    edge_normal_equations(edges, count, CAMERA, centre[None], np.eye(3)[None], np.zeros((1, 3)), 1e6, H, g)
    for i in range(6):
        xi = np.zeros(6)
        xi[i] = 1e-6
        assert np.isclose((cost(-xi) - cost(xi)) / 2e-6, g[0, i], rtol=1e-3, atol=1e-2)


def test_unconstrained_directions_are_not_moved() -> None:
    H = np.diag([1e6, 1e6, 1e6, 1e6, 1e6, 1.0])
    step, covariance, constrained = solver.constrained_solution(H, np.ones(6), 0.01)
    assert constrained == 5
    assert step[5] == 0.0
    np.testing.assert_allclose(step[:5], 1e-6)
    np.testing.assert_allclose(covariance[5, 5], 1.0)


def test_silhouettes_speak_only_where_faces_are_silent() -> None:
    H = np.diag([1e8, 0.0, 0.0, 1e8, 0.0, 0.0])
    H_edge, g_edge = np.diag(np.full(6, 1e4)), np.ones(6)
    A, b = solver.combine(H, np.zeros(6), H_edge, g_edge, solver.EDGES_WHERE_OPEN, 0.0015)
    np.testing.assert_allclose(b, [0, 1, 1, 0, 1, 1], atol=1e-6)
    np.testing.assert_allclose(np.diag(A), [1e8, 1e4, 1e4, 1e8, 1e4, 1e4], rtol=1e-6)


def test_umeyama_recovers_a_rigid_motion() -> None:
    rng = np.random.default_rng(3)
    _, model, normal = _points(rng, 400)
    centre = np.array([0.0, 0.0, 1.0])
    xi = np.array([0.004, -0.003, 0.002, 0.02, -0.01, 0.015])
    measured = centre + (model - centre) @ exp_so3(xi[3:]).T + xi[:3]
    rotations, shifts = np.eye(3)[None].copy(), np.zeros((1, 3))
    points = Points(measured, model, normal, np.ones(400), np.zeros(400, np.int32))
    solver.umeyama(points, 400, centre[None], rotations, shifts, 60)
    T = perturb(np.eye(4), xi)
    np.testing.assert_allclose(rotations[0], T[:3, :3], atol=1e-4)
    np.testing.assert_allclose(shifts[0], xi[:3], atol=1e-4)


def test_the_short_way_through_a_well_known_system_is_the_long_one() -> None:
    rng = np.random.default_rng(6)
    for _ in range(20):
        root = rng.standard_normal((6, 6))
        H, b = 1e5 * (root @ root.T + 6.0 * np.eye(6)), rng.standard_normal(6)
        step, covariance, constrained = solver.constrained_solution(H, b, 0.01)
        assert constrained == 6
        np.testing.assert_allclose(step, np.linalg.solve(H, b), rtol=1e-9)
        np.testing.assert_allclose(covariance, np.linalg.inv(H), rtol=1e-8)
        L = np.zeros((6, 6))
        least = float(np.linalg.eigvalsh(H)[0])
        assert solver.cholesky(H, 0.999 * least, L) and not solver.cholesky(H, 1.001 * least, L)


def test_poses_stay_rigid_over_many_motions() -> None:
    rng = np.random.default_rng(7)
    poses, moved, deviations = np.eye(4)[None].copy(), np.zeros(1), np.zeros(1)
    covariance, yes = np.diag([1.0] * 3 + [0.25] * 3)[None], np.ones(1, bool)
    expected = np.eye(3)
    for _ in range(500):
        phi = 0.02 * rng.standard_normal(3)
        solver.advance(poses, exp_so3(phi)[None], np.zeros((1, 3)), np.ones(1), covariance, yes, moved, deviations)
        expected = exp_so3(phi) @ expected
        assert abs(moved[0] - np.linalg.norm(phi)) < 1e-4
        assert abs(deviations[0] - 2.0 * np.linalg.norm(phi)) < 1e-3
    np.testing.assert_allclose(poses[0, :3, :3] @ poses[0, :3, :3].T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(poses[0, :3, :3], expected, atol=1e-11)


def _moved_by_gauss_newton(points: Points, centre: np.ndarray, steps: int, last_step: float) -> tuple[np.ndarray, ...]:
    settings = solver.SolverSettings(3.0, 3.0, solver.EDGES_NEVER, 0.0015, 0.01, 0.01, 0.1, last_step)
    rotations, shifts = np.eye(3)[None].copy(), np.zeros((1, 3))
    covariance, constrained, stats = np.zeros((1, 6, 6)), np.zeros(1, np.int64), np.zeros((1, 3))
    solver.gauss_newton(
        points, len(points.weight), Edges.room(0), 0, CAMERA, centre[None], rotations, shifts, np.array([0.1]),
        np.ones((1, 2)), np.ones(1, bool), settings, steps, covariance, constrained, stats,
    )  # fmt: skip
    return rotations[0], shifts[0], covariance[0]


def test_a_few_robust_steps_are_enough_under_noise() -> None:
    rng = np.random.default_rng(4)
    _, model, normal = _points(rng, 400)
    centre, sigma = np.array([0.0, 0.0, 1.0]), 0.001
    xi = np.array([0.001, -0.0005, 0.001, 0.01, -0.005, 0.005])
    measured = centre + (model - centre) @ exp_so3(xi[3:]).T + xi[:3] + sigma * rng.standard_normal((400, 3))
    points = Points(measured, model, normal, np.full(400, sigma**-2), np.zeros(400, np.int32))
    R_end, t_end, P_end = _moved_by_gauss_newton(points, centre, 40, 0.0)
    R, t, _ = _moved_by_gauss_newton(points, centre, 3, 0.0)
    assert np.linalg.norm(t - t_end) < 2e-6  # of 1.5 mm; with the weights' own step length it is ten times as much
    assert np.linalg.norm(R - R_end) < 5e-5

    R, t, P = _moved_by_gauss_newton(points, centre, 40, 1e-5)  # ends by itself, and knows as much
    assert np.linalg.norm(t - t_end) < 1e-6
    np.testing.assert_allclose(np.diag(P), np.diag(P_end), rtol=0.01)


def test_what_is_marked_is_taken_once_in_order() -> None:
    height, width = 31, 50  # no multiples of the cells' size
    marks = no_marks(height, width)
    pixels, rows = np.array([7 * width + 12, 30 * width + 48, 20 * width + 4], np.int32), np.array([0, 1, 2], np.int32)
    strides, fine = np.array([2, 4, 4]), np.array([1, 2, 4])
    mark_around(pixels, rows, width, strides, fine, marks)
    taken = take_marked(marks, height, width)
    assert np.all(np.diff(taken) > 0)
    assert taken[-1] < height * width
    v, u = np.divmod(taken, width)
    for pixel, row in zip(pixels, rows, strict=True):
        f, reach = int(fine[row]), int(strides[row] + 2 * fine[row] + 2)
        wanted = {
            (y, x)
            for y in range(height)
            for x in range(width)
            if abs(y - pixel // width) <= reach and abs(x - pixel % width) <= reach and y % f == 0 and x % f == 0
        }
        assert wanted <= set(zip(v.tolist(), u.tolist(), strict=True))
    assert len(taken) < 0.5 * height * width
    assert len(take_marked(marks, height, width)) == 0
