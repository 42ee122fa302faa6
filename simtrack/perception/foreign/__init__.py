"""Stages of other people's in the stack: found by name or started as programs, watched, and never trusted."""

from simtrack.perception.foreign.answers import track_at
from simtrack.perception.foreign.guards import GuardedDetector, GuardedLocalizer, GuardedSceneGraph, GuardedTracker
from simtrack.perception.foreign.loading import StageContext, build_stage, check_stage
from simtrack.perception.foreign.process_tracker import ProcessTracker
from simtrack.perception.foreign.watch import FaultKind, StageFault, Watch

__all__ = [
    "FaultKind",
    "GuardedDetector",
    "GuardedLocalizer",
    "GuardedSceneGraph",
    "GuardedTracker",
    "ProcessTracker",
    "StageContext",
    "StageFault",
    "Watch",
    "build_stage",
    "check_stage",
    "track_at",
]
