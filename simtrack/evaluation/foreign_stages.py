"""Stages of other people's in a run: built, watched, and their missed frames written down."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from simtrack.contracts import Detector, Localizer, SceneGraphBuilder, Tracker
from simtrack.evaluation.metrics import Metric, Metrics, ratio
from simtrack.evaluation.run_config import ORACLE, RunConfig
from simtrack.perception.foreign import (
    FaultKind,
    GuardedDetector,
    GuardedLocalizer,
    GuardedSceneGraph,
    GuardedTracker,
    StageContext,
    StageFault,
    Watch,
    build_stage,
)

FAULTS = ("stage", "frame", "stamp_ns", "kind", "message")
"""Columns of ``faults.csv``."""
SPANS = 12
"""How many spans of frames a metric's remark lists."""


@dataclass(frozen=True, slots=True)
class ForeignStages:
    """The stages of a run that are not simtrack's; None where simtrack's own stand."""

    tracker: GuardedTracker | None = None
    localizer: GuardedLocalizer | None = None
    detector: GuardedDetector | None = None
    scene_graph: GuardedSceneGraph | None = None

    @property
    def watches(self) -> list[Watch]:
        """Of all that there are."""
        parts = (self.tracker, self.localizer, self.detector, self.scene_graph)
        return [part.watch for part in parts if part is not None]


@contextmanager
def foreign_stages(config: RunConfig, context: StageContext) -> Iterator[ForeignStages]:
    """Build what a configuration names; closed at the end.

    Raises:
        StageError: one of them cannot be built.
    """
    limit = config.stage_limit
    with ExitStack() as exits:
        tracker = localizer = detector = scene_graph = None
        if config.tracker is not None:
            built = cast(Tracker, build_stage("tracker", config.tracker, context))
            tracker = GuardedTracker(built, context.models, limit)
            exits.callback(tracker.close)
        if config.localizer not in (None, ORACLE):
            built = cast(Localizer, build_stage("localizer", config.localizer, context))
            localizer = GuardedLocalizer(built, context.T_map_base, limit)
            exits.callback(localizer.close)
        if "detector" in config.foreign:
            named = config.foreign["detector"]
            detector = GuardedDetector(cast(Detector, build_stage("detector", named, context)), limit)
            exits.callback(detector.close)
        if config.scene_graph is not None:
            built = cast(SceneGraphBuilder, build_stage("scene graph", config.scene_graph, context))
            scene_graph = GuardedSceneGraph(built, limit)
            exits.callback(scene_graph.close)
        yield ForeignStages(tracker, localizer, detector, scene_graph)


def fault_metrics(watches: Sequence[Watch]) -> Metrics:
    """``foreign.<stage>.*``: frames handed over and missed, by kind of fault; remarks say which frames they were."""
    metrics: Metrics = {}
    for watch in watches:
        name, faults = f"foreign.{watch.stage.replace(' ', '_')}", list(watch.faults)
        missed = sorted({fault.frame for fault in faults})
        metrics[f"{name}.frames"] = Metric(watch.frames, "1")
        metrics[f"{name}.missed_frames"] = Metric(len(missed), "1", f"frames {spans(missed)}" if missed else "")
        metrics[f"{name}.missed_share"] = ratio(len(missed), watch.frames, "no frame was handed to it")
        for kind in FaultKind:
            of_kind = [fault for fault in faults if fault.kind is kind]
            remark = f"frames {spans(sorted({f.frame for f in of_kind}))}; {of_kind[0].message}" if of_kind else ""
            metrics[f"{name}.{kind}"] = Metric(len(of_kind), "1", remark)
    return metrics


def spans(frames: Sequence[int]) -> str:
    """Ascending numbers as ``3, 5-9``; long lists end with how many more there are."""
    found: list[list[int]] = []
    for frame in frames:
        if found and frame == found[-1][1] + 1:
            found[-1][1] = frame
        else:
            found.append([frame, frame])
    texts = [str(first) if first == last else f"{first}-{last}" for first, last in found]
    more = f" and {len(texts) - SPANS} more spans" if len(texts) > SPANS else ""
    return ", ".join(texts[:SPANS]) + more


def write_faults(path: Path, faults: Sequence[StageFault]) -> None:
    """Write ``faults.csv``: a line a fault, in the order of stages and frames."""
    import csv

    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(FAULTS)
        writer.writerows((f.stage, f.frame, f.stamp, f.kind.value, f.message) for f in faults)
