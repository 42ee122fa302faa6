import json
from collections.abc import Callable
from pathlib import Path
from typing import cast

import cv2
import gymnasium as gym
import numpy as np
import pytest

from simtrack.envs.actions import MOVES
from simtrack.envs.bop_recorder import BopRecorder
from simtrack.envs.environment import SimtrackEnv
from simtrack.envs.observations import Arrays
from simtrack.envs.wrappers import DiscreteActions, FlatBelief, Recorder, Video
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.transforms import transform_planar

Make = Callable[..., SimtrackEnv]


def test_discrete_moves_do_what_they_are_called(make: Make) -> None:
    env = DiscreteActions(make())
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.names.index("look left"))
    assert env.unwrapped.steering.command.head_pan == pytest.approx(3 * 0.1 * 2.0 * MOVES["look left"]["pan"])  # type: ignore[attr-defined]
    with pytest.raises(InvalidValueError, match="10"):
        env.action(11)


def test_a_flat_belief_does_not_depend_on_where_the_map_has_its_origin(make: Make) -> None:
    env = make()
    flat = FlatBelief(env)
    arrays = cast(Arrays, env.reset(seed=0)[0])
    moved = {key: value.copy() for key, value in arrays.items()}
    T = transform_planar(3.0, -2.0, 0.7)
    mask = moved["mask"].astype(bool)
    moved["position"][mask] = moved["position"][mask] @ T[:3, :3].T + T[:3, 3]
    moved["velocity"] = np.concatenate([moved["velocity"][:, k : k + 3] @ T[:3, :3].T for k in (0, 3)], axis=1)
    x, y, c, s = moved["base"]
    heading = np.arctan2(s, c) + 0.7
    moved["base"] = np.array([*(T[:2, :2] @ np.array([x, y]) + T[:2, 3]), np.cos(heading), np.sin(heading)], np.float32)
    np.testing.assert_allclose(flat.observation(arrays), flat.observation(moved), atol=2e-5)
    assert flat.observation(arrays) in flat.observation_space
    with pytest.raises(UnknownNameError, match="state"):
        FlatBelief(env, "belief")


def test_gymnasiums_frame_stack_takes_flat_beliefs(make: Make) -> None:
    env = gym.wrappers.FrameStackObservation(FlatBelief(make()), 3)
    first, _ = env.reset(seed=0)
    second, *_ = env.step(env.action_space.sample())
    np.testing.assert_array_equal(second[:2], first[1:])
    assert second in env.observation_space


def test_a_video_has_a_frame_for_every_moment(make: Make, tmp_path: Path) -> None:
    env = Video(make(seconds=0.3), tmp_path / "new" / "run.mp4")
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros(5, np.float32))
    env.close()
    video = cv2.VideoCapture(str(tmp_path / "new" / "run.mp4"))
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    assert len(frames) == 4 and frames[0].shape == (480, 640, 3) and np.ptp(frames[0]) > 100


def test_an_episode_becomes_a_log_that_can_be_read(make: Make, tmp_path: Path) -> None:
    from simtrack.contracts import RgbdFrame
    from simtrack.recordings import open_recording

    env = Recorder(make(observation="rgbd", image_size=(16, 12)), tmp_path)
    for seed in range(2):
        env.reset(seed=seed)
        env.step(np.zeros(5, np.float32))
    shown = env.unwrapped.snapshot.image.depth  # type: ignore[attr-defined]
    env.close()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["episode-0000.mcap", "episode-0001.mcap"]
    frames = [f for f in open_recording(tmp_path / "episode-0001.mcap").sensor_frames() if isinstance(f, RgbdFrame)]
    assert len(frames) == 2
    np.testing.assert_allclose(frames[-1].depth, shown, atol=1e-3)


def test_without_a_camera_there_is_nothing_to_record(make: Make, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="rgbd"):
        Recorder(make(observation="state"), tmp_path)


def test_episodes_become_a_data_set_that_shows_what_was_true(make: Make, tmp_path: Path) -> None:
    env = BopRecorder(make(observation="rgbd", seconds=0.3), tmp_path / "new", every=3)
    truths = []
    for seed in (0, 1):
        _, info = env.reset(seed=seed)
        truths.append(info["truth"])
        for _ in range(3):
            env.step(np.zeros(5, np.float32))
    env.close()
    split = tmp_path / "new" / "bop" / "train_pbr"
    for scene, truth in enumerate(truths):
        folder = split / f"{scene:06d}"
        assert len(list((folder / "rgb").iterdir())) == 2
        poses = json.loads((folder / "scene_gt.json").read_text())["0"]
        camera = json.loads((folder / "scene_camera.json").read_text())["0"]
        R_w2c, t_w2c = np.reshape(camera["cam_R_w2c"], (3, 3)), np.array(camera["cam_t_w2c"])
        found = sorted(tuple(R_w2c.T @ (np.array(p["cam_t_m2c"]) - t_w2c) / 1e3) for p in poses)
        wanted = sorted(tuple(T[:3, 3]) for T in truth["poses"])
        np.testing.assert_allclose(found, wanted, atol=1e-3)
    with pytest.raises(InvalidValueError, match="empty"):
        BopRecorder(make(observation="rgbd"), tmp_path / "new")
    with pytest.raises(InvalidValueError, match="rgbd"):
        BopRecorder(make(observation="state"), tmp_path / "other")
