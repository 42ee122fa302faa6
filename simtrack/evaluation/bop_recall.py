"""Average recall of the BOP challenge: VSD, MSSD and MSPD over their thresholds.

Definitions and thresholds of Hodan et al., "BOP Challenge 2020 on 6D Object Localization", ECCVW 2020, section 2.2,
with the visibility of bop_toolkit's mode ``bop19``. An object-frame that is scored and not tracked is a miss at every
threshold. MSSD and MSPD are taken over at most 1000 points of the model, VSD over every third pixel each way.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from simtrack.contracts import Bool, CameraIntrinsics, Float64, RgbdFrame
from simtrack.evaluation.metrics import Metrics, measured, unmeasured
from simtrack.evaluation.pose_errors import PoseScorer, equivalents, mspd, mssd
from simtrack.evaluation.tracking import ObjectFrame
from simtrack.objects import ObjectModel
from simtrack.raycast import RayBundle, RayScene, TriangleMesh

THRESHOLDS: Float64 = np.linspace(0.05, 0.5, 10)
"""Of VSD; times the diameter of MSSD and of VSD's tolerances tau; times 100 pixels at a width of 640 of MSPD."""
DELTA = 0.015
"""Metres by which a surface may lie behind the measured one and still be taken for visible."""
STRIDE = 3


def vsd(estimated: Float64, true: Float64, measured_distance: Float64, taus: Float64, delta: float = DELTA) -> Float64:
    """Visible surface discrepancy for each tolerance, 0 to 1 (the step cost of eq. 1).

    Args:
        estimated: distances from the camera's centre to the model at the estimated pose, 0 = none; any shape.
        true: likewise at the true pose.
        measured_distance: likewise, of the image; 0 = no reading.
        taus: (T,) tolerances, in the unit of the distances.
        delta: tolerance of visibility, likewise.

    """

    def visible(model: Float64) -> Bool:
        return ((model - measured_distance <= delta) | (measured_distance == 0.0)) & (model > 0.0)

    seen_true = visible(true)
    seen = visible(estimated) | (seen_true & (estimated > 0.0))
    both, either = seen & seen_true, np.count_nonzero(seen | seen_true)
    if not either:
        return np.ones(len(taus))
    apart = np.abs(true[both] - estimated[both])
    wrong = (apart[None] >= np.asarray(taus)[:, None]).sum(axis=1)
    return (wrong + either - np.count_nonzero(both)) / either


class BopRecall:
    """Collects the three errors of scored object-frames; a context manager holds the ray scenes."""

    def __init__(self, models: Mapping[str, ObjectModel], scorers: Mapping[str, PoseScorer]) -> None:
        """True models and their scorers, by class name."""
        self._scorers = scorers
        self._equivalents = {name: equivalents(scorer.symmetries) for name, scorer in scorers.items()}
        self._scene = RayScene()
        self._instances: dict[str, int] = {}
        for name, model in models.items():
            mesh = TriangleMesh(model.mesh.vertices, model.mesh.faces)
            self._instances[name] = self._scene.add(mesh)
        for instance in self._instances.values():
            self._scene.set_enabled(instance, False)
        self._rays: tuple[CameraIntrinsics, RayBundle, Float64] | None = None
        self._recalls: list[tuple[float, float, float]] = []

    def observe(self, frame: RgbdFrame, objects: Sequence[ObjectFrame]) -> None:
        """Take the depth image and the object-frames of one stamp."""
        for thing in objects:
            if thing.scored:
                T_est = thing.track.T_camera_object if thing.track is not None else None
                self.take(frame, thing.class_name, T_est, thing.T_camera_object)

    def take(self, frame: RgbdFrame, name: str, T_est: Float64 | None, T_true: Float64) -> None:
        """Take one object of a frame, its estimated and its true pose in the camera; None: it was not found."""
        self._recalls.append((0.0, 0.0, 0.0) if T_est is None else self._recall(frame, name, T_est, T_true))

    def _recall(self, frame: RgbdFrame, name: str, T_est: Float64, T_true: Float64) -> tuple[float, float, float]:
        """Shares of the thresholds that VSD, MSSD and MSPD keep."""
        scorer, K = self._scorers[name], frame.intrinsics
        points, poses = scorer.queries, self._equivalents[name]
        _, bundle, lengths = self._bundle(K)
        test = frame.depth[::STRIDE, ::STRIDE].astype(float)
        test = np.where(np.isfinite(test), test, 0.0) * lengths
        shown = [self._distances(name, T, bundle) * lengths for T in (T_est, T_true)]
        surface = vsd(shown[0], shown[1], test, THRESHOLDS * scorer.diameter)
        distance = mssd(T_est, T_true, points, poses)
        pixels = mspd(T_est, T_true, points, poses, K) if T_est[2, 3] > 0.0 else np.inf
        return (
            float(np.mean(surface[:, None] < THRESHOLDS[None])),
            float(np.mean(distance < THRESHOLDS * scorer.diameter)),
            float(np.mean(pixels < 100.0 * THRESHOLDS * K.width / 640.0)),
        )

    def _bundle(self, K: CameraIntrinsics) -> tuple[CameraIntrinsics, RayBundle, Float64]:
        """Rays of the pixels that take part, and how long they are where the depth is 1."""
        if self._rays is None or self._rays[0] != K:
            u, v = np.meshgrid(np.arange(0, K.width, STRIDE), np.arange(0, K.height, STRIDE))
            lengths = np.sqrt(1.0 + ((u - K.cx) / K.fx) ** 2 + ((v - K.cy) / K.fy) ** 2)
            self._rays = K, RayBundle.from_camera(K, STRIDE), lengths
        return self._rays

    def _distances(self, name: str, T_camera_object: Float64, bundle: RayBundle) -> Float64:
        """Depth image of one model alone, 0 where it is not."""
        instance = self._instances[name]
        self._scene.set_enabled(instance, True)
        self._scene.set_pose(instance, T_camera_object)
        found = self._scene.cast(bundle, np.eye(4)).distances.reshape(bundle.shape).astype(float)
        self._scene.set_enabled(instance, False)
        return np.where(np.isfinite(found), found, 0.0)

    def metrics(self, prefix: str = "tracking.bop") -> Metrics:
        """``PREFIX.ar`` and its parts."""
        names = (f"{prefix}.ar_vsd", f"{prefix}.ar_mssd", f"{prefix}.ar_mspd")
        if not self._recalls:
            missing = "no object was visible enough"
            return {name: unmeasured("1", missing) for name in (*names, f"{prefix}.ar")}
        means = np.mean(self._recalls, axis=0)
        metrics = {name: measured(value, "1") for name, value in zip(names, means, strict=True)}
        return metrics | {f"{prefix}.ar": measured(means.mean(), "1")}

    def close(self) -> None:
        """Release the ray scene."""
        self._scene.close()
