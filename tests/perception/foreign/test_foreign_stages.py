"""Stages of others: what cannot be loaded is said, what goes wrong on a frame is a missed frame with its reason."""

import json
import re
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from simtrack.contracts import (
    CameraIntrinsics,
    Detection,
    DetectionResult,
    LidarScan,
    Localization,
    Localizer,
    Odometry,
    PoseHypothesis,
    Relation,
    RgbdFrame,
    StaticMap,
    Status,
    Track,
    TrackerResult,
)
from simtrack.errors import InvalidValueError, StageError
from simtrack.evaluation.foreign_stages import fault_metrics, spans, write_faults
from simtrack.geometry.transforms import perturb
from simtrack.objects import ObjectModel, load_object
from simtrack.objects.tiago import tiago
from simtrack.perception.foreign import (
    FaultKind,
    GuardedDetector,
    GuardedLocalizer,
    GuardedSceneGraph,
    GuardedTracker,
    ProcessTracker,
    StageContext,
    build_stage,
    check_stage,
    track_at,
)

DOCS = Path(__file__).parents[3] / "docs"
K = CameraIntrinsics(80, 60, 70.0, 70.0, 39.5, 29.5)
T_MAP_CAMERA = perturb(np.eye(4), np.array([1.0, 2.0, 0.5, 0.1, 0.4, -0.2]))
T_CAMERA_OBJECT = perturb(np.eye(4), np.array([0.05, 0.02, 1.0, 0.3, 0.1, 0.2]))
FAR_OFF = perturb(np.eye(4), np.array([50.0, 20.0, 1000.0, 0.3, 0.1, 0.2]))
HYPOTHESIS = PoseHypothesis("relay", 0, T_CAMERA_OBJECT, np.eye(6) * 1e-4, 1.0, 0.8)
PERIOD = 33_333_333


def frame(number: int) -> RgbdFrame:
    return RgbdFrame(number * PERIOD, np.full((60, 80), 2.0, np.float32), None, K, np.eye(4), number)


@pytest.fixture(scope="module")
def models() -> dict[str, ObjectModel]:
    return {"relay": load_object("relay")}


