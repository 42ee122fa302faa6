"""The values that cross seams between stages, and the Protocols of the stages.

Conventions (used everywhere in simtrack)
-----------------------------------------
* Transforms are ``T_target_source``, 4x4 float64: ``p_target = T_target_source @ p_source``.
* Frames: ``map`` (gravity is -z), ``base`` (x forward, y left, z up, origin on the floor), ``camera`` (optical: x
  right, y down, z forward), ``lidar`` (x forward, z up), ``object`` (origin at the centre of the model's box, z up).
* Metres, radians, seconds, kilograms; stamps are simulated or recorded time in integer nanoseconds.
* Images are row 0 on top; pixel centres lie at integer indices. ``depth`` is float32, metres along the optical axis,
  0 = no reading. ``ranges`` are metres along the ray, inf = no return, never NaN.
* Covariances are 6x6, translation then rotation vector, perturbing on the left in the frame of the pose, decoupled:
  ``t_true = t + rho``, ``R_true = Exp(phi) @ R`` for ``xi = (rho, phi)`` (see `simtrack.geometry.transforms.perturb`).
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
import numpy.typing as npt

Float32: TypeAlias = npt.NDArray[np.float32]
Float64: TypeAlias = npt.NDArray[np.float64]
Int32: TypeAlias = npt.NDArray[np.int32]
Uint8: TypeAlias = npt.NDArray[np.uint8]
Bool: TypeAlias = npt.NDArray[np.bool_]

NANOSECONDS = 1_000_000_000
"""Nanoseconds in a second."""


class Status(StrEnum):
    """How a stage fared on one frame."""

    OK = "ok"
    DEGRADED = "degraded"
    """Answered, but with less information than usual (some data unusable)."""
    NO_DATA = "no-data"
    """The frame held nothing usable (no depth, empty scan); state kept."""
    STALE = "stale"
    """The frame's stamp lies before or at one already processed; ignored."""
    FAILED = "failed"
    """The stage raised or did not converge; state kept."""
    AMBIGUOUS = "ambiguous"
    """Several answers fit the data about equally well; none is asserted."""
    LOST = "lost"
    """The stage knows that it does not know."""


# -------------------------------------------------------------------------------------------------------------- sensing


@dataclass(frozen=True, slots=True)
class CameraIntrinsics:
    """Pinhole camera without distortion; pixel centres at integer indices.

    ``u = fx x / z + cx``, ``v = fy y / z + cy``. A centred camera has ``cx = (width - 1) / 2``.
    """

    width: int
    """Pixels."""
    height: int
    """Pixels."""
    fx: float
    """Focal length, pixels."""
    fy: float
    cx: float
    """Principal point, pixels."""
    cy: float

    @property
    def matrix(self) -> Float64:
        """(3, 3) calibration matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, slots=True)
class RgbdFrame:
    """One registered RGB-D image, taken at one instant."""

    stamp: int
    """Nanoseconds, of the depth image, as the sensor's driver reports it."""
    depth: Float32
    """(H, W), metres along the optical axis, 0 = no reading."""
    rgb: Uint8 | None
    """(H, W, 3), or None where no colour was rendered or recorded for this frame."""
    intrinsics: CameraIntrinsics
    T_base_camera: Float64
    """(4, 4), from joint encoders and calibrated extrinsics: what the robot believes."""
    sequence: int = 0
    """Running number of the sensor's frames; gaps tell of dropped ones."""


@dataclass(frozen=True, slots=True)
class LidarScan:
    """One turn of a spinning lidar, each shot taken at its own time while the robot moves."""

    stamp: int
    """Nanoseconds, of the first shot."""
    directions: Float32
    """(N, 3), unit vectors in the lidar frame at each shot's own time."""
    ranges: Float32
    """(N,), metres along the ray, inf = no return."""
    times: Float32
    """(N,), seconds after `stamp`, 0 up to one turn."""
    rings: Uint8
    """(N,), rank of the laser by elevation, 0 = lowest."""
    intensities: Float32
    """(N,), calibrated reflectivity 0-255."""
    T_base_lidar: Float64
    """(4, 4), calibrated extrinsics."""
    sequence: int = 0


@dataclass(frozen=True, slots=True)
class Odometry:
    """Wheel odometry: dead reckoning in its own drifting frame."""

    stamp: int
    """Nanoseconds."""
    T_odom_base: Float64
    """(4, 4)."""
    linear: float
    """Forward speed of the base, m/s."""
    angular: float
    """Yaw rate of the base, rad/s."""


