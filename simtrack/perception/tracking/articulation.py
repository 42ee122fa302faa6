"""Joint positions of doors and drawers by ray tracing: registration with one unknown for each joint.

A moving part is an instance of its own whose pose is a function of the joint's position; what it hangs on stands where
the map says. Along the viewing rays measured points are paired with the part's surface as for objects (tracking paper,
III.B), and Gauss-Newton on robust point-to-plane residuals ``r = n . (p - m)`` moves the joint by the column
``n . dm/dq`` with ``dm/dq = axis x (m - anchor)`` of a hinge and ``axis`` of a slide. Where that leads nowhere, as with
what was never seen or was moved unseen, the joint's whole range is tried.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from simtrack.contracts import (
    NANOSECONDS,
    Articulation,
    Bool,
    CameraIntrinsics,
    Float32,
    Float64,
    JointEstimate,
    RgbdFrame,
    StaticMap,
    TrackStatus,
)
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import apply, exp_so3, inverse, transform
from simtrack.perception.tracking import correspondences as kernels
from simtrack.perception.tracking.registration_config import RegistrationConfig
from simtrack.raycast import RayBundle, RayScene, TriangleMesh

MAP = 0
"""Instance of the map in the scene; the part of articulation k is instance k + 1."""


@dataclass(frozen=True, slots=True)
class ArticulationConfig:
    """Settings of `ArticulationTracker`."""

    gates: tuple[float, ...] = (0.06, 0.03, 0.02, 0.02)
    """Metres along the normal within which points are paired, one a cast; 3 sigma of the sensor are added."""
    kernel: float = 4.0
    """Scale of the Geman-McClure kernel, standard deviations."""
    rays: int = 1200
    """About the largest number of rays in a cast."""
    search_rays: int = 300
    """As `rays`, where the whole range is tried."""
    rest: float = 0.002
    """Metres of the outermost point: a joint that one step moves by less than this is where it was."""
    min_rays: int = 24
    """Fewest confirming rays for a registration to count."""
    keep_support: float = 0.6
    """Least share of the unoccluded rays that must confirm a position."""
    distinct: float = 0.8
    """A position that another one, elsewhere, explains the image nearly as well as, by this share, is not believed."""
    spacing: float = 0.08
    """Metres that the outermost point moves between the positions that a search tries."""
    range: float = 4.0
    """Metres from the camera beyond which a joint is not looked at."""
    sigma: float = 0.008
    """Metres: standard deviation of surface and base in the map, which more pixels do not average out."""
    drift_seen: float = 0.4
    """rad (or m) per square root of a second: how fast the variance grows between two images that show the joint."""
    drift_unseen: float = 0.03
    """As `drift_seen`, while nothing is seen of it."""
    lost_after: float = 0.5
    """Seconds for which a joint is taken to go on as it did when no image tells of it: a leaf that is seen edge-on."""
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    """What the sensor is taken to do."""

    def __post_init__(self) -> None:
        if not self.gates or min(self.gates) <= 0.0:
            raise InvalidValueError("ArticulationConfig.gates", self.gates, "positive lengths")


def motion(articulation: Articulation, position: float) -> Float64:
    """(4, 4) displacement of the part, map frame, at a joint position, rad or m."""
    if articulation.kind == "prismatic":
        return transform(None, position * articulation.axis)
    R = exp_so3(position * articulation.axis)
    return transform(R, articulation.anchor - R @ articulation.anchor)


def uniform_variance(articulation: Articulation) -> float:
    """rad^2 or m^2: of a joint of which nothing but its range is known."""
    return (articulation.upper - articulation.lower) ** 2 / 12.0


@dataclass(frozen=True, slots=True)
class JointFit:
    """How well a position explains an image."""

    position: float
    variance: float
    """rad^2 or m^2; inf without pairs."""
    rays: int
    """Rays that hit the part first."""
    supported: int
    missing: int
    """Rays that were measured to go through it."""

    @property
    def score(self) -> float:
        """Rays for it less those against it."""
        return self.supported - 2.0 * self.missing

    @property
    def support(self) -> float:
        """Share of the rays that say anything which confirm the position."""
        seen = self.supported + self.missing
        return self.supported / seen if seen else 0.0


@dataclass(slots=True)
class _State:
    position: float
    variance: float
    velocity: float = 0.0
    stamp: int | None = None
    last_seen: int | None = None
    status: TrackStatus = TrackStatus.TENTATIVE

    def recent(self, config: ArticulationConfig) -> bool:
        """Whether it was seen so lately that it still moves as it did."""
        if self.last_seen is None or self.stamp is None:
            return False
        return self.stamp - self.last_seen <= config.lost_after * NANOSECONDS


class ArticulationTracker:
    """Keeps a belief about every joint of a map.

    ::

        tracker = ArticulationTracker(static_map)
        joints = tracker.update(frame, T_map_camera, covariance, own_pixels)
    """

    def __init__(self, static_map: StaticMap, config: ArticulationConfig | None = None) -> None:
        self.config = config or ArticulationConfig()
        self.articulations = static_map.articulations
        self._scene = RayScene()
        if len(static_map.faces):
            self._scene.add(TriangleMesh(static_map.vertices, static_map.faces), instance=MAP)
        self._corners: list[Float64] = []
        self._levers: list[float] = []
        self._states: list[_State] = []
        for k, a in enumerate(self.articulations, 1):
            self._scene.add(TriangleMesh(a.vertices, a.faces), instance=k)
            low, high = a.vertices.min(axis=0).astype(float), a.vertices.max(axis=0).astype(float)
            self._corners.append(
                np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
            )
            self._levers.append(_lever(a))
            self._states.append(_State(min(max(0.0, a.lower), a.upper), uniform_variance(a)))
        self._points = kernels.Points.room(0)
        self._turn = 0

    def close(self) -> None:
        """Release the scene's memory."""
        self._scene.close()

    def update(
        self, frame: RgbdFrame, T_map_camera: Float64, covariance: Float64, own: Bool | None = None
    ) -> tuple[JointEstimate, ...]:
        """Fuse one depth image.

        Args:
            frame: depth (H, W), metres, 0 = no reading.
            T_map_camera: (4, 4), the robot's belief.
            covariance: (6, 6) of it, map frame.
            own: (H, W), True where the robot sees itself.

        Returns:
            One estimate for each articulation, in the map's order.
        """
        depth = kernels.usable_depth(frame.depth)
        if own is not None and own.any():
            depth = np.where(own, np.float32(0.0), depth)
        view = _View(np.ascontiguousarray(depth), frame.intrinsics, inverse(T_map_camera), covariance)
        self._scene.set_poses(self._instances, [view.T_camera_map @ self._pose(i) for i in self._instances])
        searchable = []
        for k, state in enumerate(self._states):
            self._predict(k, state, frame.stamp)
            if not self._in_view(k, view):
                self._unseen(state, TrackStatus.OUT_OF_VIEW)
            elif not self._follow(k, state, view, frame.stamp):
                searchable.append(k)
        if searchable:  # one a frame: it takes a cast for every position that is tried
            self._turn += 1
            self._search(searchable[self._turn % len(searchable)], view, frame.stamp)
        return self.estimates(frame.stamp)

    def estimates(self, stamp: int) -> tuple[JointEstimate, ...]:
        """What is believed."""
        return tuple(
            JointEstimate(a.name, stamp, s.position, s.variance, s.velocity, s.last_seen, s.status)
            for a, s in zip(self.articulations, self._states, strict=True)
        )

    def fit(
        self, k: int, depth: Float32, intrinsics: CameraIntrinsics, T_map_camera: Float64, position: float
    ) -> JointFit:
        """Register joint `k` to a depth image, beginning at a position; the belief stays as it is."""
        view = _View(np.ascontiguousarray(depth), intrinsics, inverse(T_map_camera), np.zeros((6, 6)))
        self._scene.set_poses(self._instances, [view.T_camera_map @ self._pose(i) for i in self._instances])
        return self._register(k, view, position)

    # ------------------------------------------------------------------------------------------------------- the filter

    @property
    def _instances(self) -> tuple[int, ...]:
        return self._scene.instances

    def _pose(self, instance: int) -> Float64:
        if instance == MAP:
            return np.eye(4)
        return motion(self.articulations[instance - 1], self._states[instance - 1].position)

    def _predict(self, k: int, state: _State, stamp: int) -> None:
        seconds = 0.0 if state.stamp is None else (stamp - state.stamp) / NANOSECONDS
        state.stamp = stamp
        a, config = self.articulations[k], self.config
        seen = state.recent(config)
        drift = config.drift_seen if seen else config.drift_unseen
        state.variance = min(state.variance + drift**2 * seconds, uniform_variance(a))
        if seen:
            state.position = min(max(state.position + state.velocity * seconds, a.lower), a.upper)
        else:
            state.velocity = 0.0

    def _follow(self, k: int, state: _State, view: "_View", stamp: int) -> bool:
        """Register a joint from its prediction; False if that leads nowhere and the range is worth a search."""
        if state.last_seen is None or state.status is TrackStatus.LOST:
            return False
        found = self._resting(k, view, state.position) or self._register(k, view, state.position)
        if self._sound(found):
            self._fuse(k, state, found, view, stamp)
            return True
        contradicted = found.missing > max(found.supported, self.config.min_rays)
        if not contradicted and found.rays >= self.config.min_rays:
            self._unseen(state, TrackStatus.OCCLUDED)
            return True
        if not contradicted:  # edge-on, or hidden by the map: nothing is learned
            self._unseen(state, TrackStatus.OCCLUDED)
        return not contradicted

    def _sound(self, found: JointFit) -> bool:
        return found.supported >= self.config.min_rays and found.support >= self.config.keep_support

    def _fuse(self, k: int, state: _State, found: JointFit, view: "_View", stamp: int) -> None:
        """Kalman update of one scalar; the speed follows the positions with some lag."""
        a = self.articulations[k]
        gain = state.variance / (state.variance + found.variance)
        before, position = state.position, state.position + gain * (found.position - state.position)
        if state.last_seen is not None and stamp > state.last_seen and state.recent(self.config):
            seconds = (stamp - state.last_seen) / NANOSECONDS
            moved = state.velocity + (position - before) / seconds
            state.velocity += 0.5 * (moved - state.velocity)
            if abs(position - before + state.velocity * seconds) < 2.0 * np.sqrt(found.variance):
                state.velocity *= 0.5
        state.position = min(max(position, a.lower), a.upper)
        state.variance *= 1.0 - gain
        state.last_seen, state.status = stamp, TrackStatus.CONFIRMED
        self._place(k, state.position, view)

    @staticmethod
    def _unseen(state: _State, status: TrackStatus) -> None:
        if state.last_seen is not None and state.status is not TrackStatus.LOST:
            state.status = status

    def _search(self, k: int, view: "_View", stamp: int) -> None:
        """Try the whole range of a joint; believe the best position if no other is nearly as good."""
        a, state, config = self.articulations[k], self._states[k], self.config
        count = int(np.ceil((a.upper - a.lower) * self._levers[k] / config.spacing)) + 1
        tried = np.linspace(a.lower, a.upper, max(count, 3))
        fits = [self._judge(k, view, float(q), config.gates[0], config.search_rays) for q in tried]
        scores = np.array([one.score for one in fits])
        padded = np.concatenate([[-np.inf], scores, [-np.inf]])
        peaks = np.flatnonzero((scores >= padded[:-2]) & (scores >= padded[2:]) & (scores >= config.min_rays // 3))
        best = sorted((self._register(k, view, float(tried[i])) for i in peaks[np.argsort(-scores[peaks])][:3]),
                      key=lambda one: -one.score)  # fmt: skip
        best = [one for one in best if self._sound(one)]
        if not best:
            if state.recent(config):
                self._unseen(state, TrackStatus.OCCLUDED)
            elif state.last_seen is not None:  # it was believed somewhere, and the images say that it is not there
                state.status, state.variance = TrackStatus.LOST, uniform_variance(a)
            self._place(k, state.position, view)
            return
        apart = 2.0 * config.spacing / self._levers[k]
        rivals = [one for one in best[1:] if abs(one.position - best[0].position) > apart]
        if any(one.score > config.distinct * best[0].score for one in rivals):
            self._place(k, state.position, view)
            return
        state.position, state.variance, state.velocity = best[0].position, uniform_variance(a), 0.0
        state.status = TrackStatus.TENTATIVE
        self._fuse(k, state, best[0], view, stamp)

    # ------------------------------------------------------------------------------------------------- the registration

    def _register(self, k: int, view: "_View", position: float) -> JointFit:
        """Gauss-Newton from a position, and the verdict on where it ends."""
        a = self.articulations[k]
        for gate in self.config.gates:
            step, _, _ = self._linearised(k, view, position, gate)
            limit = self.config.gates[0] / self._levers[k]
            position = min(max(position + min(max(step, -limit), limit), a.lower), a.upper)
        return self._judge(k, view, position, self.config.gates[-1])

    def _resting(self, k: int, view: "_View", position: float) -> JointFit | None:
        """The verdict on where a joint is believed to be, if a single cast says that it is there."""
        step, variance, counts = self._linearised(k, view, position, self.config.gates[-1])
        found = JointFit(
            position + step, variance, int(counts.sum()), int(counts[kernels.SUPPORTED]), int(counts[kernels.MISSING])
        )
        near = abs(step) * self._levers[k] < self.config.rest
        return found if near and self._sound(found) else None

    def _judge(self, k: int, view: "_View", position: float, gate: float, rays: int | None = None) -> JointFit:
        _, variance, counts = self._linearised(k, view, position, gate, rays)
        return JointFit(
            position, variance, int(counts.sum()), int(counts[kernels.SUPPORTED]), int(counts[kernels.MISSING])
        )

    def _linearised(
        self, k: int, view: "_View", position: float, gate: float, rays: int | None = None
    ) -> tuple[float, float, Float64]:
        """Gauss-Newton step, variance, and counts of rays (kernels.FIELDS,) at a position."""
        config, a = self.config.registration, self.articulations[k]
        T_camera_part = self._place(k, position, view)
        counts = np.zeros((1, kernels.FIELDS), np.int64)
        window = _window(apply(T_camera_part, self._corners[k]), view.intrinsics)
        if window is None:
            return 0.0, np.inf, counts[0]
        area = (window[2] - window[0]) * (window[3] - window[1])
        stride = max(1, int(np.sqrt(area / (rays or self.config.rays))))
        bundle = RayBundle.from_windows(view.intrinsics, [window], stride)
        hits = self._scene.cast(bundle, np.eye(4), coherent=None if stride == 1 else False)
        if len(bundle) > len(self._points.weight):
            self._points = kernels.Points.room(len(bundle))
        rows = np.where(hits.instances == k + 1, 0, -1).astype(np.int32)
        assert bundle.pixels is not None
        pairs = kernels.point_correspondences(
            bundle.pixels, bundle.directions, hits.distances, hits.normals, rows, view.depth.reshape(-1),
            view.depth.shape[1], np.array([stride]), gate, 1.0, 0.0, self.config.sigma, config.focal_baseline,
            0.4 / view.intrinsics.fx, np.zeros(3), self._points, 0, counts,
        )  # fmt: skip
        if pairs == 0:
            return 0.0, np.inf, counts[0]
        T = view.T_camera_map
        J, r = joint_column(self._points, pairs, a, T), _residuals(self._points, pairs)
        squared = r * r * self._points.weight[:pairs]
        share = (self.config.kernel**2 / (self.config.kernel**2 + squared)) ** 2
        weight = self._points.weight[:pairs] * share
        H = float(np.sum(weight * J * J))
        if H <= 0.0:
            return 0.0, np.inf, counts[0]
        lever = float(np.sum(weight * J * J) / np.sum(weight))
        # Errors of the map's surface, and of the camera's pose, are the same for all pixels.
        common = self.config.sigma**2 + float(np.trace(view.covariance[:3, :3])) / 3.0
        variance = max(config.correlation_area / stride**2, 1.0) / H + common / max(lever, 1e-12)
        variance += float(np.trace(view.covariance[3:, 3:])) / 3.0
        return float(np.sum(weight * J * r) / H), variance, counts[0]

    def _place(self, k: int, position: float, view: "_View") -> Float64:
        T = view.T_camera_map @ motion(self.articulations[k], position)
        self._scene.set_pose(k + 1, T)
        return T

    def _in_view(self, k: int, view: "_View") -> bool:
        """Whether any position of the joint would show in the image, near enough."""
        a = self.articulations[k]
        for position in (self._states[k].position, a.lower, 0.5 * (a.lower + a.upper), a.upper):
            corners = apply(view.T_camera_map @ motion(a, position), self._corners[k])
            near = float(np.linalg.norm(corners.mean(axis=0))) < self.config.range
            if near and _window(corners, view.intrinsics) is not None:
                return True
        return False


@dataclass(frozen=True, slots=True)
class _View:
    depth: Float32
    intrinsics: CameraIntrinsics
    T_camera_map: Float64
    covariance: Float64


def joint_column(points: "kernels.Points", pairs: int, articulation: Articulation, T_camera_map: Float64) -> Float64:
    """(P,) derivative of the model points along their normals by the joint's position, from the first `pairs` pairs."""
    axis, normals = T_camera_map[:3, :3] @ articulation.axis, points.normal[:pairs]
    if articulation.kind == "prismatic":
        return normals @ axis
    anchor = apply(T_camera_map, articulation.anchor[None])[0]
    return np.sum(normals * np.cross(axis, points.model[:pairs] - anchor), axis=1)


def _residuals(points: "kernels.Points", pairs: int) -> Float64:
    return np.sum(points.normal[:pairs] * (points.measured[:pairs] - points.model[:pairs]), axis=1)


def _lever(articulation: Articulation) -> float:
    """Metres that the outermost point moves for a unit of the joint's position."""
    if articulation.kind == "prismatic":
        return 1.0
    arm = articulation.vertices.astype(float) - articulation.anchor
    arm -= np.outer(arm @ articulation.axis, articulation.axis)
    return max(float(np.linalg.norm(arm, axis=1).max()), 0.05)


def _window(corners: Float64, intrinsics: CameraIntrinsics) -> tuple[int, int, int, int] | None:
    """Pixels (u0, v0, u1, v1) that a box with (8, 3) corners in the camera frame covers; None if out of view."""
    if corners[:, 2].max() < 0.1:
        return None
    if corners[:, 2].min() < 0.1:  # it reaches behind the camera: it may be anywhere in the image
        return (0, 0, intrinsics.width, intrinsics.height)
    u = intrinsics.fx * corners[:, 0] / corners[:, 2] + intrinsics.cx
    v = intrinsics.fy * corners[:, 1] / corners[:, 2] + intrinsics.cy
    u0, v0 = max(0, int(u.min()) - 1), max(0, int(v.min()) - 1)
    u1, v1 = min(intrinsics.width, int(u.max()) + 2), min(intrinsics.height, int(v.max()) + 2)
    return (u0, v0, u1, v1) if u0 < u1 and v0 < v1 else None


def believed_poses(articulations: Sequence[Articulation], joints: Sequence[JointEstimate]) -> Mapping[str, Float64]:
    """Name -> (4, 4) displacement in the map of each part where its joint is believed to be, 0 if nothing is known."""
    positions = {joint.name: joint.position for joint in joints}
    return {a.name: motion(a, positions.get(a.name, min(max(0.0, a.lower), a.upper))) for a in articulations}
