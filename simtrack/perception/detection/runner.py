"""Runs a detector beside the pipeline: its latency in simulated time, its failures as statuses."""

import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field

from simtrack.contracts import (
    NANOSECONDS,
    CameraIntrinsics,
    DetectionResult,
    Detector,
    Float32,
    PoseHypothesis,
    RegionOfInterest,
    RgbdFrame,
    Status,
)
from simtrack.errors import InvalidValueError
from simtrack.objects import ObjectModel
from simtrack.perception.beside import worker
from simtrack.perception.detection.pnp import PnpConfig, solve_pose
from simtrack.perception.detection.pose_search import PoseSearch, PoseSearchConfig
from simtrack.perception.tracking.correspondences import usable_depth


@dataclass(frozen=True, slots=True)
class RunnerConfig:
    """Settings of `DetectorRunner`."""

    patience: float = 3.0
    """An answer that is later than this, in seconds of the frames' time, is not waited for."""
    timeout: float = 30.0
    """A call that has not returned after this, in seconds of the wall clock, is given up: the detector hangs."""
    pnp: PnpConfig = field(default_factory=PnpConfig)
    search: PoseSearchConfig = field(default_factory=PoseSearchConfig)

    def __post_init__(self) -> None:
        if self.patience <= 0.0 or self.timeout <= 0.0:
            raise InvalidValueError("RunnerConfig.patience, timeout", (self.patience, self.timeout), "> 0 s")


CLOCK = 1000
"""Nanoseconds by which frames may be early: their stamps are rounded."""


class DetectorRunner:
    """Hands one image at a time to a detector and gives out its answers when they are due.

    A detector that raises, hangs or answers nonsense costs its answer and nothing else.
    """

    def __init__(
        self,
        detector: Detector,
        models: Mapping[str, ObjectModel],
        config: RunnerConfig | None = None,
        threads: bool = True,
    ) -> None:
        """Without `threads` the caller's does all work, and nothing protects it from a detector that hangs."""
        self.config = config or RunnerConfig()
        self._threads = threads
        self._detector, self._models = detector, dict(models)
        self._free_at: int | None = None
        self._waiting: list[tuple[DetectionResult, Future[list[PoseHypothesis]]]] = []
        self._solver: Executor | None = None
        self._search = PoseSearch(models, self.config.search)
        self._hanging: threading.Thread | None = None
        self.status = Status.OK

    def due(self, stamp: int) -> bool:
        """Whether the detector would take an image with this stamp."""
        return self._free_at is None or stamp + CLOCK >= self._free_at

    def submit(self, frame: RgbdFrame, regions: Sequence[RegionOfInterest] = ()) -> DetectionResult | None:
        """Start on an image; returns the answer that will be due later (for recordings), None if there is none."""
        latest = frame.stamp + int(self.config.patience * NANOSECONDS)
        result = self._call(frame, regions)
        self._free_at = latest
        if result is None or result.status in (Status.FAILED, Status.NO_DATA):
            self.status, self._free_at = Status.FAILED, frame.stamp + NANOSECONDS // 4
            return None
        if result.available > latest:
            self.status = Status.DEGRADED
            return None
        next_image = result.available if result.next_image is None else result.next_image
        self.status, self._free_at = result.status, max(next_image, frame.stamp + CLOCK + 1)
        if self._solver is None:
            self._solver = worker("poses", threads=self._threads)
        # Until the answer is due there is time to look for the poses.
        depth = usable_depth(frame.depth)
        self._waiting.append((result, self._solver.submit(self._hypotheses, result, depth, frame.intrinsics)))
        return result

    def collect(self, now: int) -> list[PoseHypothesis]:
        """Pose hypotheses of all answers that are due at `now`, nanoseconds."""
        due = [w for w in self._waiting if w[0].available <= now + CLOCK]
        self._waiting = [w for w in self._waiting if w[0].available > now + CLOCK]
        return [hypothesis for _, hypotheses in due for hypothesis in hypotheses.result()]

    def close(self) -> None:
        """End the thread that solves for poses; answers that are not collected yet are lost."""
        self._waiting.clear()
        if self._solver is not None:
            self._solver.shutdown()
            self._solver = None
        self._search.close()

    def _hypotheses(
        self, result: DetectionResult, depth: Float32, intrinsics: CameraIntrinsics
    ) -> list[PoseHypothesis]:
        hypotheses: list[PoseHypothesis] = []
        for detection in result.detections:
            model = self._models.get(detection.class_name)
            if model is not None and detection.keypoints.shape == (9, 2):
                solved = solve_pose(detection, model, intrinsics, result.stamp, self.config.pnp)
                found = self._search.search(detection, depth, intrinsics, result.stamp, solved)
                hypotheses += solved if found is None else found
        return hypotheses

    def _call(self, frame: RgbdFrame, regions: Sequence[RegionOfInterest]) -> DetectionResult | None:
        if self._hanging is not None and self._hanging.is_alive():
            return None
        answer: list[DetectionResult] = []

        def work() -> None:
            try:
                answer.append(self._detector.detect(frame, regions))
            except Exception:  # whatever a foreign detector raises is its failure, not the pipeline's
                answer.clear()

        if self._threads:
            self._hanging = threading.Thread(target=work, name="simtrack-detector", daemon=True)
            self._hanging.start()
            self._hanging.join(self.config.timeout)
        else:
            work()
        good = answer and isinstance(answer[0], DetectionResult) and answer[0].stamp == frame.stamp
        return answer[0] if good else None
