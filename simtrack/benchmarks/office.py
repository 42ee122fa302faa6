"""The scene that ray casting is timed in: an office floor, five objects on a table, a camera and a lidar.

The floor has the size of the tracking paper's (2986.6 m2) and 411,698 triangles, the objects have exactly the face
counts of its Table I. Everything is panels: rectangles cut into a grid of one cell size, the size that comes nearest to
the asked number of faces from below, and a few faces split further until the number is exact. Inner vertices of the
floor are moved by 5 mm (one sigma) along the panel's normal, as reconstructed meshes are rough.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from simtrack.contracts import CameraIntrinsics, Float64, Int32
from simtrack.geometry.meshes import Mesh
from simtrack.geometry.transforms import look_at, transform_planar, transform_xyz_rpy
from simtrack.raycast import RayBundle, RayScene, TriangleMesh
from simtrack.sensors.lidar import VLP16

STATIC_FACES = 411_698
OBJECT_FACES = {"multimeter": 100_338, "screwdriver": 26_682, "materialbox": 13_617, "klt3147": 14_124, "relay": 9_312}
"""Table I of the tracking paper."""
CAMERA = CameraIntrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)

LENGTH, WIDTH, HEIGHT = 54.9, 2986.6 / 54.9, 3.0
"""Of the floor along x and y, and of its rooms, metres."""
_COLUMNS, _BANDS, _CORRIDOR, _WALL = 8, 5, 2.0, 0.12
_DOOR = 1.0, 2.1
_ROOM_X, _ROOM_Y = LENGTH / _COLUMNS, (WIDTH - (_BANDS - 1) * _CORRIDOR) / _BANDS
_TABLE = 2 * _ROOM_X + 0.5 * _ROOM_X, 3 * (_ROOM_Y + _CORRIDOR) + 0.55 * _ROOM_Y, 0.755
"""Where the objects lie: the middle of the top of a table, and 5 mm more so that its roughness stays below them."""
_ON_TABLE = {
    "multimeter": (-0.15, -0.18, 0.44),
    "screwdriver": (0.15, 0.15, -1.22),
    "materialbox": (-0.45, 0.10, 0.21),
    "klt3147": (0.50, 0.05, 1.66),
    "relay": (0.18, -0.20, 2.44),
}
"""x and y from the middle of the table, metres, and heading, radians."""


@dataclass(frozen=True, eq=False)
class Office:
    """The floor, what lies on one of its tables, and two sensors that see all of it."""

    static: Mesh
    """`STATIC_FACES` triangles, map frame."""
    objects: dict[str, Mesh]
    """By name, origin in the middle of the base; `OBJECT_FACES` triangles."""
    T_map_object: dict[str, Float64]
    """(4, 4), by name."""
    T_map_camera: Float64
    """(4, 4), optical frame."""
    T_map_lidar: Float64
    """(4, 4)."""

    @cached_property
    def meshes(self) -> dict[str, TriangleMesh]:
        """``static`` and the objects with their Embree hierarchies, by name."""
        shapes = {"static": self.static, **self.objects}
        return {name: TriangleMesh(mesh.vertices, mesh.faces, name) for name, mesh in shapes.items()}

    def scene(self) -> RayScene:
        """A new committed scene: instance 0 is the floor, 1 to 5 are the objects in the order of `objects`."""
        scene = RayScene()
        for name, mesh in self.meshes.items():
            scene.add(mesh, self.T_map_object.get(name))
        scene.commit()
        return scene

    def posed(self) -> list[Mesh]:
        """Floor and objects as meshes in the map frame, for engines without instances."""
        moved = [
            Mesh(mesh.vertices @ T[:3, :3].T + T[:3, 3], mesh.faces)
            for mesh, T in ((mesh, self.T_map_object[name]) for name, mesh in self.objects.items())
        ]
        return [self.static, *moved]


def office(seed: int = 7) -> Office:
    """The benchmark's scene; `seed` draws where the chairs stand and the surfaces' roughness."""
    rng = np.random.default_rng(seed)
    x, y, z = _TABLE
    eye = np.array([x + 0.05, y - 1.05, 1.30])
    return Office(
        static=_tessellated(_floor(rng), STATIC_FACES, 0.005, rng),
        objects={name: _tessellated(_OBJECTS[name](), faces, 0.0002, rng) for name, faces in OBJECT_FACES.items()},
        T_map_object={name: _at(transform_planar(x + dx, y + dy, yaw), z) for name, (dx, dy, yaw) in _ON_TABLE.items()},
        T_map_camera=look_at(eye, np.array([x, y, 0.78])),
        T_map_lidar=transform_xyz_rpy((x + 0.2, y - 1.6, 1.05), (0.0, 0.0, 0.3)),
    )


def pinhole() -> RayBundle:
    """The camera's 307,200 rays; distances along them are depths."""
    return RayBundle.from_camera(CAMERA)


