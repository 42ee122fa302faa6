"""Labelled images for panoptic segmenters: furnished rooms as somebody with a handheld RGB-D camera films them.

films.json                    what the set consists of: sensors, size of the images, rooms
rooms/SEED/room.json          class of every entity of the room, and the intrinsics of its images
rooms/SEED/NNNN.jpg           colour
rooms/SEED/NNNN.depth.png     16 bit, millimetres, 0 = no reading, with the sensor's noise
rooms/SEED/NNNN.segments.png  16 bit, 1 + number of the entity that is seen, 0 = nothing

Rooms are written one by one under another name, then renamed: a stopped run carries on, and readers see whole rooms.
"""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float32, Int32, Uint8
from simtrack.errors import DatasetError, FileFormatError, InvalidValueError
from simtrack.perception.segmentation.frames import reduced_frame
from simtrack.recordings.files import decoded_image, read_bytes, read_depth, read_rgb

NAME = "rooms_panoptic"
ABOUT, ROOMS, ROOM = "films.json", "rooms", "room.json"
FIRST_SEED = 1_000_000
"""Rooms of lower seeds, as those of evaluations, are in no training set."""
MOST_IMAGES = 1_000_000
_MILLIMETRES = 1000.0
_SENSORS = ("xtion", "kinect_v2")


