import threading
from dataclasses import dataclass, field

import numpy as np

from simtrack.contracts import NANOSECONDS, CameraIntrinsics, Detection, DetectionResult, RgbdFrame, Status
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.objects import load_object
from simtrack.perception.detection.pnp import project_points
from simtrack.perception.detection.runner import DetectorRunner, RunnerConfig

K = CameraIntrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)
MODELS = {"relay": load_object("relay")}
T = transform(exp_so3(np.array([2.0, 0.3, -0.4])), (0.1, 0.0, 1.2))


def _frame(stamp: int) -> RgbdFrame:
    return RgbdFrame(stamp, np.zeros((48, 64), np.float32), None, K, np.eye(4))


@dataclass
class Scripted:
    latency: float = 0.1
    rate: float | None = None
    classes: tuple[str, ...] = ("relay",)
    error: Exception | None = None
    hang: threading.Event | None = None
    asked: list[int] = field(default_factory=list)

    def detect(self, frame: RgbdFrame, regions: object = ()) -> DetectionResult:
        self.asked.append(frame.stamp)
        if self.error is not None:
            raise self.error
        if self.hang is not None:
            self.hang.wait(30.0)
        pixels = project_points(T, MODELS["relay"].keypoints, K)
        found = tuple(Detection(c, pixels, np.ones(9), np.zeros(4), 0.9) for c in self.classes)
        next_image = None if self.rate is None else frame.stamp + int(NANOSECONDS / self.rate)
        return DetectionResult(frame.stamp, frame.stamp + int(self.latency * NANOSECONDS), found, next_image=next_image)


def test_answers_come_when_they_are_due_and_one_image_is_worked_on_at_a_time() -> None:
    runner = DetectorRunner(Scripted(), MODELS)
    assert runner.due(0)
    assert runner.submit(_frame(0)) is not None
    assert not runner.due(NANOSECONDS // 20)
    assert runner.collect(NANOSECONDS // 20) == []
    hypotheses = runner.collect(NANOSECONDS // 10)
    assert {h.stamp for h in hypotheses} == {0}
    assert runner.due(NANOSECONDS // 10)
    assert runner.collect(NANOSECONDS) == []


def test_a_detector_may_take_images_at_a_rate_of_its_own() -> None:
    """Whether it works at several images at once or rests in between; stamps of frames are whole nanoseconds."""
    stamps = [k * (NANOSECONDS // 30) for k in range(31)]
    for latency, rate, images, waits in ((0.1, 5.0, 6, 3), (0.2, 10.0, 11, 6), (0.2, None, 6, 6)):
        runner = DetectorRunner(detector := Scripted(latency, rate), MODELS)
        answers: list[tuple[int, int]] = []
        for k, stamp in enumerate(stamps):
            answers += [(round(h.stamp / stamps[1]), k) for h in runner.collect(stamp)[:1]]
            if runner.due(stamp):
                runner.submit(_frame(stamp))
        assert len(detector.asked) == images
        assert {answered - asked for asked, answered in answers} == {waits}
        runner.close()


def test_a_detector_that_raises_costs_only_its_answer() -> None:
    runner = DetectorRunner(Scripted(error=RuntimeError("out of memory")), MODELS)
    assert runner.submit(_frame(0)) is None
    assert runner.status is Status.FAILED
    assert not runner.due(1)
    assert runner.due(NANOSECONDS)


def test_a_detector_that_hangs_is_given_up() -> None:
    release = threading.Event()
    detector = Scripted(hang=release)
    runner = DetectorRunner(detector, MODELS, RunnerConfig(timeout=0.05))
    assert runner.submit(_frame(0)) is None
    assert runner.status is Status.FAILED
    assert runner.submit(_frame(NANOSECONDS)) is None  # it is still busy: not asked again
    assert detector.asked == [0]
    release.set()


def test_an_answer_that_never_comes_in_time_is_not_waited_for() -> None:
    runner = DetectorRunner(Scripted(latency=1e6), MODELS)
    assert runner.submit(_frame(0)) is None
    assert runner.status is Status.DEGRADED
    assert runner.due(4 * NANOSECONDS)
    assert runner.collect(1 << 62) == []


def test_unknown_classes_are_left_out() -> None:
    runner = DetectorRunner(Scripted(classes=("teapot", "relay")), MODELS)
    runner.submit(_frame(0))
    assert {h.class_name for h in runner.collect(NANOSECONDS)} == {"relay"}
