"""What is done beside the frames is taken up when the stamps say so, whatever the threads do."""

import os
import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from simtrack.contracts import (
    NANOSECONDS,
    Belief,
    CameraIntrinsics,
    DetectionResult,
    LidarScan,
    Odometry,
    RegionOfInterest,
    RgbdFrame,
    SensorFrame,
    StaticMap,
)
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import box_mesh
from simtrack.geometry.transforms import transform
from simtrack.objects.tiago import tiago
from simtrack.perception import beside
from simtrack.perception.beside import NICENESS, Beside, Paced, worker
from simtrack.perception.pipeline import PerceptionStack
from simtrack.perception.stack_config import StackConfig
from simtrack.raycast import RayBundle, RayScene, TriangleMesh

K = CameraIntrinsics(80, 60, 70.0, 70.0, 39.5, 29.5)
T_BASE_CAMERA = transform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), (0.2, 0.0, 1.2))
T_BASE_LIDAR = transform(translation=(0.0, 0.0, 1.4))
START = transform(translation=(0.3, -0.2, 0.0))
IMAGE, TURN = NANOSECONDS // 30, NANOSECONDS // 10


class Asked:
    """A detector that finds nothing and remembers what it was asked."""

    def __init__(self) -> None:
        self.calls: list[tuple[int, tuple[RegionOfInterest, ...]]] = []

    def detect(self, frame: RgbdFrame, regions: object = ()) -> DetectionResult:
        assert isinstance(regions, tuple)
        self.calls.append((frame.stamp, regions))
        return DetectionResult(frame.stamp, frame.stamp + 150_000_000, ())


def _room() -> StaticMap:
    room = box_mesh(np.array([6.0, 5.0, 3.0]))
    vertices = (room.vertices + np.array([0, 0, 1.5])).astype(np.float32)
    return StaticMap(vertices, room.faces[:, ::-1].astype(np.int32).copy())


