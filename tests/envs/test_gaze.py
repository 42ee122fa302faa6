"""The gaze that is learned: what it sees does not depend on slots, and it gets to where it wants to look."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from simtrack.envs.environment import SimtrackEnv
from simtrack.envs.learning import GazeTraining, layers_of
from simtrack.envs.policies import make_policy
from simtrack.envs.policies.gaze import FEATURES, LEVEL, NETWORK, PAN, TILT, TURN, Gaze
from simtrack.envs.settings import CONTROL_HZ
from simtrack.errors import FileFormatError, StageError, UnknownNameError
from simtrack.geometry.transforms import wrapped

Make = Callable[..., SimtrackEnv]
SLOTS = 16


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def belief(rng: np.random.Generator, heading: float = 0.3) -> dict[str, np.ndarray]:
    """Arrays of a belief in five objects and two regions."""
    mask = np.zeros(SLOTS)
    mask[rng.permutation(SLOTS)[:5]] = 1.0
    return {
        "mask": mask,
        "position": rng.normal(size=(SLOTS, 3)),
        "covariance": np.broadcast_to(np.eye(6) * 1e-4, (SLOTS, 6, 6)),
        "status": np.eye(5)[rng.integers(0, 5, SLOTS)],
        "age": rng.uniform(0.0, 8.0, SLOTS),
        "visible": rng.uniform(size=SLOTS),
        "moving": rng.integers(0, 2, SLOTS).astype(float),
        "unexplained": np.array([0.1]),
        "regions": rng.normal(size=(12, 3)),
        "regions_mask": (np.arange(12) < 2).astype(float),
        "base": np.array([0.5, -0.2, np.cos(heading), np.sin(heading)]),
        "joints": np.array([0.2, -0.4, 0.3]),
        "speed": np.zeros(2),
        "time": np.array([3.0]),
    }


def test_it_does_not_matter_which_slots_objects_are_in(rng: np.random.Generator) -> None:
    arrays = belief(rng)
    order = rng.permutation(SLOTS)
    names = ("mask", "position", "covariance", "status", "age", "visible", "moving")
    shuffled = {name: value[order] if name in names else value for name, value in arrays.items()}
    seen = Gaze(30.0).features(arrays)
    assert seen.shape == (FEATURES,) and np.abs(seen).max() <= 3.0
    np.testing.assert_array_equal(seen, Gaze(30.0).features(shuffled))


def test_turning_with_the_world_changes_nothing_that_is_seen(rng: np.random.Generator) -> None:
    arrays = belief(rng, 0.0)
    c, s = np.cos(1.1), np.sin(1.1)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    x, y, _ = R @ [*arrays["base"][:2], 0.0]
    turned = arrays | {name: arrays[name] @ R.T for name in ("position", "regions")} | {"base": np.array([x, y, c, s])}
    np.testing.assert_allclose(Gaze(30.0).features(turned), Gaze(30.0).features(arrays), atol=1e-6)


@pytest.mark.parametrize("wanted", [(0.0, 0.0, 0.0), (0.9, -0.8, 0.5), (-0.6, 1.0, -1.0)])
def test_speeds_lead_to_the_posture_that_is_asked_for(rng: np.random.Generator, wanted: tuple[float, ...]) -> None:
    from simtrack.envs.actions import AXES

    gaze, arrays, heading = Gaze(30.0), belief(rng, 2.9), 2.9
    gaze.features(arrays)
    for _ in range(60):
        speeds = gaze.speeds(np.array(wanted, np.float32), arrays) * list(AXES.values()) / CONTROL_HZ
        heading = np.arctan2(arrays["base"][3], arrays["base"][2]) + speeds[1]
        arrays["base"] = np.array([0.5, -0.2, np.cos(heading), np.sin(heading)])
        arrays["joints"] = arrays["joints"] + np.array([speeds[2], speeds[3], 0.0])
    assert wrapped(float(heading) - 2.9 - wanted[0] * TURN) == pytest.approx(0.0, abs=0.02)
    assert arrays["joints"][:2] == pytest.approx([wanted[1] * PAN, LEVEL + wanted[2] * TILT], abs=0.02)


def test_a_folder_without_a_network_is_refused_and_one_with_it_plays(make: Make, tmp_path: Path) -> None:
    env = make(seconds=0.3)
    observation, _ = env.reset(seed=0)
    with pytest.raises(UnknownNameError, match="scripted"):
        make_policy(str(tmp_path / "nothing"), "active-perception", env.briefing(), 5, "state")
    with pytest.raises(FileFormatError, match="simtrack train agent"):
        make_policy(str(tmp_path), "active-perception", env.briefing(), 5, "state")
    np.savez(tmp_path / NETWORK, weight0=np.zeros((3, 7)), bias0=np.zeros(3))
    with pytest.raises(FileFormatError, match="must take"):
        make_policy(str(tmp_path), "active-perception", env.briefing(), 5, "state")
    np.savez(tmp_path / NETWORK, weight0=np.zeros((3, FEATURES)), bias0=np.array([0.5, 0.0, 0.0]))
    policy = make_policy(str(tmp_path), "active-perception", env.briefing(), 5, "state")
    action = policy.act(observation)
    assert env.action_space.contains(action) and action[1] > 0.5  # it turns to the left


def test_learning_without_its_extra_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(StageError, match=r"simtrack\[rl\]"):
        GazeTraining(tmp_path)


def test_the_network_that_is_kept_is_the_one_that_has_learned(rng: np.random.Generator) -> None:
    stable_baselines3 = pytest.importorskip("stable_baselines3", reason="needs the extra rl")
    import gymnasium as gym

    class Still(gym.Env):
        observation_space = gym.spaces.Box(-3.0, 3.0, (FEATURES,), np.float32)
        action_space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)

    kwargs = {"net_arch": {"pi": [64, 64], "vf": [64, 64]}}
    model = stable_baselines3.PPO("MlpPolicy", Still(), policy_kwargs=kwargs, device="cpu", n_steps=8, batch_size=8)
    layers = layers_of(model.policy.state_dict())
    seen = rng.uniform(-1.0, 1.0, FEATURES).astype(np.float32)
    value = seen
    for k in range(2):
        value = np.tanh(layers[f"weight{k}"] @ value + layers[f"bias{k}"])
    answer = np.clip(layers["weight2"] @ value + layers["bias2"], -1.0, 1.0)
    np.testing.assert_allclose(answer, model.predict(seen, deterministic=True)[0], atol=1e-5)
