"""Large buildings and surveys on disk: what takes seconds to make is made once a version, seed and configuration."""

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from simtrack import paths
from simtrack.contracts import Float64, MapEntity, Room, StaticMap
from simtrack.geometry.meshes import Mesh
from simtrack.objects.cache import UNUSABLE, open_arrays, write_arrays
from simtrack.simulation.building.parts import StaticPart, StaticWorld

_log = logging.getLogger("simtrack.cache")
Arrays: TypeAlias = dict[str, np.ndarray]
Posed: TypeAlias = Sequence[tuple[Float64, Float64]]
"""(T (4, 4), size (k,)) pairs: supports or collision boxes."""


def digest(*content: object) -> str:
    """Key of cached content: its hash together with the code and the libraries that make buildings and surveys."""
    sha = hashlib.sha256()
    rooms = Path(__file__).resolve().parent
    for source in sorted(
        [*rooms.glob("*.py"), *rooms.parent.glob("*survey.py"), *rooms.parent.glob("retessellation.py")]
    ):
        sha.update(source.read_bytes())
    sha.update((rooms.parents[1] / "geometry" / "meshes.py").read_bytes())
    for library in ("numpy", "scipy", "shapely", "manifold3d", "opencv-python-headless", "fast-simplification"):
        sha.update(version(library).encode())
    for part in content:
        data = part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode()
        sha.update(len(data).to_bytes(8, "little") + data)
    return sha.hexdigest()[:24]


def world_digest(world: StaticWorld, *content: object) -> str:
    """Key of what is made from a world: all that it consists of, and `content`."""
    arrays = _pack_world(world)
    return digest(*(arrays[name] for name in sorted(arrays)), *content)


def cached_world(key: str, build: Callable[[], StaticWorld]) -> StaticWorld:
    """The world kept under `key`, else built and kept; a cache that cannot be used is no error."""
    path = paths.cache_dir() / "buildings" / f"{key}.npz"
    with suppress(*UNUSABLE):
        return _unpack_world(_read(path))
    _log.info("building the office floor")
    world = build()
    with suppress(OSError):
        write_arrays(path, _pack_world(world))
    return world


def cached_map(key: str, build: Callable[[], StaticMap]) -> StaticMap:
    """The survey kept under `key`, else made and kept; a cache that cannot be used is no error."""
    path = paths.cache_dir() / "surveys" / f"{key}.npz"
    with suppress(*UNUSABLE):
        return unpack_map(_read(path))
    _log.info("surveying the building")
    static_map = build()
    with suppress(OSError):
        write_arrays(path, pack_map(static_map))
    return static_map


def _read(path: Path) -> Arrays:
    with open_arrays(path) as data:
        return dict(data)


# ----------------------------------------------------------------------------------------- ragged lists as flat arrays


def _pack_posed(label: str, lists: Sequence[Posed], width: int) -> Arrays:
    flat = [pair for pairs in lists for pair in pairs]
    return {
        f"{label}.counts": np.array([len(pairs) for pairs in lists], np.int64),
        f"{label}.T": np.array([T for T, _ in flat]).reshape(-1, 4, 4),
        f"{label}.size": np.array([size for _, size in flat]).reshape(-1, width),
    }


def _unpack_posed(arrays: Arrays, label: str) -> list[tuple[tuple[Float64, Float64], ...]]:
    pairs = list(zip(arrays[f"{label}.T"], arrays[f"{label}.size"], strict=True))
    return [tuple(pairs[a:b]) for a, b in _slices(arrays[f"{label}.counts"])]


def _slices(counts: np.ndarray) -> list[tuple[int, int]]:
    ends = np.cumsum(counts)
    return list(zip((ends - counts).tolist(), ends.tolist(), strict=True))


def _pack_text(values: Any) -> np.ndarray:
    return np.frombuffer(json.dumps(values).encode(), np.uint8)


def _unpack_text(array: np.ndarray) -> Any:
    return json.loads(array.tobytes())


