"""The stack takes whatever a feed throws at it: a status, state kept, never a NaN."""

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from simtrack.contracts import (
    Belief,
    CameraIntrinsics,
    DetectionResult,
    JointState,
    LidarScan,
    Odometry,
    RgbdFrame,
    StaticMap,
    Status,
)
from simtrack.geometry.meshes import box_mesh
from simtrack.geometry.transforms import transform
from simtrack.objects import load_object
from simtrack.objects.tiago import tiago
from simtrack.perception.pipeline import PerceptionStack

K = CameraIntrinsics(80, 60, 70.0, 70.0, 39.5, 29.5)
T_BASE_CAMERA = transform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), (0.2, 0.0, 1.2))
PERIOD = 33_333_333


class Silent:
    """Detects nothing, or raises."""

    raising = False

    def detect(self, frame: RgbdFrame, regions: object = ()) -> DetectionResult:
        if self.raising:
            raise RuntimeError("the network's server is gone")
        return DetectionResult(frame.stamp, frame.stamp + 100_000_000, ())


@pytest.fixture(scope="module")
def stack() -> Iterator[PerceptionStack]:
    room = box_mesh(np.array([6.0, 5.0, 3.0]))
    vertices = (room.vertices + np.array([0, 0, 1.5])).astype(np.float32)
    static_map = StaticMap(vertices, room.faces[:, ::-1].astype(np.int32).copy())
    built = PerceptionStack(static_map, {"relay": load_object("relay")}, tiago(), Silent(), T_map_base=np.eye(4))
    yield built
    built.close()


def _image(stamp: int, kind: str, rng: np.random.Generator) -> RgbdFrame:
    depth = rng.uniform(0.5, 4.0, (60, 80)).astype(np.float32)
    T, intrinsics = T_BASE_CAMERA, K
    if kind == "no depth":
        depth[:] = 0.0
    elif kind == "nan":
        depth[rng.random(depth.shape) < 0.5] = np.nan
    elif kind == "all nan":
        depth[:] = np.nan
    elif kind == "infinite":
        depth[::2] = np.inf
    elif kind == "negative":
        depth = -depth
    elif kind == "wrong shape":
        depth = depth[:20]
    elif kind == "no pose":
        T = np.full((4, 4), np.nan)
    elif kind == "no focal length":
        intrinsics = CameraIntrinsics(80, 60, 0.0, np.nan, 39.5, 29.5)
    return RgbdFrame(stamp, depth, None, intrinsics, T)


def _scan(stamp: int, kind: str, rng: np.random.Generator) -> LidarScan:
    n = 0 if kind == "empty" else 400
    directions = rng.standard_normal((n, 3))
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    ranges = rng.uniform(0.5, 5.0, n).astype(np.float32)
    if kind == "no return":
        ranges[:] = np.inf
    elif kind == "nan":
        ranges[::2] = np.nan
    elif kind == "negative":
        ranges[:] = -1.0
    times = np.linspace(0, 0.099, n, dtype=np.float32)
    T = transform(translation=(-0.1, 0.0, 1.15))
    return LidarScan(
        stamp, directions.astype(np.float32), ranges, times, np.zeros(n, np.uint8), np.zeros(n, np.float32), T
    )


IMAGES = ("good", "no depth", "nan", "all nan", "infinite", "negative", "wrong shape", "no pose", "no focal length")
SCANS = ("good", "empty", "no return", "nan", "negative")
events = st.one_of(
    st.tuples(st.just("image"), st.sampled_from(IMAGES)),
    st.tuples(st.just("scan"), st.sampled_from(SCANS)),
    st.tuples(st.just("odometry"), st.sampled_from(("good", "nan"))),
    st.tuples(st.just("joints"), st.sampled_from(("good", "nan", "short"))),
)
steps = st.sampled_from((PERIOD, PERIOD, PERIOD, 0, -PERIOD, 10 * PERIOD))


def _assert_sane(belief: Belief) -> None:
    assert np.isfinite(belief.T_map_camera).all()
    assert np.isfinite(belief.localization.T_map_base).all()
    assert np.isfinite(belief.localization.covariance).all()
    for track in belief.tracks:
        assert np.isfinite(track.T_map_object).all()
        assert np.isfinite(track.covariance).all()
    for part in (belief.camera, belief.lidar):
        if part is not None:
            assert all(np.isfinite(r.centre).all() and np.isfinite(r.extents).all() for r in part.regions)
    assert all(isinstance(s, Status) for s in belief.status.values())


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(events, steps, st.booleans()), min_size=1, max_size=12), st.integers(0, 2**31))
def test_any_feed_is_survived(stack: PerceptionStack, feed: list, seed: int) -> None:
    rng = np.random.default_rng(seed)
    last = stack._belief.stamp if stack._belief is not None else 0
    stamp = last + PERIOD
    for (sensor, kind), step, raising in feed:
        Silent.raising = raising
        stamp = max(0, stamp + step)
        match sensor:
            case "image":
                belief = stack.process(_image(stamp, kind, rng))
                assert belief is not None
                assert belief.stamp >= last
                last = belief.stamp
                _assert_sane(belief)
            case "scan":
                stack.process(_scan(stamp, kind, rng))
            case "odometry":
                T = np.full((4, 4), np.nan) if kind == "nan" else np.eye(4)
                stack.process(Odometry(stamp, T, 0.0, 0.0))
            case _:
                positions = np.array([np.nan, 0.0] if kind == "nan" else [0.1] if kind == "short" else [0.1, 0.2])
                stack.process(JointState(stamp, ("torso_lift_joint", "head_1_joint"), positions))
    Silent.raising = False


def test_statuses_tell_what_was_wrong(stack: PerceptionStack) -> None:
    rng = np.random.default_rng(0)
    stamp = (stack._belief.stamp if stack._belief is not None else 0) + 100 * PERIOD
    good = stack.process(_image(stamp, "good", rng))
    assert good is not None
    assert good.status["frame"] is Status.OK
    for kind, expected in (("no depth", Status.NO_DATA), ("wrong shape", Status.FAILED), ("no pose", Status.FAILED)):
        stamp += PERIOD
        belief = stack.process(_image(stamp, kind, rng))
        assert belief is not None
        assert belief.status["frame"] is expected
    again = stack.process(_image(stamp - 10 * PERIOD, "good", rng))
    assert again is not None
    assert again.status["frame"] is Status.STALE
    assert again.stamp >= good.stamp
