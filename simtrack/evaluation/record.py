"""What a run leaves in memory for its report: plain data, bounded, with no reference to the simulation."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from simtrack.contracts import (
    NANOSECONDS,
    Belief,
    Bool,
    CameraIntrinsics,
    Float32,
    Float64,
    Relation,
    RgbdFrame,
    StaticMap,
    Track,
)
from simtrack.evaluation.metrics import Metrics
from simtrack.evaluation.tracking import VISIBLE, ObjectFrame
from simtrack.geometry.meshes import Mesh
from simtrack.perception.scene_graph.history import about

KEY_FRAMES, WORST_MOMENTS = 6, 4
WORST_APART = 1.0
"""Seconds between two worst moments."""


@dataclass(frozen=True, slots=True)
class KeyFrame:
    """One camera image with what was believed at its stamp."""

    stamp: int
    jpeg: bytes
    intrinsics: CameraIntrinsics
    T_map_camera: Float64
    """(4, 4), believed."""
    tracks: tuple[Track, ...]
    relations: frozenset[Relation]
    objects: tuple[ObjectFrame, ...]
    """Truth and errors at the stamp."""


@dataclass(frozen=True, slots=True)
class CameraPicture:
    """A depth image and which of its pixels nothing explained."""

    stamp: int
    depth: Float32
    """(H, W), metres."""
    unknown: Bool
    """(H, W)."""
    jpeg: bytes | None
    """The colour image, if one was taken at the stamp."""


@dataclass(frozen=True, slots=True)
class LidarPicture:
    """A scan seen from above and which of its points nothing explained."""

    stamp: int
    points: Float32
    """(N, 3), map frame."""
    unknown: Bool
    """(N,)."""
    T_map_base: Float64
    """(4, 4), believed."""


@dataclass(frozen=True, slots=True)
class Interval:
    """A relation held from `start` to `end`."""

    relation: Relation
    start: int
    """Nanoseconds."""
    end: int


@dataclass(slots=True)
class RunRecord:
    """All that the report tells of."""

    scene: str
    seed: int
    static_map: StaticMap
    meshes: Mapping[str, Mesh]
    """Class name -> the tracker's model, object frame."""
    config: Mapping[str, object]
    start: int = 0
    """Nanoseconds: stamp of the first camera frame."""
    end: int = 0
    """Nanoseconds: stamp of the last camera frame."""
    partial: bool = False
    metrics: Metrics = field(default_factory=dict)
    stamps: Sequence[int] = ()
    estimated: Sequence[Float64] = ()
    """(4, 4) believed T_map_base, by stamp."""
    true: Sequence[Float64] = ()
    object_frames: Sequence[ObjectFrame] = ()
    switches: Sequence[tuple[int, str]] = ()
    false_tracks: Mapping[int, int] = field(default_factory=dict)
    floor: Mapping[bool, Sequence[float]] = field(default_factory=dict)
    """Moving? -> translation errors of the registration started from the truth, metres."""
    stage_seconds: Mapping[str, Sequence[float]] = field(default_factory=dict)
    key_frames: Sequence[KeyFrame] = ()
    worst: Sequence[KeyFrame] = ()
    """Frames with the largest errors of tracked objects, the largest first."""
    query_frame: KeyFrame | None = None
    """A frame in which relations can be shown."""
    camera: CameraPicture | None = None
    lidar: LidarPicture | None = None
    believed_relations: Sequence[Interval] = ()


def worst_object(frame: KeyFrame) -> ObjectFrame | None:
    """The scored and tracked object with the largest translation error."""
    candidates = [o for o in frame.objects if o.scored and o.track is not None]
    return max(candidates, key=lambda o: o.translation_error, default=None)