def _feed(static_map: StaticMap, seconds: float) -> list[SensorFrame]:
    """A robot that stands in the room, before it a box that the map does not know; in the order of arrival."""
    with RayScene() as scene:
        scene.add(TriangleMesh(static_map.vertices, static_map.faces))
        box = box_mesh(np.array([0.4, 0.4, 0.4]))
        scene.add(TriangleMesh(box.vertices, box.faces), transform(translation=(2.0, 0.0, 1.0)))
        bundle = RayBundle.from_camera(K)
        depth = scene.cast(bundle, START @ T_BASE_CAMERA).distances.reshape(bundle.shape)
        azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, 360), np.deg2rad(np.arange(-15.0, 16.0, 2.0)))
        rays = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
        )
        rays = rays.reshape(-1, 3).astype(np.float32)
        ranges = scene.cast(RayBundle.from_directions(rays), START @ T_BASE_LIDAR).distances
    rings, times = np.repeat(np.arange(16, dtype=np.uint8), 360), np.tile(np.linspace(0.0, 0.099, 360), 16)
    scan = LidarScan(0, rays, ranges, times.astype(np.float32), rings, np.zeros(len(rays), np.float32), T_BASE_LIDAR)
    frames: list[tuple[int, SensorFrame]] = []
    for k in range(1, round(30 * seconds)):
        frames.append((k * IMAGE, RgbdFrame(k * IMAGE, depth, None, K, T_BASE_CAMERA, k)))
    for k in range(round(10 * seconds)):
        frames.append(((k + 1) * TURN, replace(scan, stamp=k * TURN, sequence=k)))
    for k in range(round(50 * seconds)):
        frames.append((k * NANOSECONDS // 50, Odometry(k * NANOSECONDS // 50, np.eye(4), 0.0, 0.0)))
    return [frame for _, frame in sorted(frames, key=lambda entry: entry[0])]


@pytest.fixture(scope="module")
def room() -> StaticMap:
    return _room()


def _beliefs(
    room: StaticMap, feed: list[SensorFrame], detector: Asked, config: StackConfig | None = None
) -> list[Belief]:
    stack = PerceptionStack(room, {}, tiago(), detector, T_map_base=START, config=config)
    try:
        return [belief for frame in feed if (belief := stack.process(frame)) is not None]
    finally:
        stack.close()


def _figures(belief: Belief) -> tuple:
    parts = [(p.stamp, p.unknown.tobytes(), p.labels.tobytes()) for p in (belief.camera, belief.lidar) if p is not None]
    pose = belief.localization
    return belief.stamp, pose.T_map_base.tobytes(), pose.covariance.tobytes(), dict(belief.status), parts


def test_beliefs_do_not_depend_on_how_long_anything_takes(room: StaticMap, monkeypatch: pytest.MonkeyPatch) -> None:
    feed = _feed(room, 0.7)
    usual = _beliefs(room, feed, Asked())
    timed, pauses = beside._timed, iter(np.random.default_rng(3).uniform(0.0, 0.03, 1000).tolist())

    def dawdle(work: Callable[[], object]) -> tuple[object, float]:
        time.sleep(next(pauses))
        return timed(work)

    monkeypatch.setattr(beside, "_timed", dawdle)
    slow = _beliefs(room, feed, Asked())
    assert [_figures(a) for a in usual] == [_figures(b) for b in slow]
    names = {thread.name for thread in threading.enumerate()}
    alone = _beliefs(room, feed, Asked(), StackConfig(threads=False))
    assert [_figures(a) for a in usual] == [_figures(b) for b in alone]
    assert {thread.name for thread in threading.enumerate()} <= names
    assert any(belief.lidar is not None for belief in usual)


def test_answers_come_when_their_time_is_up(room: StaticMap) -> None:
    config, detector = StackConfig(), Asked()
    beliefs = _beliefs(room, _feed(room, 0.7), detector)
    lag = round(config.segmentation_time * NANOSECONDS)
    segmented = [b for b in beliefs if b.camera is not None]
    assert segmented
    for belief in segmented:
        assert belief.camera is not None
        assert lag <= belief.stamp - belief.camera.stamp < lag + IMAGE
        assert belief.camera.regions  # the box
        # The detector gets the image that was segmented, with what was found in it.
        assert (belief.camera.stamp, belief.camera.regions) in detector.calls
    vague = [float(np.trace(b.localization.covariance)) for b in beliefs]
    corrected = [
        b.stamp for k, b in enumerate(beliefs) if k and vague[k] < vague[k - 1] and b.stamp > 0.4 * NANOSECONDS
    ]
    assert corrected
    lag = round(config.correction_time * NANOSECONDS)
    for stamp in corrected:  # the pose is sure by now
        assert any(lag <= stamp - end < lag + IMAGE for end in range(99_000_000, NANOSECONDS, TURN))


def test_a_piece_is_settled_once_and_not_before_its_time() -> None:
    thread = worker("test")
    piece = Beside[str](thread, 0.05)
    assert not piece.busy
    piece.begin(1_000, lambda: threading.current_thread().name)
    assert piece.busy
    assert not piece.due(1_000 + 49_999_999)
    assert piece.due(1_000 + 50_000_000)
    assert piece.settle().startswith("simtrack-test")
    assert not piece.busy
    assert piece.seconds >= 0.0
    thread.shutdown()


def test_what_the_work_raises_is_raised_where_it_is_settled() -> None:
    def fail() -> None:
        raise ValueError("no data")

    thread = worker("test")
    piece = Beside[None](thread, 0.0)
    piece.begin(0, fail)
    with pytest.raises(ValueError, match="no data"):
        piece.settle()
    piece.begin(1, lambda: None)  # and the next one can begin
    piece.settle()
    thread.shutdown()


def test_without_threads_the_caller_does_the_work_and_learns_of_it_when_it_settles() -> None:
    def fail() -> str:
        raise ValueError("no data")

    here = worker("test", threads=False)
    piece = Beside[str](here, 0.05)
    piece.begin(0, lambda: threading.current_thread().name)
    assert not piece.due(0) and piece.due(50_000_000)
    assert piece.settle() == threading.current_thread().name
    piece.begin(0, fail)
    with pytest.raises(ValueError, match="no data"):
        piece.settle()
    paced = Paced[int](here, 1e-6, lambda step: [step(), step()].count(None))
    assert paced.end(0, 1_999) is None and paced.end(0, 2_000) == 2_000 and paced.settle() == 2
    here.shutdown()


def test_the_past_cannot_be_waited_for() -> None:
    with pytest.raises(InvalidValueError, match=">= 0 s"):
        Beside[None](worker("test"), -1.0)


def test_a_piece_ends_when_its_own_steps_say_so_however_slow_the_machine() -> None:
    thread, go_on = worker("test"), threading.Event()

    def work(step: Callable[[], None]) -> str:
        step()
        step()
        go_on.wait()
        step()
        return "done"

    piece = Paced[str](thread, 1e-6, work)
    assert piece.end(5_000, 6_000) is None  # known after two steps: no need to wait for the third
    go_on.set()
    assert piece.end(5_000, 7_999) is None
    assert piece.end(5_000, 8_000) == 8_000
    assert piece.end(7_000, 20_000) == 10_000
    assert piece.settle() == "done"
    thread.shutdown()


def test_a_piece_that_fails_ends() -> None:
    def fail(step: Callable[[], None]) -> None:
        step()
        raise ValueError("no data")

    thread = worker("test")
    piece = Paced[None](thread, 1e-6, fail)
    assert piece.end(0, 1_000_000) == 1_000
    with pytest.raises(ValueError, match="no data"):
        piece.settle()
    thread.shutdown()


def test_who_does_not_wait_takes_an_answer_up_when_it_is_there() -> None:
    thread, gate = worker("test"), threading.Event()
    patient, hasty = Beside[str](thread, 0.1), Beside[str](thread, 0.1, wait=False)
    hasty.begin(0, lambda: str(gate.wait(10.0)))
    patient.begin(0, lambda: "late")
    assert not hasty.due(NANOSECONDS) and patient.due(NANOSECONDS) and not patient.due(NANOSECONDS // 20)
    gate.set()
    assert patient.settle() == "late"  # the same thread has ended the other one before
    assert not hasty.due(NANOSECONDS // 20) and hasty.due(NANOSECONDS // 10) and hasty.settle() == "True"
    thread.shutdown()


def test_paced_work_of_who_does_not_wait_has_no_end_before_it_has_ended() -> None:
    thread, gate = worker("test"), threading.Event()

    def work(step: Callable[[], None]) -> int:
        step()
        gate.wait(10.0)
        step()
        return 7

    paced = Paced[int](thread, 0.01, work, wait=False)
    assert paced.end(0, NANOSECONDS) is None
    gate.set()
    assert paced.settle() == 7
    thread.shutdown()
    assert paced.end(0, NANOSECONDS) == NANOSECONDS // 50 and paced.end(0, NANOSECONDS // 100) is None


def test_a_live_robot_goes_on_while_it_is_at_work_on_a_scan(room: StaticMap, monkeypatch: pytest.MonkeyPatch) -> None:
    timed, gate = beside._timed, threading.Event()

    def stuck(work: Callable[[], object]) -> tuple[object, float]:
        gate.wait(20.0)
        return timed(work)

    monkeypatch.setattr(beside, "_timed", stuck)
    feed = _feed(room, 0.7)
    stack = PerceptionStack(room, {}, tiago(), Asked(), T_map_base=START, config=StackConfig.live())
    try:
        stuck_beliefs = [belief for frame in feed if (belief := stack.process(frame)) is not None]
        assert [b.stamp for b in stuck_beliefs] == [f.stamp for f in feed if isinstance(f, RgbdFrame)]
        assert all(belief.lidar is None and belief.camera is None for belief in stuck_beliefs)
        gate.set()
        later = [replace(f, stamp=f.stamp + NANOSECONDS) for f in feed]
        beliefs = []
        for frame in later:
            time.sleep(0.002)
            beliefs.append(stack.process(frame))
        sure = [float(np.trace(b.localization.covariance)) for b in beliefs if b is not None]
        assert min(sure) < 0.1 * float(np.trace(stuck_beliefs[-1].localization.covariance))
    finally:
        gate.set()
        stack.close()


@pytest.mark.skipif(not hasattr(os, "getpriority"), reason="this system knows no niceness of threads")
def test_work_that_no_frame_waits_for_leaves_the_processor_to_the_frames() -> None:
    def niceness() -> int:
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    own, waited, unwaited = niceness(), worker("a"), worker("b", wait=False)
    assert waited.submit(niceness).result() == own
    assert unwaited.submit(niceness).result() == min(19, max(own, NICENESS))
    assert niceness() == own
    for thread in (waited, unwaited):
        thread.shutdown()
