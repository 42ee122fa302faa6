"""What the tracker keeps of an object and of a depth image, and its settings."""

from dataclasses import dataclass, field

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float32, Float64, TrackStatus
from simtrack.geometry.transforms import with_lever
from simtrack.objects import ObjectModel
from simtrack.perception.tracking.birth import FitConfig
from simtrack.perception.tracking.correspondences import box_share_in_image
from simtrack.perception.tracking.filter import FilterConfig, PoseFilter
from simtrack.perception.tracking.registration import RegistrationConfig, RegistrationResult, TrackedModel
from simtrack.raycast import TriangleMesh


@dataclass(frozen=True, slots=True)
class TrackerConfig:
    """Settings of `ObjectTracker`."""

    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    filter: FilterConfig = field(default_factory=FilterConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    buffer: float = 0.8
    """Depth images are kept this long for late detections, seconds."""
    cast_time: float = 0.0005
    """A detection of something new, or that contradicts a track, is registered beside the frames; each of the casts
    that this needs is taken to last so long, seconds of the sensor's clock."""
    wait: bool = True
    """Frames wait for such a registration when its time is up; False: see `simtrack.perception.beside`."""
    threads: bool = True
    """Such a registration has a thread of its own; False: see there."""
    confirm_detections: int = 2
    """Detections that a new object needs before it is believed; one is enough where the fit leaves no doubt."""
    confirm_frames: int = 3
    """Registered frames that a new object needs before it is believed."""
    tentative_timeout: float = 1.2
    """A new object that is not confirmed within this time is dropped, seconds."""
    lost_after: float = 0.25
    """An object that should be visible and is not is lost after this time, seconds."""
    keep_support: float = 0.4
    """Least share of unoccluded rays that must confirm a track for its registration to count."""
    min_rays: int = 16
    """Fewest confirming rays for a registration to count."""
    max_jump: float = 0.08
    """A registration that moves a track further than this from its prediction, metres, is not believed."""
    disagreement: float = np.deg2rad(25.0)
    """Detections that differ from a registered track by more than this put its orientation to the test, radians."""
    doubt: float = np.deg2rad(14.0)
    """... or by more than this, if its fit is doubtful ..."""
    doubtful_support: float = 0.95
    """... with less support than this ..."""
    doubtful_misfit: float = 0.85
    """... or a larger misfit than this."""
    beside: float = 0.2
    """Detections that lie further beside a track than this share of its diameter disagree with it, too."""
    demote_after: int = 3
    """So many detections in a row that disagree end the belief in a track that is vague:"""
    vague_rotation: float = np.deg2rad(1.2)
    """one whose orientation the depth image determines no better than this, radians."""
    unseen_gap: float = 0.5
    """An object that was not seen for this long, seconds ..."""
    displaced: float = 0.04
    """... and then stands further than this from where it was, metres, has been moved; if vague, it is not believed."""
    fastest: float = 1.2
    """Nothing that hands carry moves faster than this, m/s; a registration that says so has slid off ..."""
    fastest_turn: float = 4.0
    """... or turns faster than this, rad/s."""
    poor_misfit: float = 1.8
    """A registration with a larger misfit than this is not believed."""
    doubt_after: int = 3
    """So many registrations in a row that cannot be believed end the belief in a track."""
    shared_surface: float = 0.4
    """Two objects cannot both be there if they explain more than this share of the same measurements."""
    localization_correlation: float = 0.3
    """Time over which errors of the robot's pose are correlated, seconds."""
    same_object_speed: float = 0.7
    """An object of the same class that appears within reach of one that was being moved is that one, m/s."""
    same_object_memory: float = 4.0
    """... if that one was last seen at most this long ago, seconds."""
    identity_time: float = 0.5
    """A track that was believed for less than this in all, seconds, may never have been of anything: once it is lost,
    nothing that turns up is taken for it."""
    reunite_time: float = 1.5
    """What turned up at most this long ago, seconds, is the object of its class that is not believed any more."""


@dataclass(slots=True)
class View:
    """A depth image with the camera's pose at its stamp."""

    stamp: int
    depth: Float32
    intrinsics: CameraIntrinsics
    T_map_camera: Float64
    covariance: Float64
    T_base_camera: Float64
    noise: float
    """Misfit of right poses, see `simtrack.perception.tracking.birth.NoiseLevel`."""


@dataclass(slots=True)
class Target:
    """All that is kept of one object."""

    id: int
    model: ObjectModel
    filter: PoseFilter
    born: int
    status: TrackStatus = TrackStatus.TENTATIVE
    detections: int = 1
    frames: int = 0
    last_seen: int = 0
    missing_since: int | None = None
    disagreements: int = 0
    doubts: int = 0
    """Registrations in a row that were not believed."""
    moved_when_seen: bool = False
    newcomer: bool = True
    """It is not one that was known before, and the belief in it has not been ended yet."""
    believed: int = 0
    """Nanoseconds for which it was believed and seen."""
    known: bool = False
    """It was believed once: its identity is kept for when it turns up again."""
    score: float = 0.5
    visible_fraction: float = 0.0
    residual: float = 0.0
    result: RegistrationResult | None = None
    _spread: tuple[RegistrationResult, float] | None = None
    """A registration, and the largest variance of the orientation that it found, rad^2."""

    @property
    def alive(self) -> bool:
        """Whether it takes part in registration."""
        return self.status is not TrackStatus.LOST

    def clear(self, config: TrackerConfig) -> bool:
        """Whether it is believed, and its last registration leaves no doubt."""
        result, seen = self.result, self.status is TrackStatus.CONFIRMED
        return seen and result is not None and result.support >= config.doubtful_support and not self.vague(config)

    @property
    def gone(self) -> bool:
        """Whether it was known, and is not believed where it was or may be."""
        return self.known and self.status in (TrackStatus.LOST, TrackStatus.TENTATIVE)

    def vague(self, config: TrackerConfig) -> bool:
        """Whether the depth image determines its orientation too poorly to outweigh detections."""
        return self.vaguer(config.vague_rotation)

    def vaguer(self, angle: float) -> bool:
        """Whether its orientation has a larger standard deviation than this about some axis, radians."""
        result = self.result
        if result is None:
            return True
        if self._spread is None or self._spread[0] is not result:  # asked several times a frame
            self._spread = result, float(np.linalg.eigvalsh(result.covariance[3:, 3:])[-1])
        return self._spread[1] > angle**2

    def doubtful(self, config: TrackerConfig) -> bool:
        """Whether its last registration may have slid into a wrong minimum."""
        result = self.result
        return result is not None and (
            result.support < config.doubtful_support or result.misfit > config.doubtful_misfit
        )


def tracked_model(model: ObjectModel) -> TrackedModel:
    """What the registration needs of an object model."""
    corners = model.keypoints[:8]
    return TrackedModel(
        TriangleMesh(model.mesh.vertices, model.mesh.faces), corners, 0.5 * float(np.linalg.norm(model.extents))
    )


def beside(T_a: Float64, T_b: Float64) -> float:
    """How far one pose lies beside another as the camera sees it, metres at the depth of the second."""
    a, b = T_a[:3, 3], T_b[:3, 3]
    return float(np.linalg.norm(a[:2] / a[2] - b[:2] / b[2]) * b[2])


def camera_error_at(view: View, T_map_object: Float64) -> Float64:
    """(6, 6) covariance that an uncertain camera pose adds to an object's pose in the map, lever arm included."""
    return with_lever(view.covariance, T_map_object[:3, 3] - view.T_map_camera[:3, 3])


def share_in_image(model: ObjectModel, T_camera_object: Float64, intrinsics: CameraIntrinsics) -> float:
    """Share of the projected box's bounding rectangle that lies inside the image."""
    camera = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])
    size = (intrinsics.width, intrinsics.height)
    return box_share_in_image(model.keypoints[:8], T_camera_object, camera, size)
