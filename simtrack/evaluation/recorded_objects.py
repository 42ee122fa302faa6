"""Objects that a recording annotates: the depth image beside their models, and the tracker beside the annotation."""

from collections.abc import Mapping, Sequence

import numpy as np

from simtrack.contracts import Float64, PoseHypothesis, RgbdFrame, Track
from simtrack.evaluation.metrics import Metrics, quantile, ratio
from simtrack.evaluation.pose_errors import rotation_error, translation_error
from simtrack.evaluation.residuals import Residuals
from simtrack.geometry.transforms import perturb
from simtrack.objects import ObjectModel
from simtrack.perception.tracking.tracker import ObjectTracker
from simtrack.raycast import RayBundle, RayScene, TriangleMesh
from simtrack.recordings import LabelledObject

VISIBLE = 0.3
"""Least visible fraction of an object that the tracker is told of, and judged by."""
HYPOTHESIS = (0.01, float(np.deg2rad(3.0)))
"""Metres and radians, standard deviations by which the poses that the tracker gets differ from the annotated ones."""
MATCH = 0.05
"""Metres between a track and an annotated object beyond which they are not the same."""
STRIDE = 2
"""Pixel grid on which models are compared with the depth image."""


class ObjectStage:
    """Casts the models at their annotated poses, and feeds the tracker with what a detector might have said.

    The recording has no detector: hypotheses are the annotated poses of what is visible, each off by a random error
    (`HYPOTHESIS`). What the tracker makes of them with the depth images is compared with the annotation.
    """

    def __init__(self, models: Mapping[str, ObjectModel], seed: int = 0) -> None:
        self._models = models
        self._meshes = {name: TriangleMesh(m.mesh.vertices, m.mesh.faces) for name, m in models.items()}
        self._tracker = ObjectTracker(models)
        self._rng = np.random.default_rng(seed)
        self._differences = Residuals()
        self._errors: list[tuple[float, float]] = []
        self._labelled = self._tracked = 0

    def close(self) -> None:
        """Release memory outside of Python."""
        self._tracker.close()

    def take(self, frame: RgbdFrame, T_map_camera: Float64, labels: Sequence[LabelledObject]) -> tuple[Track, ...]:
        """Take one frame; returns what the tracker believes after it."""
        self._compare(frame, labels)
        seen = [label for label in labels if label.visible_fraction >= VISIBLE]
        covariance = np.diag(np.square([0.001] * 3 + [0.001] * 3))
        hypotheses = [self._hypothesis(frame.stamp, label) for label in seen]
        result = self._tracker.update(frame, T_map_camera, covariance, hypotheses)
        believed = [track for track in result.tracks if track.believed]
        for label in seen:
            T = T_map_camera @ label.T_camera_object
            same = [track for track in believed if track.class_name == label.class_name]
            nearest = min(same, key=lambda track: translation_error(track.T_map_object, T), default=None)
            self._labelled += 1
            if nearest is None or (off := translation_error(nearest.T_map_object, T)) > MATCH:
                continue
            self._tracked += 1
            turned = rotation_error(nearest.T_map_object, T, self._models[label.class_name].symmetries)
            self._errors.append((off, turned))
        return result.tracks

    def _hypothesis(self, stamp: int, label: LabelledObject) -> PoseHypothesis:
        sigmas = np.repeat(HYPOTHESIS, 3)
        T = perturb(label.T_camera_object, self._rng.normal(0.0, sigmas))
        return PoseHypothesis(label.class_name, stamp, T, np.diag(np.square(sigmas)), 1.0, 1.0)

    def _compare(self, frame: RgbdFrame, labels: Sequence[LabelledObject]) -> None:
        """Depth readings less the models' depth, where a model is the nearest thing that is annotated."""
        if not labels:
            return
        bundle = RayBundle.from_camera(frame.intrinsics, stride=STRIDE)
        with RayScene() as scene:
            for label in labels:
                scene.add(self._meshes[label.class_name], label.T_camera_object)
            modelled = scene.cast(bundle, np.eye(4)).distances
        measured = frame.depth.ravel()[np.asarray(bundle.pixels)]
        differences = np.where((measured > 0.0) & np.isfinite(modelled), measured - modelled, np.nan)
        # What lies in front of a model is something else, and hides it.
        self._differences.add(np.where(differences > -MATCH, differences, np.nan))

    def metrics(self) -> Metrics:
        """What was measured so far."""
        translation, rotation = np.array(self._errors, dtype=float).reshape(-1, 2).T
        missing = "no annotated object was tracked"
        return {
            "objects.depth_difference.median": self._differences.quantile(0.5),
            "objects.depth_difference.p95": self._differences.quantile(0.95),
            "tracking.recall": ratio(self._tracked, self._labelled, "no annotated object was visible enough"),
            "tracking.translation_error.median": quantile(translation, 0.5, "m", missing),
            "tracking.translation_error.p95": quantile(translation, 0.95, "m", missing),
            "tracking.rotation_error.median": quantile(rotation, 0.5, "rad", missing),
        }