@dataclass(frozen=True, slots=True)
class RoomFilmsConfig:
    """What a set consists of."""

    images: int = 3000
    """Rounded up to whole rooms."""
    a_room: int = 30
    """Images of a room."""
    reduction: int = 2
    """Each so many-th row and column of the sensor's image is kept; colours are means."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name, most in (("images", MOST_IMAGES), ("a_room", 10_000), ("reduction", 8)):
            if not 1 <= getattr(self, name) <= most:
                raise InvalidValueError(f"RoomFilmsConfig.{name}", getattr(self, name), f"1 to {most}")
        if not 0 <= self.seed <= 10_000:
            raise InvalidValueError("RoomFilmsConfig.seed", self.seed, "0 to 10000")

    @property
    def rooms(self) -> range:
        """Seeds of the rooms."""
        first = FIRST_SEED + self.seed * MOST_IMAGES
        return range(first, first - (-self.images // self.a_room))


@dataclass(frozen=True, slots=True, eq=False)
class FilmedImage:
    """One labelled image."""

    rgb: Uint8
    """(H, W, 3)."""
    depth: Float32
    """(H, W), metres, 0 = no reading."""
    entities: Int32
    """(H, W), number of the entity that is seen, -1 = nothing."""
    intrinsics: CameraIntrinsics
    classes: tuple[str, ...]
    """Semantic class of every entity of the room."""


def write_room_films(folder: Path, config: RoomFilmsConfig, told: Callable[[int, int], None] | None = None) -> int:
    """Film the rooms that are not there yet; returns how many images there are now.

    Raises:
        DatasetError: the folder holds something else.
    """
    about = folder / ABOUT
    mine = {"name": NAME, "a_room": config.a_room, "reduction": config.reduction, "seed": config.seed}
    if about.is_file():
        if json.loads(about.read_text(encoding="utf-8")) != mine:
            raise DatasetError(folder, f"{ABOUT} tells of a set with other settings; choose another --out")
    elif folder.exists() and any(folder.iterdir()):
        raise DatasetError(folder, "is not empty and no set of filmed rooms; choose another --out")
    (folder / ROOMS).mkdir(parents=True, exist_ok=True)
    about.write_text(json.dumps(mine) + "\n", encoding="utf-8")
    for number, seed in enumerate(config.rooms):
        if not (folder / ROOMS / str(seed)).is_dir():
            _write_room(folder / ROOMS, seed, config)
        if told is not None:
            told((number + 1) * config.a_room, len(config.rooms) * config.a_room)
    return len(config.rooms) * config.a_room


def _write_room(folder: Path, seed: int, config: RoomFilmsConfig) -> None:
    import cv2

    from simtrack.simulation.building.rooms.film import FilmConfig, RoomFilm
    from simtrack.simulation.building.rooms.physics import settled_room

    staged = folder / f".{seed}"
    shutil.rmtree(staged, ignore_errors=True)
    staged.mkdir()
    room = settled_room(seed)
    with RoomFilm(room, FilmConfig(frames=config.a_room, sensor=_SENSORS[seed % len(_SENSORS)]), config.seed) as film:
        intrinsics = None
        for number, seen in enumerate(film):
            small = reduced_frame(seen.frame, config.reduction)
            intrinsics, k = small.intrinsics, config.reduction
            entities = seen.instances[k // 2 :: k, k // 2 :: k][: intrinsics.height, : intrinsics.width]
            images = {
                ".jpg": cv2.cvtColor(np.asarray(small.rgb), cv2.COLOR_RGB2BGR),
                ".depth.png": np.rint(small.depth * _MILLIMETRES).astype(np.uint16),
                ".segments.png": (entities + 1).astype(np.uint16),
            }
            for suffix, image in images.items():
                done, data = cv2.imencode(suffix[suffix.rfind(".") :], image)
                if not done:
                    raise DatasetError(folder, f"an image of room {seed} could not be encoded")
                (staged / f"{number:04d}{suffix}").write_bytes(data.tobytes())
    classes = [entity.semantic_class for entity in room.entities]
    document = {"classes": classes, "intrinsics": asdict(intrinsics) if intrinsics is not None else None}
    (staged / ROOM).write_text(json.dumps(document) + "\n", encoding="utf-8")
    staged.rename(folder / str(seed))


def filmed_rooms(folder: Path) -> tuple[Path, ...]:
    """Folders of the rooms of a set, in the order of their seeds.

    Raises:
        DatasetError: it is no such set, or has no room.
    """
    if not (folder / ABOUT).is_file():
        raise DatasetError(folder, f"no {ABOUT}; expected a folder that `simtrack generate {NAME}` made")
    rooms = sorted((p for p in (folder / ROOMS).iterdir() if p.name.isdigit()), key=lambda p: int(p.name))
    if not rooms:
        raise DatasetError(folder, "has no complete room yet")
    return tuple(rooms)


def room_classes(room: Path) -> tuple[str, ...]:
    """Semantic class of every entity of a filmed room; FileFormatError if its file cannot be used."""
    return _described(room)[0]


def filmed_images(room: Path) -> Iterator[FilmedImage]:
    """The images of one filmed room; FileFormatError if a file is missing or damaged."""
    return (filmed_image(colour) for colour in sorted(room.glob("*.jpg")))


def filmed_image(colour: Path) -> FilmedImage:
    """The labelled image whose colours are in a file of a room's folder.

    Raises:
        FileFormatError: a file is missing or damaged.
    """
    classes, intrinsics = _described(colour.parent)
    rgb = np.asarray(read_rgb(colour), np.uint8)
    depth = np.asarray(read_depth(colour.with_suffix(".depth.png"), 1.0 / _MILLIMETRES), np.float32)
    path = colour.with_suffix(".segments.png")
    entities = decoded_image(read_bytes(path), path)
    shape = (intrinsics.height, intrinsics.width)
    if not rgb.shape[:2] == depth.shape == entities.shape == shape:
        raise FileFormatError(path, "", f"the images of {colour.stem} differ in size; expected {shape}")
    if int(entities.max()) > len(classes):
        raise FileFormatError(path, "", f"names entity {int(entities.max()) - 1} of {len(classes)}")
    return FilmedImage(rgb, depth, entities.astype(np.int32) - 1, intrinsics, classes)


def _described(room: Path) -> tuple[tuple[str, ...], CameraIntrinsics]:
    path = room / ROOM
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        return tuple(str(name) for name in document["classes"]), CameraIntrinsics(**document["intrinsics"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FileFormatError(path, "", f"expected an object with classes and intrinsics: {error}") from error
