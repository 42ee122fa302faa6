"""Two trackers of other make: point-to-plane ICP on small_gicp and on Open3D (extra `bench`).

::

    simtrack run workbench --tracker simtrack.benchmarks.outsiders:SmallGicpTracker
    simtrack run workbench --tracker simtrack.benchmarks.outsiders:Open3dTracker

They get what simtrack's tracker gets: depth images, the believed pose of the camera, hypotheses of late detections.
Around them is the simplest frame that works: an object stays where it was in the map; the points of its model that face
the camera are registered to the depth points in its enlarged box, first within 3 cm and then within 1 cm. Where few of
them are confirmed by the image, it is taken for hidden, or for gone if one sees through most of them for half a second.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import (
    NANOSECONDS,
    Bool,
    CameraIntrinsics,
    Float64,
    PoseHypothesis,
    RgbdFrame,
    Status,
    Track,
    TrackerResult,
    TrackStatus,
)
from simtrack.geometry.meshes import face_normals, sample_surface
from simtrack.geometry.transforms import apply, inverse, orthonormal
from simtrack.objects import ObjectModel
from simtrack.perception.foreign import track_at

SAMPLES = 2500
"""Points of a model."""
POINTS = 3000
"""Points of a depth image, at most, that are registered."""
REACHES = (0.03, 0.01)
"""Metres: largest distance of corresponding points, in the rounds of registration."""
MARGIN = 0.015
"""Metres by which a model's box is enlarged to choose points."""
LEAST_POINTS = 60
NEIGHBOURS = 12
"""Points that a normal is estimated from."""
AGREES = 0.01
"""Metres within which a depth reading confirms a point of a model."""
GOOD, LEAST_SEEN = 0.6, 0.15
"""Shares from which on a registration is believed: confirmed ones of the model's points that nothing hides, and of all
that face the camera."""
THROUGH = 0.6
"""Share of the points that face the camera behind which something is measured: the object is gone."""
SAME = 0.1
"""Metres within which a detection is of the object that is tracked."""
JUMP = 0.03
"""Metres from one image to the next from which on a registration is not believed: the object left, and its model sinks
into what it stood on."""
GONE_AFTER = NANOSECONDS // 2
MEMORY = 3 * NANOSECONDS
"""Nanoseconds for which poses of the camera are kept: detections come late."""


@dataclass(slots=True)
class _Thing:
    """An object that is tracked."""

    number: int
    class_name: str
    T_map_object: Float64
    detections: int = 1
    status: TrackStatus = TrackStatus.TENTATIVE
    missing_since: int | None = None


@dataclass(frozen=True, slots=True)
class _Agreement:
    """Shares of the model's points that face the camera."""

    inside: float
    """Within the image."""
    confirmed: float
    hidden: float
    """Something is measured in front of them, or nothing, or they lie outside of the image."""
    through: float
    """Something is measured behind them."""