def vlp16() -> RayBundle:
    """The 1824 x 16 rays of a VLP-16 turn as drivers pack it, in firing order, traced ring by ring."""
    shots = VLP16.shots(columns=VLP16.driver_columns)
    return RayBundle.from_directions(shots.directions, groups=shots.rings)


# ------------------------------------------------------------------------------------------------------------- panels


class _Panels:
    """Rectangles, each an origin and two sides; the normal is the first side cross the second."""

    def __init__(self) -> None:
        self.rectangles: list[tuple[Float64, Float64, Float64]] = []

    def add(self, origin: tuple[float, ...], side_a: tuple[float, ...], side_b: tuple[float, ...]) -> None:
        self.rectangles.append((np.array(origin), np.array(side_a), np.array(side_b)))

    def box(self, low: tuple[float, ...], high: tuple[float, ...], open_sides: str = "") -> "_Panels":
        """Sides of an axis-aligned box; `open_sides` of ``-z +z`` are left out."""
        dx, dy, dz = (b - a for a, b in zip(low, high, strict=True))
        x, y, z = (dx, 0.0, 0.0), (0.0, dy, 0.0), (0.0, 0.0, dz)
        self.add(low, z, y)
        self.add((high[0], low[1], low[2]), y, z)
        self.add(low, x, z)
        self.add((low[0], high[1], low[2]), z, x)
        if "-z" not in open_sides:
            self.add(low, y, x)
        if "+z" not in open_sides:
            self.add((low[0], low[1], high[2]), x, y)
        return self

    @property
    def lengths(self) -> Float64:
        """(K, 2), of the sides, metres."""
        return np.linalg.norm([(a, b) for _, a, b in self.rectangles], axis=2)

    def mesh(self, cells: npt.NDArray[np.int64], roughness: float, rng: np.random.Generator) -> tuple[Float64, Int32]:
        """Vertices and faces; inner vertices of a panel are off its plane by `roughness` metres (one sigma)."""
        vertices, faces, first = [], [], 0
        for (origin, a, b), (m, n) in zip(self.rectangles, cells, strict=True):
            i, j = (grid.ravel() for grid in np.meshgrid(np.arange(m + 1), np.arange(n + 1), indexing="ij"))
            inner = (i > 0) & (i < m) & (j > 0) & (j < n)
            normal = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
            height = roughness * rng.standard_normal(len(i)) * inner
            vertices.append(origin + (i / m)[:, None] * a + (j / n)[:, None] * b + height[:, None] * normal)
            corner = first + (np.arange(m)[:, None] * (n + 1) + np.arange(n)).ravel()
            right, up, across = corner + n + 1, corner + 1, corner + n + 2
            faces += [np.stack([corner, right, across], axis=1), np.stack([corner, across, up], axis=1)]
            first += len(i)
        return np.concatenate(vertices), np.concatenate(faces).astype(np.int32)