@dataclass(frozen=True, slots=True)
class JointState:
    """Encoder readings."""

    stamp: int
    """Nanoseconds."""
    names: tuple[str, ...]
    positions: Float64
    """(J,), rad or m, in the order of `names`."""


SensorFrame: TypeAlias = RgbdFrame | LidarScan | Odometry | JointState


# ------------------------------------------------------------------------------------------------------ prior knowledge


@dataclass(frozen=True, slots=True)
class MapEntity:
    """A labelled piece of the static map: a table, a shelf board, a wall."""

    name: str
    """Unique, e.g. ``workbench`` or ``shelf/board2``."""
    semantic_class: str
    """e.g. ``table``, ``shelf``, ``bin``, ``wall``, ``floor``."""
    T_map_entity: Float64
    """(4, 4), centre of the entity's box; z up, y to the entity's left, x to its front."""
    extents: Float64
    """(3,), full side lengths of the box along its own axes, metres."""
    room: str = ""
    """Name of the room it stands in, or empty."""
    supports: tuple[tuple[Float64, Float64], ...] = ()
    """Horizontal faces that things can stand on: (T_map_face (4, 4) with origin in the face's centre and z up,
    size (2,) in metres along the face's x and y)."""


@dataclass(frozen=True, slots=True)
class Room:
    """A room of the static map."""

    name: str
    polygon: Float64
    """(K, 2), counter-clockwise outline in map x, y, metres."""
    floor: float = 0.0
    """Height of its floor in the map, metres."""
    height: float = 3.0
    """Metres."""


@dataclass(frozen=True, slots=True)
class Articulation:
    """A piece of the map that a joint lets move: a door, a drawer. Everything is in the map, with the joint at 0."""

    name: str
    """Unique, e.g. ``fridge1/door``."""
    semantic_class: str
    """Of the furniture that it belongs to."""
    kind: Literal["revolute", "prismatic"]
    anchor: Float64
    """(3,), a point of the axis, metres."""
    axis: Float64
    """(3,), unit vector; about it, right-handed, or along it the joint moves."""
    lower: float
    """Radians or metres."""
    upper: float
    vertices: Float32
    """(V, 3), metres."""
    faces: Int32
    """(F, 3), counter-clockwise seen from the free side."""


@dataclass(frozen=True, slots=True)
class StaticMap:
    """What was surveyed of the static world: one mesh with labels. Never the simulated world itself."""

    vertices: Float32
    """(V, 3), map frame, metres."""
    faces: Int32
    """(F, 3), counter-clockwise seen from the free side."""
    entities: tuple[MapEntity, ...] = ()
    rooms: tuple[Room, ...] = ()
    noise: float = 0.005
    """Standard deviation of the surface, metres, as the surveyor states it."""
    articulations: tuple[Articulation, ...] = ()
    """What joints let move; none of it is part of the mesh."""


# ------------------------------------------------------------------------------------------------------------ detection


@dataclass(frozen=True, slots=True)
class Detection:
    """One object seen in one RGB image."""

    class_name: str
    """Name of the object model, e.g. ``relay``."""
    keypoints: Float64
    """(9, 2), pixels: the eight corners of the model's box in the order of `simtrack.objects`, then its centre."""
    keypoint_sigma: Float64
    """(9,), pixels, the detector's own estimate of each keypoint's standard deviation."""
    box: Float64
    """(4,), pixels: x min, y min, x max, y max."""
    score: float
    """0 to 1."""


@dataclass(frozen=True, slots=True)
class DetectionResult:
    """A detector's answer for one image."""

    stamp: int
    """Nanoseconds: stamp of the image."""
    available: int
    """Nanoseconds: simulated or recorded time at which the answer is there (stamp plus latency)."""
    detections: tuple[Detection, ...]
    status: Status = Status.OK
    next_image: int | None = None
    """Nanoseconds: the detector takes no image before this time; None: none before its answer is there."""


@dataclass(frozen=True, slots=True)
class PoseHypothesis:
    """A pose that explains one detection."""

    class_name: str
    stamp: int
    T_camera_object: Float64
    """(4, 4)."""
    covariance: Float64
    """(6, 6), in the camera frame."""
    reprojection_error: float
    """Pixels, root mean square over the keypoints used."""
    score: float


