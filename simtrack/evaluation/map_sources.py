"""What a panoptic map is made from: a room that is filmed, or a recording of an RGB-D camera."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from simtrack.contracts import Float64, Int32, RgbdFrame
from simtrack.errors import InvalidValueError
from simtrack.perception.mapping.odometry.rgbd_odometry import RgbdOdometry
from simtrack.perception.segmentation.loading import ALLOWED, LEARNED, make_segmenter
from simtrack.perception.segmentation.panoptic import PanopticSegments, Segmenter
from simtrack.simulation.building.rooms.film import FilmConfig, FilmFrame, RoomFilm
from simtrack.simulation.building.rooms.physics import SettledRoom
from simtrack.simulation.building.rooms.plan import RoomKind, kind_of
from simtrack.simulation.oracles.camera_poses import NoisyPoses
from simtrack.simulation.oracles.segmenter import OracleSegmenter
from simtrack.simulation.scene_file import load_scene

ORACLE, NONE = "oracle", "none"
Poses: TypeAlias = Literal["true", "estimated", "noisy"]


class NoSegmenter:
    """Finds nothing: the map is one of geometry alone."""

    def segment(self, frame: RgbdFrame) -> PanopticSegments:
        """No segments."""
        return PanopticSegments(frame.stamp, np.zeros(frame.depth.shape, np.int32), (), np.zeros(0, np.float32))


@dataclass(frozen=True, slots=True)
class MapFrame:
    """One frame of a source."""

    frame: RgbdFrame
    T_map_camera: Float64 | None
    """(4, 4), or None where the source does not say."""
    truth: FilmFrame | None = None
    """What was truly seen, where that is known."""


class LatestLabels:
    """True labels of the frame that was shown last: what an oracle looks up."""

    def __init__(self) -> None:
        self._stamp, self._image = -1, np.zeros((0, 0), np.int32)

    def show(self, truth: FilmFrame) -> None:
        """Take a frame."""
        self._stamp, self._image = truth.frame.stamp, truth.instances

    def __call__(self, stamp: int) -> Int32:
        """Labels (H, W) of the frame of that stamp; InvalidValueError for another than the last."""
        if stamp != self._stamp:
            raise InvalidValueError("stamp", stamp, f"that of the latest frame, {self._stamp}")
        return self._image


@dataclass(frozen=True, slots=True)
class MapSource:
    """Frames with poses, and a segmenter for them."""

    name: str
    """Fit for a file's name."""
    count: int
    """Frames."""
    frames: Callable[[], Iterator[MapFrame]]
    """Anew at each call."""
    segmenter: Segmenter
    room: SettledRoom | None = None
    """The truth, where it is known."""
    held: AbstractContextManager[object] = field(default_factory=nullcontext)
    """What must be released afterwards."""

    @property
    def failures(self) -> Mapping[str, int]:
        """Why a segmentation service failed, and on how many frames."""
        return getattr(self.segmenter, "failures", {})


def room_source(
    seed: int,
    kind: RoomKind | None = None,
    film: FilmConfig | None = None,
    strength: float = 1.0,
    film_seed: int = 0,
    name: str | None = None,
) -> MapSource:
    """A settled room as somebody films it, segmented by an oracle.

    Args:
        seed: of the room.
        kind: of the room; drawn from the seed if None.
        film: how it is filmed.
        strength: of the oracle's errors.
        film_seed: of the walk, the noise and the errors.
        name: of the source.
    """
    from simtrack.simulation.building.rooms.physics import settled_room

    OracleSegmenter(LatestLabels(), (), strength)  # refuses bad values before a room is built
    room = settled_room(seed, kind)
    shot = RoomFilm(room, film, film_seed)
    labels = LatestLabels()
    error_seed = int(np.random.SeedSequence([film_seed, seed, 0x45727273]).generate_state(1)[0])  # of each room its own
    oracle = OracleSegmenter(labels, [e.semantic_class for e in room.entities], strength, error_seed)

    def frames() -> Iterator[MapFrame]:
        for seen in shot:
            labels.show(seen)
            yield MapFrame(seen.frame, seen.T_map_camera, seen)

    return MapSource(name or f"rooms-{seed}", len(shot), frames, oracle, room, shot)


