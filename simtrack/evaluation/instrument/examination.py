"""One frame of a run done again: the tracker's registration, its correspondences, and how far it is from the truth."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Bool, Float32, Float64, Int32
from simtrack.errors import InvalidValueError
from simtrack.evaluation.instrument.moments import StoredMoment, TrueObject
from simtrack.evaluation.pose_errors import PoseScorer
from simtrack.objects import ObjectModel
from simtrack.perception.tracking.registration import Registration, RegistrationResult
from simtrack.perception.tracking.registration_config import RegistrationConfig
from simtrack.perception.tracking.target import tracked_model
from simtrack.raycast import RayBundle, RayScene, TriangleMesh


@dataclass(frozen=True, slots=True, eq=False)
class ObjectExamination:
    """What became of one object."""

    true: TrueObject
    predicted: tuple[float, float] | None
    """Translation error, metres, and rotation error, radians, of the filter's prediction; None if it had no track."""
    registered: tuple[float, float] | None
    """Of the registration, done again; None if it has no result."""
    result: RegistrationResult | None


@dataclass(frozen=True, slots=True, eq=False)
class Examination:
    """One frame done again."""

    moment: StoredMoment
    objects: tuple[ObjectExamination, ...]
    """The worst first."""
    largest_change: float
    """Metres or radians between a registered pose of the run and the same one done again: 0 where code is the same."""
    instances: Int32
    """(H, W) track id whose registered model a pixel's ray meets, -1 for none."""
    residuals: Float32
    """(H, W) measured minus model depth at the registered poses, metres, NaN where either is missing."""
    outlines: Mapping[str, Bool]
    """``true``, ``predicted``, ``registered`` -> (H, W) edges of the models at those poses."""


def examine(moment: StoredMoment, models: Mapping[str, ObjectModel], config: RegistrationConfig) -> Examination:
    """Do one frame's registration again.

    Args:
        moment: of the run.
        models: class name -> the tracker's model, as in the run.
        config: of the registration, as in the run.

    Raises:
        InvalidValueError: the moment has objects of classes without a model.
    """
    missing = sorted({*moment.classes.values()} - set(models))
    if missing:
        raise InvalidValueError("classes", missing, f"some of {', '.join(sorted(models))}")
    registration = Registration(config)
    try:
        for track, name in moment.classes.items():
            registration.add(track, tracked_model(models[name]))
        results = registration.track(moment.depth, moment.intrinsics, dict(moment.predicted))
    finally:
        registration.close()
    changes = [
        float(np.abs(result.T_camera_object - moment.results[track].T_camera_object).max())
        for track, result in results.items()
        if track in moment.results
    ]
    if results.keys() != moment.results.keys():
        changes.append(np.inf)
    registered = {track: result.T_camera_object for track, result in results.items()}
    true = {k: (o.class_name, o.T_camera_object) for k, o in enumerate(moment.objects)}
    drawn = {
        "true": _drawn(moment, models, true),
        "predicted": _drawn(moment, models, {k: (moment.classes[k], T) for k, T in moment.predicted.items()}),
        "registered": _drawn(moment, models, {k: (moment.classes[k], T) for k, T in registered.items()}),
    }
    instances, depth = drawn["registered"]
    seen = (instances >= 0) & (moment.depth > 0.0)
    residuals = np.where(seen, moment.depth - depth, np.nan).astype(np.float32)
    return Examination(
        moment, _judged(moment, models, results), max(changes, default=0.0), instances, residuals,
        {name: _edges(ids) for name, (ids, _) in drawn.items()},
    )  # fmt: skip


def _judged(
    moment: StoredMoment, models: Mapping[str, ObjectModel], results: Mapping[int, RegistrationResult]
) -> tuple[ObjectExamination, ...]:
    found = []
    for thing in moment.objects:
        model = models.get(thing.class_name)
        predicted = registered = None
        result = results.get(thing.track) if thing.track is not None else None
        if model is not None and thing.track is not None and thing.track in moment.predicted:
            scorer = PoseScorer(model.mesh.vertices, model.symmetries, model.diameter)
            predicted = scorer.errors(moment.predicted[thing.track], thing.T_camera_object)
            if result is not None:
                registered = scorer.errors(result.T_camera_object, thing.T_camera_object)
        found.append(ObjectExamination(thing, predicted, registered, result))
    return tuple(sorted(found, key=lambda o: (o.true.name != moment.worst, o.true.name)))


def _drawn(
    moment: StoredMoment, models: Mapping[str, ObjectModel], poses: Mapping[int, tuple[str, Float64]]
) -> tuple[Int32, Float32]:
    """(H, W) key and depth of the models at poses, -1 and infinity where there is none."""
    bundle = RayBundle.from_camera(moment.intrinsics)
    with RayScene() as scene:
        keys = {}
        for key, (name, T) in poses.items():
            if name in models:
                mesh = models[name].mesh
                keys[scene.add(TriangleMesh(mesh.vertices, mesh.faces), T)] = key
        hits = scene.cast(bundle, np.eye(4))
    named = np.full(max(keys, default=0) + 2, -1, np.int32)
    for instance, key in keys.items():
        named[instance] = key
    ids = np.where(hits.instances >= 0, named[hits.instances], -1).astype(np.int32)
    return ids.reshape(bundle.shape), hits.distances.reshape(bundle.shape)


def _edges(ids: Int32) -> Bool:
    """Pixels whose right or lower neighbour shows something else."""
    out = np.zeros(ids.shape, np.bool_)
    out[:, :-1] |= ids[:, :-1] != ids[:, 1:]
    out[:-1] |= ids[:-1] != ids[1:]
    return out