@runtime_checkable
class Detector(Protocol):
    """Finds known objects in an RGB image."""

    def detect(self, frame: RgbdFrame, regions: Sequence["RegionOfInterest"] = ()) -> DetectionResult:
        """Detect objects in `frame`; `regions` are image regions that the map and the tracks leave unexplained."""
        ...


# ------------------------------------------------------------------------------------------------------------- tracking


class TrackStatus(StrEnum):
    """Life cycle of a track."""

    TENTATIVE = "tentative"
    """Born from a detection, not yet confirmed by registrations."""
    CONFIRMED = "confirmed"
    """Registered in the recent frames."""
    OCCLUDED = "occluded"
    """In the field of view, but something is measured in front of it: kept."""
    OUT_OF_VIEW = "out-of-view"
    """Outside the camera's view or range: kept."""
    LOST = "lost"
    """Should be visible and is not: about to be pruned unless found again."""


BELIEVED = (TrackStatus.CONFIRMED, TrackStatus.OCCLUDED, TrackStatus.OUT_OF_VIEW)
"""Statuses of tracks that count as knowledge: confirmed once, and nothing has refuted them."""


@dataclass(frozen=True, slots=True)
class Track:
    """One believed object."""

    id: int
    """Unique in a run, from 1."""
    class_name: str
    status: TrackStatus
    stamp: int
    """Nanoseconds, of the data that the pose was computed from."""
    T_map_object: Float64
    """(4, 4), at `stamp` (predicted there if not observed)."""
    covariance: Float64
    """(6, 6), map frame."""
    T_camera_object: Float64
    """(4, 4), in the camera frame at `stamp`."""
    velocity: Float64
    """(6,), linear m/s and angular rad/s, map frame."""
    last_seen: int
    """Nanoseconds, of the last successful registration."""
    visible_fraction: float
    """0 to 1: share of the model's rays in the image that the measurement confirms or leaves unoccluded."""
    moving: bool
    """The filter believes that it moves."""
    residual: float
    """Metres: RMS point-to-plane residual of the last registration, NaN-free, 0 if never registered."""
    score: float
    """0 to 1: belief that the object exists and is of this class."""

    @property
    def believed(self) -> bool:
        """Whether the track counts as knowledge (it was confirmed, and nothing has refuted it)."""
        return self.status in BELIEVED


@dataclass(frozen=True, slots=True)
class TrackerResult:
    """What the tracker believes after one frame."""

    stamp: int
    tracks: tuple[Track, ...]
    status: Status


@dataclass(frozen=True, slots=True)
class RegionOfInterest:
    """A cluster of measurements that nothing explains."""

    stamp: int
    box: Float64
    """(4,), pixels: x min, y min, x max, y max; zeros for a lidar cluster."""
    centre: Float64
    """(3,), map frame."""
    extents: Float64
    """(3,), along the map axes, metres."""
    count: int
    """Measurements in it."""
    sensor: str
    """``camera`` or ``lidar``."""


@dataclass(frozen=True, slots=True)
class Presegmentation:
    """Measurements that neither map, tracks nor the robot's own body explain."""

    stamp: int
    unknown: Bool
    """(H, W) for the camera, (N,) for the lidar: True where a valid measurement is unexplained."""
    valid: int
    """Number of valid measurements."""
    labels: Int32
    """Shape of `unknown`: cluster number from 1, 0 = none."""
    regions: tuple[RegionOfInterest, ...]
    """One a cluster, in the order of the labels."""
    sensor: str
    """``camera`` or ``lidar``."""
    status: Status = Status.OK

    @property
    def reduction(self) -> float:
        """Share of valid measurements that need no further processing (the tracking paper's 86 %)."""
        return 1.0 - float(np.count_nonzero(self.unknown)) / self.valid if self.valid else 0.0


@runtime_checkable
class Tracker(Protocol):
    """Tracks objects with known models."""

    def update(
        self,
        frame: RgbdFrame,
        T_map_camera: Float64,
        covariance: Float64,
        hypotheses: Sequence[PoseHypothesis] = (),
    ) -> TrackerResult:
        """Fuse one frame; `covariance` is that of the camera's map pose. `hypotheses` may be of an older stamp."""
        ...


# --------------------------------------------------------------------------------------------------------- localization