@pytest.fixture
def context(models: dict[str, ObjectModel]) -> StageContext:
    empty = StaticMap(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    return StageContext(models, empty, tiago(), np.eye(4))


class Scripted:
    """Answers as it is told, frame by frame."""

    def __init__(self, *answers: Callable[[RgbdFrame, Track], object]) -> None:
        self._answers = list(answers)

    def update(self, frame: RgbdFrame, T_map_camera, covariance, hypotheses=()) -> Any:
        return self._answers.pop(0)(frame, track_at(frame, T_map_camera, 1, "relay", T_CAMERA_OBJECT))


def good(frame: RgbdFrame, track: Track) -> TrackerResult:
    return TrackerResult(frame.stamp, (track,), Status.OK)


def crash(frame: RgbdFrame, track: Track) -> TrackerResult:
    raise RuntimeError("out of memory")


def leave(frame: RgbdFrame, track: Track) -> TrackerResult:
    sys.exit(3)


def changed(**values: object) -> Callable[[RgbdFrame, Track], TrackerResult]:
    return lambda frame, track: TrackerResult(frame.stamp, (replace(track, **values),), Status.OK)


def update(guarded: GuardedTracker, number: int) -> TrackerResult:
    return guarded.update(frame(number), T_MAP_CAMERA, np.eye(6) * 1e-6)


WRONG = {
    "raised": (crash, FaultKind.RAISED, "RuntimeError: out of memory"),
    "exit": (leave, FaultKind.RAISED, "SystemExit: 3"),
    "timeout of its own": (lambda f, t: (_ for _ in ()).throw(TimeoutError("server")), FaultKind.RAISED, "server"),
    "none": (lambda f, t: None, FaultKind.INVALID, "NoneType"),
    "old": (lambda f, t: TrackerResult(0, (), Status.OK), FaultKind.INVALID, "the stamp is 0"),
    "old track": (changed(stamp=0), FaultKind.INVALID, "track 1: the stamp is 0"),
    "millimetres": (changed(T_camera_object=FAR_OFF), FaultKind.INVALID, "1001 m away; metres are asked for"),
    "nan": (changed(T_camera_object=np.full((4, 4), np.nan)), FaultKind.INVALID, "T_camera_object is not finite"),
    "scaled": (changed(T_map_object=np.diag([2.0, 2, 2, 1])), FaultKind.INVALID, "no rigid transform"),
    "flat": (changed(T_map_object=np.zeros(16)), FaultKind.INVALID, "not a (4, 4) array"),
    "covariance": (changed(covariance=-np.eye(6)), FaultKind.INVALID, "not positive semidefinite"),
    "class": (changed(class_name="cup"), FaultKind.INVALID, "known: relay"),
    "id": (changed(id=0), FaultKind.INVALID, "an id is an integer from 1"),
    "twice": (lambda f, t: TrackerResult(f.stamp, (t, t), Status.OK), FaultKind.INVALID, "two tracks"),
    "velocity": (changed(velocity=np.zeros(3)), FaultKind.INVALID, "velocity"),
    "status": (changed(status="found"), FaultKind.INVALID, "TrackStatus"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_answer_is_a_missed_frame_and_the_next_one_counts_again(name: str, models) -> None:
    answer, kind, message = WRONG[name]
    guarded = GuardedTracker(Scripted(good, answer, good), models)
    results = [update(guarded, number) for number in range(3)]
    guarded.close()
    assert [len(result.tracks) for result in results] == [1, 0, 1]
    assert [result.status for result in results] == [Status.OK, Status.FAILED, Status.OK]
    (fault,) = guarded.watch.faults
    assert (fault.frame, fault.stamp, fault.kind) == (1, PERIOD, kind)
    assert message in fault.message


def test_a_stage_that_hangs_misses_frames_until_it_is_back(models) -> None:
    free = threading.Event()

    def hang(frame: RgbdFrame, track: Track) -> TrackerResult:
        free.wait(60.0)
        return good(frame, track)

    guarded = GuardedTracker(Scripted(hang, good), models, limit=0.05)
    assert [len(update(guarded, number).tracks) for number in range(3)] == [0, 0, 0]
    free.set()
    assert guarded.watch._pending is not None
    guarded.watch._pending.result(10.0)
    guarded.watch.limit = 10.0
    assert update(guarded, 3).tracks[0].stamp == 3 * PERIOD, "the late answer to frame 0 is dropped"
    guarded.close()
    assert [fault.kind for fault in guarded.watch.faults] == [FaultKind.LATE] * 3
    metrics = fault_metrics([guarded.watch])
    assert metrics["foreign.tracker.frames"].value == 4
    assert metrics["foreign.tracker.missed_frames"].value == 3
    assert metrics["foreign.tracker.missed_frames"].reason == "frames 0-2"
    assert metrics["foreign.tracker.missed_share"].value == 0.75
    assert metrics["foreign.tracker.raised"].value == 0


def test_a_stage_cannot_write_to_what_others_see(models) -> None:
    class Scribbler:
        def update(self, frame: RgbdFrame, T_map_camera, covariance, hypotheses=()):
            frame.depth[:] = 0.0
            T_map_camera[:] = 0.0
            return TrackerResult(frame.stamp, (), Status.OK)

    image, T = frame(0), T_MAP_CAMERA.copy()
    guarded = GuardedTracker(Scribbler(), models)
    guarded.update(image, T, np.eye(6))
    guarded.close()
    assert image.depth.all()
    assert np.array_equal(T, T_MAP_CAMERA)


def test_a_localizer_that_fails_stands_where_it_stood() -> None:
    class Localizer:
        fails = False

        def predict(self, odometry) -> None: ...

        def update(self, scan: LidarScan) -> Localization:
            return self.pose_at(scan.stamp)

        def pose_at(self, stamp: int) -> Localization:
            T = np.full((4, 4), np.nan) if self.fails else T_MAP_CAMERA
            return Localization(stamp, T, np.eye(6), Status.OK)

    inner = Localizer()
    guarded = GuardedLocalizer(inner, np.eye(4))
    assert guarded.pose_at(5).status is Status.OK
    inner.fails = True
    found = guarded.pose_at(7)
    guarded.close()
    assert (found.stamp, found.status) == (7, Status.FAILED)
    assert np.array_equal(found.T_map_base, T_MAP_CAMERA)
    assert [fault.kind for fault in guarded.watch.faults] == [FaultKind.INVALID]


def test_a_detector_that_fails_saw_nothing() -> None:
    class Detector:
        sigma = np.ones(9)

        def detect(self, frame: RgbdFrame, regions=()) -> DetectionResult:
            seen = Detection("relay", np.zeros((9, 2)), self.sigma, np.zeros(4), 0.5)
            return DetectionResult(frame.stamp, frame.stamp + 1, (seen,))

    inner = Detector()
    guarded = GuardedDetector(inner)
    assert len(guarded.detect(frame(0)).detections) == 1
    inner.sigma = np.full(9, np.nan)
    result = guarded.detect(frame(1))
    guarded.close()
    assert (result.detections, result.status) == ((), Status.FAILED)


# -------------------------------------------------------------------------------------------------------------- loading

BAD = {
    "nonsense": ("cannot be read; tracker is package.module:Class or exec:PROGRAM", "Tracker"),
    "no_such_module_at_all:Tracker": ("no module 'no_such_module_at_all'", ""),
    "stages:Missing": ("it has: AsksMuch, Breaks, Half, Narrow", ""),
    "stages:number": ("neither a class nor a function", ""),
    "stages:Half": ("has no method 'update', which a Tracker needs", ""),
    "stages:Narrow": ("method 'update(self, frame)' does not take what a Tracker is given", ""),
    "broken:Tracker": ("the module raised ZeroDivisionError", ""),
    "exec:": ("names no program", ""),
    "exec:./no_such_program": ("no program './no_such_program'", ""),
    "exec:'": ("cannot be split", ""),
}


@pytest.fixture
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    body = "def update(self, frame, T_map_camera, covariance, hypotheses=()): ..."
    (tmp_path / "stages.py").write_text(
        "class Half:\n    def detect(self, frame, regions): ...\n"
        "class Narrow:\n    def update(self, frame): ...\n"
        f"class AsksMuch:\n    def __init__(self, models, gpu): ...\n    {body}\n"
        f"class Breaks:\n    def __init__(self): raise OSError('no weights')\n    {body}\n"
        "number = 3\n"
    )
    (tmp_path / "broken.py").write_text("1 / 0\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    for name in ("stages", "broken", "my_tracker"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("given", BAD)
def test_what_cannot_be_loaded_is_said(given: str, modules: Path) -> None:
    with pytest.raises(StageError) as error:
        check_stage("tracker", given)
    assert BAD[given][0] in str(error.value)
    assert given in str(error.value)


def test_what_cannot_be_built_is_said(modules: Path, context: StageContext) -> None:
    with pytest.raises(StageError, match="asks for 'gpu'; there are: models, static_map, robot, T_map_base"):
        build_stage("tracker", "stages:AsksMuch", context)
    with pytest.raises(StageError, match="OSError: no weights"):
        build_stage("tracker", "stages:Breaks", context)
    with pytest.raises(StageError, match="only a tracker can be a program"):
        check_stage("localizer", "exec:true")
    with pytest.raises(InvalidValueError, match="stage_limit"):
        GuardedDetector(object(), limit=0.0)  # type: ignore[arg-type]


# ----------------------------------------------------------------------------------------------------- documented ways


def follow(built: object, models: dict[str, ObjectModel]) -> list[TrackerResult]:
    """Three frames with one detection, given with the second one."""
    guarded = GuardedTracker(built, models, limit=60.0)  # type: ignore[arg-type]
    covariance = np.eye(6) * 1e-6
    hypotheses = [(), (HYPOTHESIS,), ()]
    results = [guarded.update(frame(n), T_MAP_CAMERA, covariance, h) for n, h in enumerate(hypotheses)]
    guarded.close()
    assert guarded.watch.faults == []
    return results


def test_the_tracker_of_the_documentation_runs(modules: Path, context: StageContext, models) -> None:
    code = re.search(r"```python\n(.*?)```", (DOCS / "bring_your_own.md").read_text(), re.DOTALL)
    assert code is not None
    assert len(code[1].splitlines()) <= 35
    (modules / "my_tracker.py").write_text(code[1])
    check_stage("tracker", "my_tracker:LatestDetection")
    results = follow(build_stage("tracker", "my_tracker:LatestDetection", context), models)
    assert [len(result.tracks) for result in results] == [0, 1, 1]
    assert np.allclose(results[2].tracks[0].T_camera_object, T_CAMERA_OBJECT)
    assert np.allclose(results[2].tracks[0].T_map_object, T_MAP_CAMERA @ T_CAMERA_OBJECT)


def test_the_program_of_the_documentation_runs(context: StageContext, models) -> None:
    program = DOCS / "examples" / "line_tracker.py"
    results = follow(build_stage("tracker", f"exec:{sys.executable} {program}", context), models)
    assert [len(result.tracks) for result in results] == [0, 1, 1]
    assert np.allclose(results[2].tracks[0].T_camera_object, T_CAMERA_OBJECT, atol=1e-9)


def test_the_templates_can_be_put_into_a_stack(context: StageContext, models, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(DOCS / "examples")
    tracker = build_stage("tracker", "latest_detection:LatestDetection", context)
    (track,) = follow(tracker, models)[2].tracks
    T_below = track.T_map_object.copy()
    T_below[2, 3] -= 0.2
    below = replace(track, id=2, T_map_object=T_below)
    graph = GuardedSceneGraph(build_stage("scene graph", "boxes_above:BoxesAbove", context))  # type: ignore[arg-type]
    assert graph.update(0, (track, below)) == {Relation("relay-1", "above", "relay-2")}
    localizer = GuardedLocalizer(cast(Localizer, build_stage("localizer", "odometry_only:OdometryOnly", context)), None)
    localizer.predict(Odometry(PERIOD, T_MAP_CAMERA, 0.0, 0.0))
    assert np.allclose(localizer.pose_at(PERIOD).T_map_base, T_MAP_CAMERA)
    assert not graph.watch.faults and not localizer.watch.faults
    graph.close()
    localizer.close()


NO_RELATIONS: dict[str, object] = {
    "none": None, "list": ["on"], "names": {"on"}, "unknown": {Relation("a", "beneath", "b")},
    "number": {Relation("a", "on", 3)},  # type: ignore[arg-type]
}  # fmt: skip


@pytest.mark.parametrize("name", NO_RELATIONS)
def test_relations_that_are_none_are_a_missed_frame(name: str) -> None:
    answer = NO_RELATIONS[name]

    class Builder:
        def update(self, stamp: int, tracks: object) -> object:
            return answer

    graph = GuardedSceneGraph(Builder())  # type: ignore[arg-type]
    assert graph.update(0, ()) == frozenset()
    assert [fault.kind for fault in graph.watch.faults] == [FaultKind.INVALID]
    graph.close()


PROGRAM = """
import json, sys
for line in sys.stdin:
    message = json.loads(line)
    if message["type"] == "models":
        print('{"type": "ready"}', flush=True)
        continue
    stamp = message["stamp"]
    if stamp == PERIOD:
        sys.exit(7)
    if stamp == 2 * PERIOD:
        print("hello", flush=True)
        continue
    if stamp == 3 * PERIOD:
        print(json.dumps({"stamp": stamp, "tracks": [{"id": 1, "class": "relay"}]}), flush=True)
        continue
    pose = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 1, 0, 0, 0, 1]
    if stamp == 4 * PERIOD:
        print(json.dumps({"stamp": 3 * PERIOD, "tracks": []}))
    track = {"id": 1, "class": "relay", "T_camera_object": pose, "status": "occluded"}
    print(json.dumps({"stamp": stamp, "tracks": [track]}), flush=True)
"""


def test_a_program_that_ends_or_babbles_misses_frames(tmp_path: Path, context: StageContext, models) -> None:
    (tmp_path / "program.py").write_text(PROGRAM.replace("PERIOD", str(PERIOD)))
    built = build_stage("tracker", f"exec:{sys.executable} {tmp_path / 'program.py'}", context)
    guarded = GuardedTracker(built, models, limit=60.0)  # type: ignore[arg-type]
    results = [update(guarded, number) for number in range(5)]
    guarded.close()
    assert [len(result.tracks) for result in results] == [1, 0, 0, 0, 1]
    assert [f.kind for f in guarded.watch.faults] == [FaultKind.RAISED, FaultKind.INVALID, FaultKind.INVALID]
    for fault, message in zip(guarded.watch.faults, ("exit code 7", "not JSON", "no 'T_camera_object'"), strict=True):
        assert message in fault.message
    write_faults(tmp_path / "faults.csv", guarded.watch.faults)
    assert len((tmp_path / "faults.csv").read_text().splitlines()) == 4


def test_a_program_is_ready_before_the_run(tmp_path: Path, context: StageContext, models) -> None:
    with pytest.raises(StageError, match="is not ready: the program has ended with exit code 3"):
        build_stage("tracker", f"exec:{sys.executable} -c 'raise SystemExit(3)'", context)
    sleeps = ProcessTracker([sys.executable, "-c", "import time; time.sleep(600)"], models)
    with pytest.raises(TimeoutError, match=r"within 0\.2 s"):
        sleeps.start(limit=0.2)
    sleeps.close()


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"T_camera_object": [1.0] * 12}, "T_camera_object is not 16 finite numbers"),
        ({"score": "high"}, "score is no number: 'high'"),
        ({"status": "great"}, "status is 'great'; allowed: "),
    ],
)
def test_answers_that_cannot_be_used_name_the_field(entry: dict, message: str, models, tmp_path: Path) -> None:
    track = {"id": 1, "class": "relay", "T_camera_object": np.eye(4).ravel().tolist()} | entry
    answers = '{"type": "ready"}', json.dumps({"stamp": 0, "tracks": [track]})
    (tmp_path / "program.py").write_text("".join(f"input()\nprint({answer!r})\n" for answer in answers) + "input()")
    guarded = GuardedTracker(ProcessTracker([sys.executable, "-u", str(tmp_path / "program.py")], models), models)
    update(guarded, 0)
    guarded.close()
    assert [fault.kind for fault in guarded.watch.faults] == [FaultKind.INVALID], guarded.watch.faults
    assert message in guarded.watch.faults[0].message


def test_a_program_that_hangs_is_ended(tmp_path: Path, models) -> None:
    code = 'import time; print(\'{"type": "ready"}\', flush=True); time.sleep(600)'
    built = ProcessTracker([sys.executable, "-c", code], models)
    guarded = GuardedTracker(built, models, limit=1.0)
    assert update(guarded, 0).status is Status.FAILED
    process = built._process
    assert process is not None
    guarded.close()
    assert process.poll() is not None
    assert guarded.watch.faults[0].kind is FaultKind.LATE


def test_spans_of_frames_are_short() -> None:
    assert spans([3]) == "3"
    assert spans([0, 1, 2, 7, 9, 10]) == "0-2, 7, 9-10"
    assert spans(range(0, 60, 2)).endswith("and 18 more spans")