def with_poses(source: MapSource, poses: Poses, seed: int = 0) -> MapSource:
    """A source whose camera poses are estimated.

    The map's frame is fixed to the first pose that the source states; it is the origin if it states none.

    Args:
        source: of the frames.
        poses: ``true`` as the source states them; ``estimated`` by RGB-D odometry from the images alone; ``noisy``, the
            stated ones with the errors of a SLAM system.
        seed: of those errors.
    """
    if poses == "true":
        return source

    def estimated() -> Iterator[MapFrame]:
        odometry: RgbdOdometry | None = None
        for entry in source.frames():
            odometry = odometry or RgbdOdometry(entry.T_map_camera)
            yield replace(entry, T_map_camera=odometry.update(entry.frame).T_map_camera)

    def noisy() -> Iterator[MapFrame]:
        oracle = NoisyPoses(np.random.default_rng([seed, 0x504F5345]))
        for entry in source.frames():
            T = entry.T_map_camera
            yield replace(entry, T_map_camera=None if T is None else oracle.pose(entry.frame.stamp, T))

    return replace(source, frames=estimated if poses == "estimated" else noisy)


def map_source(
    source: str,
    segmenter: str | None = None,
    film: FilmConfig | None = None,
    strength: float = 1.0,
    seed: int = 0,
    poses: Poses = "true",
) -> MapSource:
    """The source that a user names.

    Args:
        source: a furnished room (``rooms:7``), or a recording of an RGB-D camera with poses.
        segmenter: ``oracle``, ``none``, or what `simtrack.perception.segmentation.loading.make_segmenter` takes; if
            None, the oracle for rooms and none for recordings.
        film: how a room is filmed; of a recording, the first `FilmConfig.frames` frames are taken.
        strength: of the oracle's errors.
        seed: of a scene whose name fixes none, of the walk and of the errors.
        poses: of the camera, see `with_poses`.

    Raises:
        UnknownNameError: no such scene.
        FileFormatError: a recording that is none.
        InvalidValueError: it is no room or has no poses, or the oracle is asked about a recording.
        StageError: no such segmenter, or its service does not answer.
    """
    path, film = Path(source), film or FilmConfig()
    if path.exists() and not (path / "scene.yaml").is_file() and path.suffix not in (".yaml", ".yml", ".xml"):
        if segmenter == ORACLE:
            raise InvalidValueError("segmenter", segmenter, f"another: nobody knows what {source} truly shows")
        return with_poses(_recording(path, film, _segmenter(segmenter or NONE), poses != "estimated"), poses, seed)
    scene = load_scene(source)
    if scene.static.builder != "room":
        raise InvalidValueError("source", source, "a furnished room such as rooms:7, or a folder of RGB-D images")
    number = scene.static.seed if scene.static.seed is not None else seed
    kind = kind_of(scene.static.config)
    chosen = opened_segmenter(segmenter or ORACLE)  # before a room is built
    made = room_source(number, kind, film, strength, seed, f"{scene.name}-{number}")
    return with_poses(made if chosen is None else replace(made, segmenter=chosen), poses, seed)


def opened_segmenter(given: str) -> Segmenter | None:
    """The segmenter that is named as for `map_source`; None for the oracle, which belongs to a room."""
    return None if given == ORACLE else _segmenter(given)


def _segmenter(given: str) -> Segmenter:
    if given == NONE:
        return NoSegmenter()
    if not (given == LEARNED or ":" in given or given.endswith(".onnx") or Path(given).is_dir()):
        raise InvalidValueError("segmenter", given, f"{ORACLE}, {NONE}, {ALLOWED}")
    return make_segmenter(given)


def _recording(path: Path, film: FilmConfig, segmenter: Segmenter, posed: bool) -> MapSource:
    from itertools import islice

    from simtrack.recordings.source import open_log

    log = open_log(path)
    if log.sensor != "camera" or (posed and not log.posed):
        allowed = "a recording of an RGB-D camera" + (" that states the camera's poses, or --poses estimated" * posed)
        raise InvalidValueError("source", str(path), allowed)
    count = film.frames if log.count is None else min(film.frames, log.count)

    def frames() -> Iterator[MapFrame]:
        for entry in islice(log.read(), count):
            if isinstance(entry.frame, RgbdFrame):
                yield MapFrame(entry.frame, entry.T_map_sensor)

    return MapSource(path.resolve().name, count, frames, segmenter)