class Album:
    """Chooses the frames that the report shows while the run goes on; keeps a dozen images, never all."""

    def __init__(self, start: int, duration: float) -> None:
        """`start` in nanoseconds, `duration` in seconds."""
        step = duration / KEY_FRAMES * NANOSECONDS
        self._due = [start + round((k + 0.5) * step) for k in range(KEY_FRAMES)]
        self.key_frames: list[KeyFrame] = []
        self.worst: list[KeyFrame] = []
        self.query_frame: KeyFrame | None = None
        self._query_score = 0.0
        self.camera: CameraPicture | None = None
        self._camera_score = -1.0
        self.lidar: LidarPicture | None = None
        self._lidar_score = -1

    def see(self, frame: RgbdFrame, belief: Belief, objects: Sequence[ObjectFrame]) -> None:
        """Take one camera frame."""
        if frame.rgb is not None:
            self._see_colour(frame, belief, tuple(objects))

    def see_unknown(self, frame: RgbdFrame, belief: Belief) -> None:
        """Take the camera frame whose pre-segmentation a belief brings."""
        result = belief.camera
        if result is None or not result.valid or result.unknown.shape != frame.depth.shape:
            return
        # A frame tells most in which much is known and some clusters are left; colour decides between equals.
        tracked = sum(track.believed and track.visible_fraction > VISIBLE for track in belief.tracks)
        score = 10 * tracked + len(result.regions) + (0.5 if frame.rgb is not None else 0.0)
        if score > self._camera_score:
            jpeg = None if frame.rgb is None else encode_jpeg(frame.rgb)
            self.camera = CameraPicture(frame.stamp, frame.depth.copy(), result.unknown.copy(), jpeg)
            self._camera_score = score

    def see_lidar(self, stamp: int, points: Float32, unknown: Bool, T_map_base: Float64) -> None:
        """Take one scan as (N, 3) points in the map with its (N,) pre-segmentation."""
        if (score := int(np.count_nonzero(unknown))) > self._lidar_score:
            self.lidar = LidarPicture(stamp, np.asarray(points, dtype=np.float32), unknown.copy(), T_map_base)
            self._lidar_score = score

    def _see_colour(self, frame: RgbdFrame, belief: Belief, objects: tuple[ObjectFrame, ...]) -> None:
        image: list[KeyFrame] = []

        def picture() -> KeyFrame:
            if not image:
                image.append(_key_frame(frame, belief, objects))
            return image[0]

        if self._due and frame.stamp >= self._due[0]:
            while self._due and frame.stamp >= self._due[0]:
                self._due.pop(0)
            self.key_frames.append(picture())
        score = _query_score(belief)
        if score > self._query_score:
            self.query_frame, self._query_score = picture(), score
        error = max((o.translation_error for o in objects if o.scored and o.track is not None), default=0.0)
        if error > 0.0 and (len(self.worst) < WORST_MOMENTS or error > self._error(self.worst[-1])):
            self._keep_worst(error, frame.stamp, picture)

    def _keep_worst(self, error: float, stamp: int, picture: Callable[[], KeyFrame]) -> None:
        near = [w for w in self.worst if abs(w.stamp - stamp) < WORST_APART * NANOSECONDS]
        if any(self._error(w) >= error for w in near):
            return
        kept = [w for w in self.worst if all(w is not n for n in near)]
        self.worst = sorted([*kept, picture()], key=self._error, reverse=True)[:WORST_MOMENTS]

    @staticmethod
    def _error(frame: KeyFrame) -> float:
        thing = worst_object(frame)
        return 0.0 if thing is None else thing.translation_error


class RelationTimeline:
    """Turns sets of relations that hold now into intervals."""

    def __init__(self) -> None:
        self._open: dict[Relation, int] = {}
        self._closed: list[Interval] = []
        self._last = 0

    def observe(self, stamp: int, relations: frozenset[Relation]) -> None:
        """Take the relations that hold at one stamp."""
        for relation in [r for r in self._open if r not in relations]:
            self._closed.append(Interval(relation, self._open.pop(relation), stamp))
        for relation in relations:
            self._open.setdefault(relation, stamp)
        self._last = stamp

    def intervals(self) -> list[Interval]:
        """All intervals so far, by start, relations that still hold included."""
        still = [Interval(relation, start, self._last) for relation, start in self._open.items()]
        return sorted([*self._closed, *still], key=_interval_order)


def _interval_order(interval: Interval) -> tuple[int, int, str, str, str]:
    relation = interval.relation
    return interval.start, interval.end, relation.subject, relation.name, relation.reference


def encode_jpeg(rgb: np.ndarray, quality: int = 88) -> bytes:
    """(H, W, 3) RGB as JPEG."""
    import cv2

    good, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert good, "JPEG encoding of an 8-bit image cannot fail"
    return data.tobytes()


def _key_frame(frame: RgbdFrame, belief: Belief, objects: tuple[ObjectFrame, ...]) -> KeyFrame:
    assert frame.rgb is not None
    return KeyFrame(
        frame.stamp, encode_jpeg(frame.rgb), frame.intrinsics, belief.T_map_camera, belief.tracks,
        frozenset(belief.relations), objects,
    )  # fmt: skip


def graph_name(track: Track) -> str:
    """Name of a track's entity in the scene graph."""
    return f"{track.class_name}-{track.id}"


def _query_score(belief: Belief) -> float:
    """How much there is to show of `on` and `left-of` between tracks that are well seen."""
    seen = {graph_name(t) for t in belief.tracks if t.believed and t.visible_fraction > 0.5}
    counts: defaultdict[tuple[str, str], int] = defaultdict(int)
    for subject in seen:
        for relation in about(belief.relations, subject):
            if relation.name in ("on", "left-of") and relation.reference in seen:
                counts[relation.name, relation.reference] += 1
    on = max((n for (name, _), n in counts.items() if name == "on"), default=0)
    left = max((n for (name, _), n in counts.items() if name == "left-of"), default=0)
    return 3.0 * min(on, 2) + min(left, 3) + 0.1 * len(seen) * (on + left > 0)