class IcpTracker(ABC):
    """Registers the points around each object to its model; implements `simtrack.contracts.Tracker`."""

    def __init__(self, models: Mapping[str, ObjectModel]) -> None:
        rng = np.random.default_rng(0)
        self._models = dict(models)
        self._surfaces: dict[str, tuple[Float64, Float64]] = {}
        for name, model in sorted(models.items()):
            points, faces = sample_surface(model.mesh, SAMPLES, rng)
            self._surfaces[name] = points, face_normals(model.mesh)[faces]
        self._things: list[_Thing] = []
        self._cameras: dict[int, Float64] = {}
        self._next = 1

    @abstractmethod
    def register(self, model: Float64, points: Float64, T_camera_object: Float64, reach: float) -> Float64:
        """(4, 4) T_camera_object that brings points of a model onto the measured ones.

        Args:
            model: (N, 3), object frame.
            points: (M, 3), measured, camera frame.
            T_camera_object: (4, 4), to start from.
            reach: metres; points of the model farther from all measured ones do not take part.

        """

    def update(
        self,
        frame: RgbdFrame,
        T_map_camera: Float64,
        covariance: Float64,
        hypotheses: Sequence[PoseHypothesis] = (),
    ) -> TrackerResult:
        """See `simtrack.contracts.Tracker`."""
        self._cameras = {s: T for s, T in self._cameras.items() if frame.stamp - s <= MEMORY}
        self._cameras[frame.stamp] = T_map_camera
        for hypothesis in sorted(hypotheses, key=lambda h: h.reprojection_error):
            self._take(hypothesis)
        points = _points(frame.depth, frame.intrinsics)
        for thing in self._things:
            self._follow(thing, frame, points, T_map_camera)
        self._things = [
            thing
            for thing in self._things
            if thing.missing_since is None or frame.stamp - thing.missing_since < GONE_AFTER
        ]
        T_camera_map = inverse(T_map_camera)
        tracks = [self._track(thing, frame, T_map_camera, T_camera_map) for thing in self._things]
        return TrackerResult(frame.stamp, tuple(tracks), Status.OK)

    @staticmethod
    def _track(thing: _Thing, frame: RgbdFrame, T_map_camera: Float64, T_camera_map: Float64) -> Track:
        T_camera_object = T_camera_map @ thing.T_map_object
        return track_at(
            frame, T_map_camera, thing.number, thing.class_name, T_camera_object, status=thing.status,
            translation_sigma=0.004, rotation_sigma=0.03,
        )  # fmt: skip

    def _take(self, hypothesis: PoseHypothesis) -> None:
        """A detection is of an object that is tracked, or of a new one; one that was not found begins anew from it."""
        if hypothesis.stamp not in self._cameras or hypothesis.class_name not in self._models:
            return
        T_map_object = self._cameras[hypothesis.stamp] @ hypothesis.T_camera_object
        same = [t for t in self._things if t.class_name == hypothesis.class_name]
        distances = [float(np.linalg.norm(t.T_map_object[:3, 3] - T_map_object[:3, 3])) for t in same]
        if not distances or min(distances) > SAME:
            self._things.append(_Thing(self._next, hypothesis.class_name, T_map_object))
            self._next += 1
            return
        thing = same[int(np.argmin(distances))]
        thing.detections += 1
        if thing.status is not TrackStatus.CONFIRMED:
            thing.T_map_object = T_map_object

    def _follow(self, thing: _Thing, frame: RgbdFrame, points: Float64, T_map_camera: Float64) -> None:
        """Register one object to the depth image, and judge what became of it."""
        model = self._models[thing.class_name]
        surface, normals = self._surfaces[thing.class_name]
        T_object_camera = inverse(thing.T_map_object) @ T_map_camera
        near = points[np.linalg.norm(points - inverse(T_object_camera)[:3, 3], axis=1) < 0.6 * model.diameter + 0.03]
        for reach in REACHES:
            chosen = _in_box(near, T_object_camera, model.extents, reach + MARGIN)
            if len(chosen) < LEAST_POINTS:
                break
            T_camera_object = inverse(T_object_camera)
            visible = surface[_facing(T_camera_object, surface, normals)]
            T_camera_object = self.register(visible, chosen, T_camera_object, reach)
            T_camera_object[:3, :3] = orthonormal(T_camera_object[:3, :3])
            T_object_camera = inverse(T_camera_object)
        found = _agreement(frame, inverse(T_object_camera), surface, normals)
        jump = float(np.linalg.norm((T_map_camera @ inverse(T_object_camera) - thing.T_map_object)[:3, 3]))
        credible = thing.status is TrackStatus.TENTATIVE or jump <= JUMP
        if credible and found.confirmed >= max(LEAST_SEEN, GOOD * (1.0 - found.hidden)):
            thing.T_map_object = T_map_camera @ inverse(T_object_camera)
            thing.missing_since = None
            if thing.status is not TrackStatus.TENTATIVE or thing.detections > 1:
                thing.status = TrackStatus.CONFIRMED
            return
        stayed = _agreement(frame, inverse(T_map_camera) @ thing.T_map_object, surface, normals)
        if stayed.through < THROUGH:
            thing.missing_since = None
        elif thing.missing_since is None:
            thing.missing_since = frame.stamp
        if thing.status is not TrackStatus.TENTATIVE:
            missed = TrackStatus.OCCLUDED if stayed.inside > 0.5 else TrackStatus.OUT_OF_VIEW
            thing.status = TrackStatus.LOST if thing.missing_since is not None else missed