def _tessellated(panels: _Panels, faces: int, roughness: float, rng: np.random.Generator) -> Mesh:
    """Mesh of exactly `faces` triangles."""
    fine, coarse, lengths = 1e-5, 10.0, panels.lengths
    for _ in range(60):
        middle = 0.5 * (fine + coarse)
        if 2 * _cells(lengths, middle).prod(axis=1).sum() > faces:
            fine = middle
        else:
            coarse = middle
    vertices, triangles = panels.mesh(_cells(lengths, coarse), roughness, rng)
    return _split(vertices, triangles, faces - len(triangles), rng)


def _cells(lengths: Float64, size: float) -> npt.NDArray[np.int64]:
    """(K, 2), cells of at most `size` metres along the sides of every panel."""
    return np.maximum(1, np.ceil(lengths / size - 1e-9)).astype(np.int64)


def _split(vertices: Float64, faces: Int32, more: int, rng: np.random.Generator) -> Mesh:
    """Cut faces at their centroids, two more faces each, and at the middle of an edge if one is still missing."""
    chosen = rng.permutation(len(faces))[: (more + 1) // 2]
    a, b, c = faces[chosen].T
    new = len(vertices) + np.arange(len(chosen), dtype=np.int32)
    points = vertices[faces[chosen]].mean(axis=1)
    pieces = np.stack([[a, b, new], [b, c, new], [c, a, new]], axis=0).transpose(0, 2, 1)
    if more % 2:
        points[-1] = 0.5 * (vertices[a[-1]] + vertices[b[-1]])
        pieces[0, -1] = a[-1], new[-1], c[-1]
        pieces[1, -1] = new[-1], b[-1], c[-1]
    out = faces.copy()
    out[chosen] = pieces[0]
    added = pieces[1:].reshape(-1, 3)
    return Mesh(np.concatenate([vertices, points]), np.concatenate([out, added[: len(added) - more % 2]]))


def _at(T: Float64, height: float) -> Float64:
    T[2, 3] = height
    return T


# ----------------------------------------------------------------------------------------------------------- the floor


def _floor(rng: np.random.Generator) -> _Panels:
    """Five bands of eight rooms with four corridors between them."""
    panels = _Panels()
    panels.add((0.0, 0.0, 0.0), (LENGTH, 0.0, 0.0), (0.0, WIDTH, 0.0))
    panels.add((0.0, 0.0, HEIGHT), (0.0, WIDTH, 0.0), (LENGTH, 0.0, 0.0))
    for edge in (0.0, WIDTH):
        _wall(panels, 0, (0.0, edge), LENGTH, [])
    for edge in (0.0, LENGTH):
        _wall(panels, 1, (edge, 0.0), WIDTH, [])
    doors = [_ROOM_X * (column + 0.5) for column in range(_COLUMNS)]
    for band in range(_BANDS):
        south = band * (_ROOM_Y + _CORRIDOR)
        if band > 0:
            _wall(panels, 0, (0.0, south), LENGTH, doors)
        if band < _BANDS - 1:
            _wall(panels, 0, (0.0, south + _ROOM_Y), LENGTH, doors)
        for column in range(_COLUMNS):
            if column > 0:
                connected = (column + band) % 2
                _wall(panels, 1, (column * _ROOM_X, south), _ROOM_Y, [0.3 * _ROOM_Y] if connected else [])
            _furnish(panels, column * _ROOM_X, south, rng)
    return panels


def _wall(panels: _Panels, axis: int, start: tuple[float, float], length: float, doors: list[float]) -> None:
    """Wall along x (0) or y (1), with openings whose middles are `doors` metres from its start."""
    edges = [0.0, *(edge for door in doors for edge in (door - 0.5 * _DOOR[0], door + 0.5 * _DOOR[0])), length]
    for piece, (begin, end) in enumerate(pairwise(edges)):
        bottom = _DOOR[1] if piece % 2 else 0.0
        low, high = list(start), list(start)
        low[axis], high[axis] = start[axis] + begin, start[axis] + end
        low[1 - axis], high[1 - axis] = start[1 - axis] - 0.5 * _WALL, start[1 - axis] + 0.5 * _WALL
        panels.box((*low, bottom), (*high, HEIGHT), open_sides="+z" if piece % 2 else "-z +z")


def _furnish(panels: _Panels, west: float, south: float, rng: np.random.Generator) -> None:
    """Two tables, a shelf, a cupboard and three chairs."""
    _table(panels, west + 0.5 * _ROOM_X, south + 0.55 * _ROOM_Y, 1.8, 0.8, 0.75)
    _table(panels, west + 1.3, south + _ROOM_Y - 1.2, 1.6, 0.7, 0.72)
    shelf = west + _ROOM_X - 0.5
    for board in range(5):
        panels.box((shelf, south + 1.0, 0.1 + 0.4 * board), (shelf + 0.35, south + 2.4, 0.13 + 0.4 * board))
    for side in (0.97, 2.4):
        panels.box((shelf, south + side, 0.0), (shelf + 0.35, south + side + 0.03, 2.0))
    cupboard = south + 0.4 * _ROOM_Y
    panels.box((west + 0.2, cupboard, 0.0), (west + 0.7, cupboard + 1.0, 1.9), open_sides="-z")
    for _ in range(3):
        x, y = west + 1.0 + rng.random() * (_ROOM_X - 2.2), south + 1.2 + rng.random() * (_ROOM_Y - 2.6)
        panels.box((x - 0.22, y - 0.22, 0.42), (x + 0.22, y + 0.22, 0.47))
        panels.box((x - 0.22, y + 0.18, 0.47), (x + 0.22, y + 0.22, 0.95))
        panels.box((x - 0.03, y - 0.03, 0.0), (x + 0.03, y + 0.03, 0.42), open_sides="-z +z")


def _table(panels: _Panels, x: float, y: float, width: float, depth: float, height: float) -> None:
    panels.box((x - width / 2, y - depth / 2, height - 0.03), (x + width / 2, y + depth / 2, height))
    for side_x in (-1, 1):
        for side_y in (-1, 1):
            u, v = x + side_x * (width / 2 - 0.05), y + side_y * (depth / 2 - 0.05)
            panels.box((u - 0.025, v - 0.025, 0.0), (u + 0.025, v + 0.025, height - 0.03), open_sides="-z +z")


# ---------------------------------------------------------------------------------------------------------- the objects


def _multimeter() -> _Panels:
    case = _Panels().box((-0.045, -0.095, 0.0), (0.045, 0.095, 0.045))
    case.box((-0.035, 0.02, 0.045), (0.035, 0.08, 0.049))
    return case.box((-0.02, -0.04, 0.045), (0.02, 0.0, 0.057))


def _screwdriver() -> _Panels:
    motor = _Panels().box((-0.09, -0.03, 0.12), (0.10, 0.03, 0.19))
    motor.box((-0.08, -0.022, 0.02), (-0.03, 0.022, 0.12))
    motor.box((-0.10, -0.035, 0.0), (-0.01, 0.035, 0.03))
    return motor.box((0.10, -0.01, 0.145), (0.16, 0.01, 0.165))


def _open_box(width: float, depth: float, height: float, wall: float) -> _Panels:
    x, y = width / 2, depth / 2
    box = _Panels().box((-x, -y, 0.0), (x, y, wall))
    box.box((-x, -y, wall), (-x + wall, y, height)).box((x - wall, -y, wall), (x, y, height))
    box.box((-x + wall, -y, wall), (x - wall, -y + wall, height))
    return box.box((-x + wall, y - wall, wall), (x - wall, y, height))


def _relay() -> _Panels:
    coil = _Panels().box((-0.028, -0.035, 0.012), (0.028, 0.035, 0.075))
    coil.box((-0.034, -0.045, 0.0), (0.034, 0.045, 0.012))
    return coil.box((-0.01, -0.02, 0.075), (0.01, 0.02, 0.08))


_OBJECTS = {
    "multimeter": _multimeter,
    "screwdriver": _screwdriver,
    "materialbox": lambda: _open_box(0.17, 0.12, 0.08, 0.004),
    "klt3147": lambda: _open_box(0.30, 0.20, 0.147, 0.008),
    "relay": _relay,
}
