"""Scores a running closed loop against the simulation's ground truth, stage by stage.

The cheap figures (poses of robot and objects) are taken at every camera stamp, the dear ones (ids of every pixel,
distances from surfaces, relations, the noise floor) every half second, BOP's recall every second. None of it is fed
back to the stack.
"""

from collections import deque
from collections.abc import Mapping
from types import TracebackType

import numpy as np

from simtrack.contracts import NANOSECONDS, Belief, LidarScan, RgbdFrame, SensorFrame
from simtrack.evaluation.bop_recall import BopRecall
from simtrack.evaluation.bounds import BoundEvaluator
from simtrack.evaluation.changes import ChangeEvaluator
from simtrack.evaluation.consistency import ConsistencyEvaluator
from simtrack.evaluation.floor import FloorEvaluator, RegistrationFromTruth
from simtrack.evaluation.identity import IdentityEvaluator
from simtrack.evaluation.metrics import Metrics
from simtrack.evaluation.pose_errors import PoseScorer
from simtrack.evaluation.presegmentation import (
    Measurements,
    ModelledSurfaces,
    ObjectsFoundEvaluator,
    PresegmentationEvaluator,
    camera_measurements,
    lidar_measurements,
)
from simtrack.evaluation.record import Album
from simtrack.evaluation.relations import RelationEvaluator
from simtrack.evaluation.tracking import ObjectFrame, TrackingEvaluator
from simtrack.evaluation.trajectory import SETTLED, TrajectoryEvaluator
from simtrack.geometry.transforms import angle_between
from simtrack.objects import ObjectModel
from simtrack.perception.stack_config import StackConfig
from simtrack.simulation.simulation import Simulation

PERIOD = NANOSECONDS // 2
"""Nanoseconds between dear evaluations."""
STOOD_ELSEWHERE = 0.05
"""Metres or radians from which surveyed furniture counts as moved since."""


def true_models(simulation: Simulation) -> dict[str, ObjectModel]:
    """Class name -> the simulated body's model, of the scene's catalogue objects."""
    world = simulation.world
    return {model.name: model for name, model in world.objects.items() if world.is_catalogue(name)}


def pose_scorers(models: Mapping[str, ObjectModel]) -> dict[str, PoseScorer]:
    """Class name -> scorer with the vertices, symmetries and diameter of the true model."""
    return {name: PoseScorer(m.mesh.vertices, m.symmetries, m.diameter) for name, m in models.items()}


def modelled_things(simulation: Simulation) -> list[bool]:
    """For each name of the ground truth, whether the stack was given a model of the thing, where it stands."""
    surveyed = {entity.name: entity for entity in simulation.static_map.entities}
    parts = {part.name: part for part in simulation.world.static.parts}

    def modelled(name: str) -> bool:
        if name == "robot" or (name in simulation.world.objects and simulation.world.is_catalogue(name)):
            return True
        if name not in surveyed or name not in parts:
            return False
        # The survey misses undersides, so that heights and sizes of boxes differ where nothing was moved.
        T_then, T_now = surveyed[name].T_map_entity, parts[name].T_map_part
        shift = float(np.linalg.norm(T_then[:2, 3] - T_now[:2, 3]))
        return max(shift, angle_between(T_then[:3, :3], T_now[:3, :3])) < STOOD_ELSEWHERE

    return [modelled(name) for name in simulation.truth.names]


