import numpy as np

from simtrack.geometry.transforms import perturb, transform
from simtrack.raycast.sweep import sweep


def test_shots_leave_from_where_the_sensor_is_at_their_own_time() -> None:
    rng = np.random.default_rng(3)
    poses = [transform(None, (1.0, 2.0, 0.5))]
    for _ in range(3):
        poses.append(perturb(poses[-1], rng.normal(0.0, 0.05, 6)))
    directions = rng.normal(size=(50, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    times = np.linspace(0.0, 0.3, 50).astype(np.float32)
    origins, turned = sweep(directions, times, 0.1, np.array(poses))
    for i, t in enumerate(times):
        lower = min(int(t / 0.1), 2)
        share = t / 0.1 - lower
        T = (1.0 - share) * poses[lower] + share * poses[lower + 1]
        ahead = T[:3, :3] @ directions[i]
        np.testing.assert_allclose(origins[i], T[:3, 3], atol=1e-5)
        np.testing.assert_allclose(turned[i], ahead / np.linalg.norm(ahead), atol=1e-5)


def test_a_sensor_at_rest_turns_nothing_but_its_frame() -> None:
    T = perturb(np.eye(4), np.array([0.3, -0.2, 0.1, 0.4, 0.5, -0.6]))
    directions = np.eye(3, dtype=np.float32)
    origins, turned = sweep(directions, np.array([0.0, 0.5, 1.0], np.float32), 1.0, np.array([T, T]))
    np.testing.assert_allclose(origins, np.tile(T[:3, 3], (3, 1)), atol=1e-6)
    np.testing.assert_allclose(turned, T[:3, :3].T, atol=1e-6)