class SmallGicpTracker(IcpTracker):
    """On small_gicp's point-to-plane ICP."""

    def register(self, model: Float64, points: Float64, T_camera_object: Float64, reach: float) -> Float64:
        """See `IcpTracker.register`."""
        import small_gicp  # pyright: ignore[reportMissingImports] - extra `bench`

        target = small_gicp.PointCloud(points)
        tree = small_gicp.KdTree(target)
        small_gicp.estimate_normals(target, tree, num_neighbors=NEIGHBOURS)
        found = small_gicp.align(
            target, small_gicp.PointCloud(model), tree, T_camera_object, registration_type="PLANE_ICP",
            max_correspondence_distance=reach, num_threads=1, max_iterations=15,
        )  # fmt: skip
        return np.array(found.T_target_source)


class Open3dTracker(IcpTracker):
    """On Open3D's point-to-plane ICP."""

    def register(self, model: Float64, points: Float64, T_camera_object: Float64, reach: float) -> Float64:
        """See `IcpTracker.register`."""
        import open3d  # pyright: ignore[reportMissingImports] - extra `bench`

        geometry, registration = open3d.geometry, open3d.pipelines.registration
        target = geometry.PointCloud(open3d.utility.Vector3dVector(points))
        target.estimate_normals(geometry.KDTreeSearchParamKNN(NEIGHBOURS))
        found = registration.registration_icp(
            geometry.PointCloud(open3d.utility.Vector3dVector(model)), target, reach, T_camera_object,
            registration.TransformationEstimationPointToPlane(),
            registration.ICPConvergenceCriteria(max_iteration=15),
        )  # fmt: skip
        return np.array(found.transformation)


def _points(depth: np.ndarray, K: CameraIntrinsics) -> Float64:
    """(N, 3) points of a depth image, metres, camera frame; every second pixel each way."""
    v, u = np.mgrid[0 : K.height : 2, 0 : K.width : 2]
    z = depth[::2, ::2].astype(float)
    good = np.isfinite(z) & (z > 0.0)
    z, u, v = z[good], u[good], v[good]
    return np.stack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z], axis=1)


def _agreement(frame: RgbdFrame, T_camera_object: Float64, points: Float64, normals: Float64) -> _Agreement:
    """What a depth image says of a model at a pose, by (N, 3) points and normals of its surface."""
    K, seen = frame.intrinsics, apply(T_camera_object, points)
    seen = seen[_facing(T_camera_object, points, normals) & (seen[:, 2] > 0.05)]
    if not len(seen):
        return _Agreement(0.0, 0.0, 1.0, 0.0)
    u, v = (np.round(f * seen[:, k] / seen[:, 2] + c).astype(int) for k, f, c in ((0, K.fx, K.cx), (1, K.fy, K.cy)))
    inside = (u >= 0) & (u < K.width) & (v >= 0) & (v < K.height)
    measured = frame.depth[v[inside], u[inside]]
    ahead = measured - seen[inside, 2]
    valid = np.isfinite(measured) & (measured > 0.0)
    total = len(seen)
    confirmed = np.count_nonzero(valid & (np.abs(ahead) <= AGREES)) / total
    through = np.count_nonzero(valid & (ahead > AGREES)) / total
    return _Agreement(float(inside.mean()), confirmed, 1.0 - confirmed - through, through)


def _facing(T_camera_object: Float64, points: Float64, normals: Float64) -> Bool:
    """(N,), which of (N, 3) points of a surface face the camera."""
    return np.einsum("ij,ij->i", normals @ T_camera_object[:3, :3].T, apply(T_camera_object, points)) < 0.0


def _in_box(points: Float64, T_object_camera: Float64, extents: Float64, margin: float) -> Float64:
    """Those of (N, 3) points that lie in a model's enlarged box, thinned out evenly if they are many."""
    inside = points[(np.abs(apply(T_object_camera, points)) <= 0.5 * extents + margin).all(axis=1)]
    return inside[:: -(-len(inside) // POINTS)] if len(inside) > POINTS else inside