def _pack_rooms(rooms: Sequence[Room]) -> Arrays:
    return {
        "rooms.text": _pack_text([(room.name, room.floor, room.height) for room in rooms]),
        "rooms.counts": np.array([len(room.polygon) for room in rooms], np.int64),
        "rooms.points": np.concatenate([room.polygon for room in rooms]) if rooms else np.empty((0, 2)),
    }


def _unpack_rooms(arrays: Arrays) -> tuple[Room, ...]:
    slices = _slices(arrays["rooms.counts"])
    return tuple(
        Room(name, arrays["rooms.points"][a:b], floor, height)
        for (name, floor, height), (a, b) in zip(_unpack_text(arrays["rooms.text"]), slices, strict=True)
    )


def _pack_world(world: StaticWorld) -> Arrays:
    parts, meshes = world.parts, [part.mesh for part in world.parts]
    colors = [m.face_colors if m.face_colors is not None else np.full(m.faces.shape, 160, np.uint8) for m in meshes]
    return {
        "text": _pack_text([(p.name, p.semantic_class, p.room, p.survey, p.group) for p in parts]),
        "T": np.array([part.T_map_part for part in parts]),
        "extents": np.array([part.extents for part in parts]),
        "vertices": np.concatenate([mesh.vertices for mesh in meshes]),
        "faces": np.concatenate([mesh.faces for mesh in meshes]),
        "colors": np.concatenate(colors),
        "vertices.counts": np.array([len(mesh.vertices) for mesh in meshes], np.int64),
        "faces.counts": np.array([len(mesh.faces) for mesh in meshes], np.int64),
        **_pack_posed("supports", [part.supports for part in parts], 2),
        **_pack_posed("collision", [part.collision for part in parts], 3),
        **_pack_rooms(world.rooms),
    }


def _unpack_world(arrays: Arrays) -> StaticWorld:
    vertices, faces = _slices(arrays["vertices.counts"]), _slices(arrays["faces.counts"])
    supports, collision = _unpack_posed(arrays, "supports"), _unpack_posed(arrays, "collision")
    parts = []
    for k, (name, semantic_class, room, survey, group) in enumerate(_unpack_text(arrays["text"])):
        own_vertices, own_faces = slice(*vertices[k]), slice(*faces[k])
        parts.append(
            StaticPart(
                name=name,
                semantic_class=semantic_class,
                mesh=Mesh(arrays["vertices"][own_vertices], arrays["faces"][own_faces], arrays["colors"][own_faces]),
                T_map_part=arrays["T"][k],
                extents=arrays["extents"][k],
                supports=supports[k],
                room=room,
                survey=survey,
                collision=collision[k],
                group=group,
            )
        )
    return StaticWorld(tuple(parts), _unpack_rooms(arrays))


def pack_map(static_map: StaticMap) -> Arrays:
    """A survey as named arrays, without its articulations."""
    entities = static_map.entities
    return {
        "text": _pack_text([(e.name, e.semantic_class, e.room) for e in entities]),
        "T": np.array([entity.T_map_entity for entity in entities]).reshape(-1, 4, 4),
        "extents": np.array([entity.extents for entity in entities]).reshape(-1, 3),
        "vertices": static_map.vertices,
        "faces": static_map.faces,
        "noise": np.array(static_map.noise),
        **_pack_posed("supports", [entity.supports for entity in entities], 2),
        **_pack_rooms(static_map.rooms),
    }


def unpack_map(arrays: Arrays) -> StaticMap:
    """The survey that `pack_map` packed; KeyError or ValueError if it is something else."""
    supports = _unpack_posed(arrays, "supports")
    entities = tuple(
        MapEntity(name, semantic_class, arrays["T"][k], arrays["extents"][k], room, supports[k])
        for k, (name, semantic_class, room) in enumerate(_unpack_text(arrays["text"]))
    )
    rooms = _unpack_rooms(arrays)
    return StaticMap(arrays["vertices"], arrays["faces"], entities, rooms, float(arrays["noise"]))