class Evaluator:
    """All evaluators of a run; a context manager."""

    def __init__(self, simulation: Simulation, config: StackConfig, duration: float) -> None:
        """`config` of the stack, whose registration and relations are compared with; `duration` in seconds."""
        truth, models = simulation.truth, true_models(simulation)
        self._simulation, self._truth = simulation, truth
        self._scorers = pose_scorers(models)
        self.trajectory = TrajectoryEvaluator(SETTLED)
        self.tracking = TrackingEvaluator(self._scorers)
        self.identity = IdentityEvaluator()
        self.bop = BopRecall(models, self._scorers)
        self.consistency = ConsistencyEvaluator({name: model.symmetries for name, model in models.items()})
        self._register = RegistrationFromTruth(simulation.models, config.tracker.registration)
        self.floor = FloorEvaluator(self._register, self._scorers)
        self.bounds = BoundEvaluator(models, simulation.depth_noise)
        self.relations = RelationEvaluator(models, config.scene_graph.relations)
        catalogue = {
            name: (model.mesh.vertices, model.mesh.faces)
            for name, model in simulation.world.objects.items()
            if simulation.world.is_catalogue(name)
        }
        self._surfaces = ModelledSurfaces(simulation.static_map, catalogue)
        known = modelled_things(simulation)
        self.presegmentation = {
            sensor: PresegmentationEvaluator(sensor, self._surfaces, known) for sensor in ("camera", "lidar")
        }
        unknown = [name for name in truth.at(0).objects if truth.kind_of(name) != "catalogue"]
        self.found = ObjectsFoundEvaluator(truth.names, unknown)
        self.changes: ChangeEvaluator | None = None
        """Of scenes in which something happens unseen."""
        if simulation.scene.changes:
            sizes = {name: model.extents for name, model in simulation.world.objects.items() if model.name in models}
            self.changes = ChangeEvaluator(truth, simulation.camera.intrinsics, sizes)
        self.album = Album(0, duration)
        self._scans: deque[LidarScan] = deque(maxlen=8)
        self._images: deque[RgbdFrame] = deque(maxlen=8)
        self._next: dict[str, int] = {"camera": 0, "lidar": 0, "objects": 0, "bop": 0}
        self._last_scan = self._last_stamp = -1
        self.advanced = False
        """Whether the frame observed last brought a new belief."""

    def observe(self, frame: SensorFrame, belief: Belief | None) -> list[ObjectFrame]:
        """Take one frame and what the stack made of it; returns the object-frames of a camera frame."""
        if isinstance(frame, LidarScan):
            self._scans.append(frame)
        self.advanced = belief is not None and isinstance(frame, RgbdFrame) and belief.stamp > self._last_stamp
        if belief is None or not isinstance(frame, RgbdFrame) or not self.advanced:
            return []
        self._last_stamp = belief.stamp
        self._images.append(frame)
        truth, visibility = self._truth.at(belief.stamp), self._truth.visibility(belief.stamp)
        self.trajectory.observe(belief.stamp, belief.localization, truth.T_map_base)
        fractions = {name: v.fraction for name, v in visibility.items()}
        objects = self.tracking.observe(belief.tracks, truth, fractions)
        if self.changes is not None:
            self.changes.observe(belief.tracks, truth, fractions, self._simulation.changes)
        self.identity.observe(objects, belief.tracks)
        self.consistency.observe_robot(belief.localization, truth.T_map_base)
        self.consistency.observe_objects(objects, {name: o.T_map_object for name, o in truth.objects.items()})
        self.found.see(belief.stamp, {name: v.pixels for name, v in visibility.items()})
        if self._due("objects", belief.stamp):
            self.relations.observe(belief.relations, objects, truth)
            self.floor.observe(frame, objects)
            self.bounds.observe(frame, objects)
        if self._due("bop", belief.stamp):
            self.bop.observe(frame, objects)
            self._next["bop"] += PERIOD
        self._see_camera(belief)
        self._see_lidar(belief)
        self.album.see(frame, belief, objects)
        return objects

    def _due(self, what: str, stamp: int) -> bool:
        if stamp < self._next[what]:
            return False
        self._next[what] = stamp + PERIOD
        return True

    def _see_camera(self, belief: Belief) -> None:
        result = belief.camera
        frame = None if result is None else next((f for f in self._images if f.stamp == result.stamp), None)
        if result is None or frame is None:
            return
        self.presegmentation["camera"].count(result)
        self.album.see_unknown(frame, belief)
        if not self._due("camera", frame.stamp):
            return
        truth, ids = self._truth.at(frame.stamp), self._truth.ids(frame.stamp)
        measurements = camera_measurements(frame, truth.T_map_camera, ids)
        self._surfaces.place({name: thing.T_map_object for name, thing in truth.objects.items()})
        self.presegmentation["camera"].observe(result, measurements)
        self.found.observe(result, ids, measurements.valid)

    def _see_lidar(self, belief: Belief) -> None:
        result = belief.lidar
        if result is None or result.stamp == self._last_scan:
            return
        self._last_scan = result.stamp
        self.presegmentation["lidar"].count(result)
        scan = next((scan for scan in self._scans if scan.stamp == result.stamp), None)
        if scan is None or result.unknown.shape != scan.ranges.shape or not self._due("lidar", result.stamp):
            return
        measurements = self._scan_measurements(scan)
        middle = self._truth.at(scan.stamp + self._simulation.lidar.period // 2)
        self._surfaces.place({name: thing.T_map_object for name, thing in middle.objects.items()})
        self.presegmentation["lidar"].observe(result, measurements)
        valid = measurements.valid
        points = measurements.points[valid].astype(np.float32)
        self.album.see_lidar(scan.stamp, points, result.unknown[valid], belief.localization.T_map_base)

    def _scan_measurements(self, scan: LidarScan) -> Measurements:
        end = scan.stamp + round(float(scan.times.max(initial=0.0)) * NANOSECONDS)
        poses = [self._truth.at(stamp).T_map_lidar for stamp in (scan.stamp, end)]
        return lidar_measurements(scan, poses[0], poses[1], self._truth.lidar_ids(scan.stamp))

    def metrics(self) -> Metrics:
        """All that was measured so far, speed apart."""
        parts = (
            self.trajectory, self.tracking, self.identity, self.consistency, self.bop, self.floor, self.bounds,
            self.relations, self.found, *self.presegmentation.values(),
        )  # fmt: skip
        changes = {} if self.changes is None else self.changes.metrics(self._simulation.pending_changes)
        return {name: metric for part in parts for name, metric in part.metrics().items()} | changes

    def close(self) -> None:
        """Release ray scenes."""
        self._register.close()
        self._surfaces.close()
        self.bop.close()
        self.bounds.close()

    def __enter__(self) -> "Evaluator":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
