"""A small laboratory and objects to stand in it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from simtrack.contracts import Float64, MapEntity, Room, StaticMap, Track, TrackStatus
from simtrack.geometry.transforms import transform

BENCH_TOP = 0.8


@dataclass(frozen=True)
class Grid:
    """A mesh."""

    vertices: Float64
    faces: np.ndarray


@dataclass(frozen=True)
class Model:
    """The least that a scene graph needs of an object model."""

    semantic_class: str
    extents: Float64
    mesh: Grid | None = None


def box_faces(centre: Float64, extents: Float64) -> Grid:
    corners = np.array([[(i >> k & 1) - 0.5 for k in range(3)] for i in range(8)]) * extents + centre
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return Grid(corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]))


def joined(parts: list[Grid]) -> Grid:
    starts = np.cumsum([0, *(len(p.vertices) for p in parts[:-1])])
    faces = np.concatenate([p.faces + s for p, s in zip(parts, starts, strict=True)])
    return Grid(np.concatenate([p.vertices for p in parts]), faces)


def open_box(extents: Float64, wall: float, floor: float) -> Grid:
    """A box without lid: floor and four walls."""
    x, y, z = extents
    parts = [box_faces(np.array([0, 0, 0.5 * (floor - z)]), np.array([x, y, floor]))]
    for sign in (-1.0, 1.0):
        parts.append(box_faces(np.array([sign * 0.5 * (x - wall), 0, 0]), np.array([wall, y, z])))
        parts.append(box_faces(np.array([0, sign * 0.5 * (y - wall), 0]), np.array([x, wall, z])))
    return joined(parts)


TUB = np.array([0.4, 0.3, 0.15])
MODELS = {
    "relay": Model("component", np.array([0.08, 0.06, 0.05])),
    "multimeter": Model("multimeter", np.array([0.1, 0.2, 0.05])),
    "tray": Model("container", np.array([0.4, 0.3, 0.03])),
    "tub": Model("container", TUB, open_box(TUB, wall=0.006, floor=0.01)),
}


@pytest.fixture(scope="session")
def static_map() -> StaticMap:
    bench = MapEntity(
        name="workbench",
        semantic_class="table",
        T_map_entity=transform(None, (0.0, 0.0, 0.5 * BENCH_TOP)),
        extents=np.array([1.0, 2.0, BENCH_TOP]),
        room="lab",
        supports=((transform(None, (0.0, 0.0, BENCH_TOP)), np.array([1.0, 2.0])),),
    )
    shelf = MapEntity(
        name="shelf",
        semantic_class="shelf",
        T_map_entity=transform(None, (-2.0, 0.0, 1.0)),
        extents=np.array([0.4, 1.0, 2.0]),
        supports=tuple((transform(None, (-2.0, 0.0, z)), np.array([0.4, 1.0])) for z in (0.5, 1.0, 1.5, 2.0)),
    )
    floor = MapEntity(
        name="floor",
        semantic_class="floor",
        T_map_entity=transform(None, (0.0, 0.0, -0.05)),
        extents=np.array([8.0, 6.0, 0.1]),
        supports=((np.eye(4), np.array([8.0, 6.0])),),
    )
    lab = Room("lab", np.array([[-4.0, -3.0], [2.0, -3.0], [2.0, 3.0], [-4.0, 3.0]]))
    hall = Room("hall", np.array([[2.0, -3.0], [4.0, -3.0], [4.0, 3.0], [2.0, 3.0]]))
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    return StaticMap(*nothing, entities=(bench, shelf, floor), rooms=(lab, hall))


def make_track(
    class_name: str,
    number: int,
    T_map_object: Float64,
    stamp: int,
    *,
    seen: bool = True,
    status: TrackStatus = TrackStatus.CONFIRMED,
) -> Track:
    return Track(
        id=number,
        class_name=class_name,
        status=status if seen else TrackStatus.OCCLUDED,
        stamp=stamp,
        T_map_object=T_map_object,
        covariance=np.eye(6) * 1e-6,
        T_camera_object=np.eye(4),
        velocity=np.zeros(6),
        last_seen=stamp if seen else 0,
        visible_fraction=1.0 if seen else 0.0,
        moving=False,
        residual=0.0,
        score=1.0,
    )


@pytest.fixture(scope="session")
def models() -> dict[str, Model]:
    return dict(MODELS)


@pytest.fixture(scope="session")
def track() -> Callable[..., Track]:
    return make_track