@dataclass(frozen=True, slots=True)
class Localization:
    """Where the robot believes to be."""

    stamp: int
    """Nanoseconds, of the data that the pose belongs to."""
    T_map_base: Float64
    """(4, 4)."""
    covariance: Float64
    """(6, 6), map frame."""
    status: Status
    """OK: trusted. AMBIGUOUS or LOST: not to be relied upon. NO_DATA, STALE: the pose is predicted from odometry."""
    inlier_share: float = 0.0
    """Share of valid measurements that the map explains."""
    residual: float = 0.0
    """Metres: RMS point-to-plane residual of the inliers."""


@runtime_checkable
class Localizer(Protocol):
    """Estimates the robot's pose in the static map."""

    def predict(self, odometry: Odometry) -> None:
        """Take one odometry reading."""
        ...

    def update(self, scan: LidarScan) -> Localization:
        """Correct with one scan; the result is stamped with the end of the scan (its last shot)."""
        ...

    def pose_at(self, stamp: int) -> Localization:
        """Best pose at `stamp`, interpolated or extrapolated with odometry."""
        ...


# ---------------------------------------------------------------------------------------------------------- scene graph


@dataclass(frozen=True, slots=True)
class Relation:
    """`subject` stands in relation `name` to `reference`, object-centred in the reference's own frame."""

    subject: str
    name: str
    """``on``, ``in``, ``above``, ``below``, ``left-of``, ``right-of``, ``in-front-of``, ``behind``, ``near``,
    ``touching``, ``intersects``."""
    reference: str


@dataclass(frozen=True, slots=True)
class JointEstimate:
    """How far a piece of furniture is believed to be open."""

    name: str
    """Of its `Articulation`."""
    stamp: int
    """Nanoseconds."""
    position: float
    """Radians or metres."""
    variance: float
    """rad^2 or m^2; that of a uniform distribution over the joint's range where nothing is known."""
    velocity: float
    """rad/s or m/s."""
    last_seen: int | None
    """Nanoseconds, of the last image that told of it; None if none did."""
    status: TrackStatus
    """TENTATIVE: never seen; LOST: the images contradict every position that was tried."""


@dataclass(frozen=True, slots=True)
class Belief:
    """All that the stack believes after one camera frame: the only thing an agent sees."""

    stamp: int
    """Nanoseconds, of the camera frame."""
    localization: Localization
    T_map_camera: Float64
    """(4, 4), believed."""
    tracks: tuple[Track, ...]
    camera: Presegmentation | None
    """Pre-segmentation of the depth image of an earlier frame (see its stamp), with the first belief that it is done
    for; None otherwise."""
    lidar: Presegmentation | None
    """Pre-segmentation of the latest scan that was segmented (see its stamp)."""
    relations: Set[Relation]
    """Relations that held at `stamp`, between entities named as in the graph (``relay-3``, ``workbench``)."""
    status: Mapping[str, Status] = field(default_factory=dict)
    """Stage name -> how it fared."""
    stage_seconds: Mapping[str, float] = field(default_factory=dict)
    """Stage name -> wall time spent on this frame, and beside the frames on what was taken up with it. Measured, not
    simulated."""
    joints: tuple[JointEstimate, ...] = ()
    """One for each articulation of the map, in its order."""


# --------------------------------------------------------------------------------------------------------------- acting


@dataclass(frozen=True, slots=True)
class Command:
    """What the robot is told to do until the next command."""

    linear: float = 0.0
    """Forward speed of the base, m/s."""
    angular: float = 0.0
    """Yaw rate of the base, rad/s."""
    head_pan: float = 0.0
    """Target angle, rad, positive to the left."""
    head_tilt: float = 0.0
    """Target angle, rad, negative looks down."""
    torso: float = 0.15
    """Target lift, m, 0 to 0.35."""


@runtime_checkable
class SceneGraphBuilder(Protocol):
    """Says what stands how to what."""

    def update(self, stamp: int, tracks: Sequence[Track]) -> Set[Relation]:
        """Take what is tracked at `stamp`, nanoseconds, and answer with all relations that hold then."""
        ...


@runtime_checkable
class Agent(Protocol):
    """Decides from the stack's output where the robot looks and drives."""

    def act(self, belief: Belief, joints: JointState) -> Command:
        """Answer one belief with one command."""
        ...
