from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from simtrack.benchmarks import feed as module
from simtrack.benchmarks.feed import Feed
from simtrack.contracts import CameraIntrinsics, JointState, RgbdFrame, SensorFrame
from simtrack.errors import SimtrackError
from simtrack.recordings import McapWriter

K = CameraIntrinsics(40, 30, 35.0, 35.0, 19.5, 14.5)


def _frames(count: int) -> list[SensorFrame]:
    rng = np.random.default_rng(0)
    frames: list[SensorFrame] = []
    for k in range(count):
        depth = rng.uniform(0.5, 4.0, (30, 40)).astype(np.float32)
        rgb = rng.integers(0, 255, (30, 40, 3), np.uint8) if k % 3 == 0 else None
        frames.append(RgbdFrame(10 * k, depth, rgb, K, np.eye(4), k))
        frames.append(JointState(10 * k + 5, ("wheel",), np.array([0.1 * k])))
    return frames


def _written(path: Path, frames: list[SensorFrame]) -> Path:
    with McapWriter(path) as log:
        for frame in frames:
            log.write(frame)
    return path


def _same(a: SensorFrame, b: SensorFrame) -> bool:
    return type(a) is type(b) and all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))


def test_what_comes_out_is_what_was_recorded_however_often_the_ring_goes_round(tmp_path: Path) -> None:
    frames = _frames(module.SLOTS + 20)
    with Feed(_written(tmp_path / "log.mcap", frames)) as feed:
        taken = [feed.take() for _ in frames]
        assert feed.take() is None
    assert all(b is not None and _same(a, b) for a, b in zip(frames, taken, strict=True))


def test_what_is_wrong_with_a_recording_is_told(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(b"no recording")
    with Feed(path) as feed, pytest.raises(SimtrackError, match=r"log\.mcap"):
        feed.take()


def test_one_can_leave_before_the_end(tmp_path: Path) -> None:
    path = _written(tmp_path / "log.mcap", _frames(module.SLOTS + 20))
    with Feed(path) as feed:
        assert feed.take() is not None
    with pytest.raises((EOFError, OSError)):
        feed.take()
