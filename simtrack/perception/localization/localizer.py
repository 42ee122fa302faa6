"""The localizer: odometry between scans, MICP-L on every scan, a search when the pose is lost."""

from collections.abc import Callable
from functools import cached_property, partial

import numpy as np

from simtrack.contracts import (
    NANOSECONDS,
    Bool,
    Float64,
    LidarScan,
    Localization,
    Odometry,
    RgbdFrame,
    StaticMap,
    Status,
)
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import difference, is_rigid, rotate_covariance
from simtrack.perception.localization.assessment import UNJUDGED
from simtrack.perception.localization.config import LocalizerConfig
from simtrack.perception.localization.measurement import Measurement, depth_measurement, deskew, scan_end
from simtrack.perception.localization.poses import UNKNOWN, PoseTrack
from simtrack.perception.localization.recovery import HypothesisSet, start_covariance
from simtrack.perception.localization.registration import Registration, register
from simtrack.perception.localization.search import SearchMap, build_search_map, search
from simtrack.perception.localization.surface import MapSurface
from simtrack.raycast import RayScene


class MeshLocalizer:
    """Localizes a robot on a floor in a mesh map (see `simtrack.contracts.Localizer`).

    Feed it odometry (`predict`) and scans (`update`) in the order of arrival and ask for the pose at any stamp
    (`pose_at`). Without a start pose it searches the whole map with the first scan.
    """

    def __init__(
        self,
        static_map: StaticMap,
        config: LocalizerConfig | None = None,
        scene: RayScene | None = None,
        *,
        map_instance: int = 0,
        lidar_mask: Callable[[LidarScan], Bool] | None = None,
        depth_mask: Callable[[RgbdFrame], Bool] | None = None,
    ) -> None:
        """Prepare the map.

        Args:
            static_map: the survey.
            config: settings, the defaults if None.
            scene: a scene that holds the map already as instance `map_instance`; its own if None.
            map_instance: see `scene`.
            lidar_mask: answers a scan with (N,), True where a shot hit the robot itself.
            depth_mask: answers a depth image with (H, W), likewise.

        Raises:
            MeshError: the map's mesh is empty or not finite.
        """
        self.config = config or LocalizerConfig()
        self.surface = MapSurface(static_map, scene, map_instance)
        self._lidar_mask, self._depth_mask = lidar_mask, depth_mask
        self.reset()

    def reset(self) -> None:
        """Forget all that was measured, keep the map: as after construction."""
        self._poses = PoseTrack(self.config.motion)
        self._draft = self._poses
        """What a correction works at; `pose_at` and `predict` go on with the other one until it is adopted."""
        self._hypotheses = HypothesisSet(self.surface, self.config)
        self._recovering = True
        self._everywhere = True
        self._trusted = False
        self._level = 0.0
        self._poor = 0
        self._last_search: int | None = None
        self._last_scan: int | None = None
        self._observed = 6

    @cached_property
    def search_map(self) -> SearchMap:
        """The map sliced for searching, made at first use."""
        return build_search_map(self.surface.static_map, self.config.search, self.surface.floor)

    def share_search_map(self, other: "MeshLocalizer") -> None:
        """Search the slices that another localizer has made of the same map, if it has made them."""
        if "search_map" in vars(other):
            vars(self)["search_map"] = other.search_map

    # ------------------------------------------------------------------------------------------------------- feeding

    def initialise(self, stamp: int, T_map_base: Float64, covariance: Float64 | None = None) -> None:
        """Start from a given pose, which need not be exact: the first scan looks around it.

        Args:
            stamp: nanoseconds.
            T_map_base: (4, 4).
            covariance: (6, 6), map frame; the config's if None.

        Raises:
            InvalidValueError: the pose is not a finite rigid transform.
        """
        if not is_rigid(T_map_base):
            raise InvalidValueError("T_map_base", np.asarray(T_map_base).tolist(), "a finite rigid 4x4 transform")
        if covariance is None:
            covariance = start_covariance(self.config.initial_sigma, self.config.initial_sigma_yaw)
        T_map_base = np.array(T_map_base, dtype=float)
        self._poses.anchors = []
        self._poses.anchor(stamp, T_map_base, covariance)
        self._hypotheses.items = []
        self._recovering, self._everywhere = False, False
        c = self.config
        sigma, sigma_yaw = np.sqrt(max(covariance[0, 0], covariance[1, 1])), np.sqrt(covariance[5, 5])
        self._trusted = bool(sigma <= c.trusted_sigma and sigma_yaw <= c.trusted_sigma_yaw)
        self._poor, self._level, self._last_search = 0, 0.0, None
        self._poses.latest = Localization(stamp, T_map_base, covariance, Status.DEGRADED)

    def predict(self, odometry: Odometry) -> None:
        """Take one odometry reading; malformed and stale ones are ignored."""
        self._poses.odometry.add(odometry)

    def update(self, scan: LidarScan) -> Localization:
        """Correct with one scan; the result is stamped with the scan's last shot."""
        found = self.begin(scan)()
        self.adopt()
        return found

    def begin(self, scan: LidarScan) -> Callable[[], Localization]:
        """The work of `update`, which may be done in another thread.

        Until it is done and adopted, poses are those of before, and only `predict` and `pose_at` may be called.
        """
        self._draft = self._poses.copy()
        return partial(self._correct, scan)

    def adopt(self) -> None:
        """Take over what the work begun last has found."""
        self._poses.adopt(self._draft)

    def _correct(self, scan: LidarScan) -> Localization:
        end, draft = scan_end(scan), self._draft
        if draft.latest.stamp and end <= draft.latest.stamp and draft.anchors:
            return self._restated(end, Status.STALE)
        c = self.config
        mask = self._lidar_mask(scan) if self._lidar_mask is not None else None
        sigma = c.registration.range_sigma
        measurement = deskew(scan, draft.odometry, sigma, c.min_range, c.max_range, mask)
        if len(measurement) < c.registration.min_correspondences:
            return self._restated(end, Status.NO_DATA)
        self._last_scan = end
        draft.latest = self._recover(measurement) if self._recovering else self._track(measurement, scan.stamp)
        return draft.latest

    def update_depth(self, frame: RgbdFrame) -> Localization:
        """Correct with a depth image where the lidar is silent or leaves directions open; else just `pose_at`."""
        anchors = self._poses.anchors
        late = bool(anchors) and frame.stamp <= anchors[-1].stamp
        silent = self._last_scan is None or frame.stamp - self._last_scan > 0.25 * NANOSECONDS
        if self._recovering or late or not (silent or self._observed < 6):
            return self.pose_at(frame.stamp)
        mask = self._depth_mask(frame) if self._depth_mask is not None else None
        shots = depth_measurement(frame, self.config.depth_stride, self.config.depth_max_range, mask)
        self._draft = self._poses.copy()
        T, P = self._draft.at(frame.stamp)
        found = register(shots, self.surface, T, P, self.config.registration, strides=(2, 1), assessed=True)
        share = (found.assessment or UNJUDGED).explained
        if not found.converged or share < self.config.recovery.min_share or self._contradicts(found, T, P):
            return self._restated(frame.stamp, Status.NO_DATA)
        self._draft.anchor(frame.stamp, found.T_map_base, found.covariance)
        self._draft.latest = Localization(
            frame.stamp, found.T_map_base, found.covariance, Status.DEGRADED, share, found.residual
        )
        self.adopt()
        return self._poses.latest

    # -------------------------------------------------------------------------------------------------------- asking

    def pose_at(self, stamp: int) -> Localization:
        """Best pose at `stamp`: between corrections the drift is spread evenly, beyond the last odometry leads on."""
        T, P = self._poses.at(stamp, cautious=False)
        last = self._poses.latest
        return Localization(stamp, T, P, last.status, last.inlier_share, last.residual)

    @property
    def hypotheses(self) -> tuple[Float64, ...]:
        """(4, 4) T_map_base of the places that are being considered, best first; empty while one pose is believed."""
        return tuple(h.T_map_base for h in self._hypotheses.items) if self._recovering else ()

    # ------------------------------------------------------------------------------------------------------ tracking

    def _track(self, measurement: Measurement, scan_start: int) -> Localization:
        """One step of the filter; the odometry's error over the scan leaves about half of itself in the shots."""
        if not self._trusted:
            return self._look_around(measurement)
        T, P = self._draft.at(measurement.stamp)
        skew = 0.25 * self._draft.drift(scan_start, measurement.stamp)
        turned = rotate_covariance(T[:3, :3], skew)
        found = register(measurement, self.surface, T, P, self.config.registration, systematic=turned, assessed=True)
        judged = found.assessment or UNJUDGED
        c = self.config.recovery
        if not self._level:  # the first scan from a start pose that was given as sure
            if judged.structure < c.accept_share:
                return self._look_around(measurement)
            self._level = judged.structure
        poor = judged.structure < max(c.min_share, c.collapse * self._level) or self._contradicts(found, T, P)
        self._poor = self._poor + 1 if poor else 0
        self._observed = found.observed
        if self._poor >= c.collapse_scans:
            self._recovering, self._everywhere, self._last_search = True, True, None
            self._hypotheses.items = []
            travel = self._travel(measurement.stamp)
            self._hypotheses.add(np.stack([found.T_map_base, T]), measurement, travel, incumbent=True)
            return self._recover(measurement)
        if poor:
            self._draft.anchor(measurement.stamp, T, P)
            return Localization(measurement.stamp, T, P, Status.DEGRADED, judged.explained, found.residual)
        self._level += 0.03 * (judged.structure - self._level)
        self._draft.anchor(measurement.stamp, found.T_map_base, found.covariance)
        vague = float(np.sqrt(np.linalg.eigvalsh(found.covariance[:2, :2])[-1])) > 0.1
        status = Status.DEGRADED if vague or not found.converged else Status.OK
        return Localization(
            measurement.stamp, found.T_map_base, found.covariance, status, judged.explained, found.residual
        )

    def _contradicts(self, found: Registration, T: Float64, P: Float64) -> bool:
        """Whether a correction is far from what odometry allows."""
        c = self.config.recovery
        jump = difference(found.T_map_base, T)
        shift, turn = float(np.hypot(jump[0], jump[1])), abs(float(jump[5]))
        sigma, sigma_yaw = float(np.sqrt(P[0, 0] + P[1, 1])), float(np.sqrt(P[5, 5]))
        return (shift > max(c.jump_translation, 5.0 * sigma)) or (turn > max(c.jump_rotation, 5.0 * sigma_yaw))

    def _look_around(self, measurement: Measurement) -> Localization:
        """First scan after a given start: a search in a window around it, and the start itself."""
        c = self.config
        T, P = self._draft.at(measurement.stamp)
        half = max(c.recovery.window, 3.0 * float(np.sqrt(max(P[0, 0], P[1, 1]))))
        half_yaw = min(max(c.recovery.window_yaw, 3.0 * float(np.sqrt(P[5, 5]))), np.pi)
        around = search(measurement, self.search_map, c.search, window=(T, half, half_yaw))
        self._hypotheses.items = []
        poses = np.concatenate([T[None], around.poses[:8]])
        self._hypotheses.add(poses, measurement, self._travel(measurement.stamp), start=(T, P))
        self._recovering, self._everywhere = True, False
        return self._recover(measurement)

    # ------------------------------------------------------------------------------------------------------ recovery

    def _recover(self, measurement: Measurement) -> Localization:
        """Weigh the hypotheses with one scan; search for more now and then; believe one when it stands out."""
        c, stamp = self.config.recovery, measurement.stamp
        travel = self._travel(stamp)
        self._hypotheses.carry(self._draft.odometry, stamp)
        due = self._last_search is None or stamp - self._last_search >= c.search_period * NANOSECONDS
        if self._everywhere and due:
            self._last_search = stamp
            found = search(measurement, self.search_map, self.config.search)
            self._hypotheses.add(found.poses, measurement, travel)
        self._hypotheses.weigh(measurement)
        winner = self._hypotheses.winner(travel, self._everywhere)
        items = self._hypotheses.items
        if winner is None:
            best = items[0] if items else None
            if best is None or (len(best.shares) >= c.accept_scans and best.share < c.accept_share):
                self._everywhere = True
            T = best.T_map_base if best else self._draft.at(stamp)[0]
            lost = best is None or best.share < c.min_share
            share = best.assessment.explained if best else 0.0
            self._draft.anchors = []
            self._draft.anchor(stamp, T, UNKNOWN)
            return Localization(stamp, T, UNKNOWN, Status.LOST if lost else Status.AMBIGUOUS, share)
        self._recovering, self._everywhere, self._trusted, self._poor = False, False, True, 0
        self._level = winner.share
        self._draft.anchors = []
        self._draft.anchor(stamp, winner.T_map_base, winner.covariance)
        return Localization(
            stamp, winner.T_map_base, winner.covariance, Status.OK, winner.assessment.explained, winner.residual
        )

    # -------------------------------------------------------------------------------------------------------- poses

    def _travel(self, stamp: int) -> float:
        distance, rotation = self._draft.odometry.travel(stamp)
        return distance + 0.5 * rotation

    def _restated(self, stamp: int, status: Status) -> Localization:
        """The predicted pose, with why nothing new was learnt."""
        T, P = self._draft.at(stamp)
        return Localization(stamp, T, P, status, self._draft.latest.inlier_share, self._draft.latest.residual)
