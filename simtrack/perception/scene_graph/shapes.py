"""What the relations need to know of a body's form: box, surfaces that things rest on, interior of a container.

Two bodies rest on each other where the surface that one shows to the sky meets the surface that the other shows to the
ground. Both are height fields over the faces of the body's box, rasterised once per class from the model's mesh; so the
floor of an open container, the step of an L-shaped tool and the flat top of a box are all found without being declared.
"""

import os
from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit

from simtrack.contracts import Float64, MapEntity
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import inverse, transform

_FINE_CELL, _FINE_CELLS = 0.002, 128
"""Metres and number: resolution at which meshes are rasterised."""
_CONTACT_CELLS = 24
"""Cells per side that take part in contact tests."""
_BASIN_DEPTH, _BASIN_AREA = 0.3, 0.25
"""A model is a container if a hollow deeper than this share of its height covers this share of its footprint; how deep
a hollow is, its lowest edge tells."""
_BOX_CELLS = 8
"""Cells per side of the faces of a body that is known by its box alone."""


class ModelLike(Protocol):
    """What is needed of an object model; a `mesh` with `vertices` (V, 3) and `faces` (F, 3) is used if present."""

    @property
    def semantic_class(self) -> str:
        """Class in the background taxonomy, e.g. ``tool``."""
        ...

    @property
    def extents(self) -> Float64:
        """(3,) full side lengths of the model's box, metres."""
        ...


@dataclass(frozen=True, slots=True)
class HeightField:
    """A surface seen from outside along the normal of a rectangle."""

    T_entity_field: Float64
    """(4, 4), origin in the rectangle's centre, z outward."""
    size: Float64
    """(2,), metres along the field's x and y."""
    heights: Float64
    """(U, V), metres along z at the centres of equal cells, -inf where there is no surface."""


@dataclass(frozen=True, slots=True)
class Interior:
    """The hollow of a container, open at its top (+z of the entity)."""

    centre: Float64
    """(3,), entity frame."""
    extents: Float64
    """(3,), metres; the lower side is the inner floor, the upper side the top of the walls."""


@dataclass(frozen=True, slots=True)
class Shape:
    """The form of a class of bodies, in the frame of the body (origin in the centre of its box, z up)."""

    extents: Float64
    """(3,), full side lengths, metres."""
    fields: tuple[HeightField, ...]
    """Six, seen from +x, -x, +y, -y, +z, -z."""
    supports: tuple[HeightField, ...] = ()
    """Declared faces that things stand on; if there are any, nothing else of the body supports."""
    interior: Interior | None = None
    """Given for containers."""
    layout: bool = False
    """Floor, wall or ceiling: carries and touches, but is no landmark for directions."""

    def __post_init__(self) -> None:
        extents = np.asarray(self.extents, dtype=float)
        if extents.shape != (3,) or not np.isfinite(extents).all() or not (extents > 0).all():
            raise InvalidValueError("Shape.extents", self.extents, "three positive finite lengths in metres")


def box_shape(extents: Float64, *, interior: Interior | None = None, layout: bool = False) -> Shape:
    """Shape of a body of which only the box is known; `extents` (3,) in metres."""
    extents = np.asarray(extents, dtype=float)
    fields = []
    for side in range(6):
        T, size = _face(extents, side)
        fields.append(HeightField(T, size, np.zeros((_BOX_CELLS, _BOX_CELLS))))
    return Shape(extents=extents, fields=tuple(fields), interior=interior, layout=layout)


def model_shape(model: ModelLike) -> Shape:
    """Shape of a catalogue object: from its mesh if it has one, else from its box.

    The mesh is in the object frame, whose origin is the centre of the box.
    """
    extents = np.asarray(model.extents, dtype=float)
    mesh = getattr(model, "mesh", None)
    if mesh is None or len(mesh.faces) == 0:
        return box_shape(extents)
    vertices = np.asarray(mesh.vertices, dtype=float)
    faces = np.asarray(mesh.faces, dtype=np.int64)
    fields: list[HeightField] = []
    interior = None
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        cells = np.clip(np.round(extents[[u, v]] / _FINE_CELL), _BOX_CELLS, _FINE_CELLS).astype(int)
        highest, lowest = _rasterise(vertices[:, [u, v, axis]].copy(), faces, extents[[u, v]], cells[0], cells[1])
        for side, seen in ((2 * axis, highest), (2 * axis + 1, -lowest[:, ::-1])):
            T, size = _face(extents, side)
            fields.append(HeightField(T, size, _coarse(seen - 0.5 * extents[axis])))
        if axis == 2:
            interior = _find_interior(highest, extents)
    return Shape(extents=extents, fields=tuple(fields), interior=interior)


def model_shapes(models: Mapping[str, ModelLike]) -> dict[str, Shape]:
    """`model_shape` of several models by name, made in threads."""
    if not models:
        return {}
    with ThreadPoolExecutor(min(len(models), os.cpu_count() or 1)) as workers:
        return dict(zip(models, workers.map(model_shape, models.values()), strict=True))


def map_entity_shape(entity: MapEntity, container_classes: Collection[str], layout_classes: Collection[str]) -> Shape:
    """Shape of a piece of the static map; containers are hollow boxes, open in the front and on top."""
    extents = np.asarray(entity.extents, dtype=float)
    interior = Interior(np.zeros(3), extents) if entity.semantic_class in container_classes else None
    T_entity_map = inverse(entity.T_map_entity)
    supports = tuple(
        HeightField(T_entity_map @ T_map_face, np.asarray(size, dtype=float), np.zeros((1, 1)))
        for T_map_face, size in entity.supports
    )
    fields = box_shape(extents).fields
    layout = entity.semantic_class in layout_classes
    return Shape(extents=extents, fields=fields, supports=supports, interior=interior, layout=layout)


def _face(extents: Float64, side: int) -> tuple[Float64, Float64]:
    """Frame (4, 4) and size (2,) of one side of the box, in the order +x, -x, +y, -y, +z, -z."""
    axis, sign = side // 2, 1.0 - 2.0 * (side % 2)
    u, v = (axis + 1) % 3, (axis + 2) % 3
    R = np.zeros((3, 3))
    R[u, 0], R[v, 1], R[axis, 2] = 1.0, sign, sign
    return transform(R, 0.5 * extents[axis] * R[:, 2]), extents[[u, v]].copy()


def _coarse(heights: Float64) -> Float64:
    picks = [((np.arange(m) + 0.5) * n / m).astype(int) for n in heights.shape for m in (min(n, _CONTACT_CELLS),)]
    return np.ascontiguousarray(heights[np.ix_(*picks)])


def _find_interior(highest: Float64, extents: Float64) -> Interior | None:
    """Where water would stand if it rained into the body; `highest` (U, V) is z over x, y."""
    basin = np.isfinite(highest) & (_water_level(highest) > highest + _BASIN_DEPTH * extents[2])
    if basin.mean() < _BASIN_AREA:
        return None
    floor = float(np.median(highest[basin]))
    rows, columns = np.nonzero(basin.any(axis=1))[0], np.nonzero(basin.any(axis=0))[0]
    cell = extents[:2] / np.array(highest.shape)
    lower = np.array([rows[0], columns[0]]) * cell - 0.5 * extents[:2]
    upper = np.array([rows[-1] + 1, columns[-1] + 1]) * cell - 0.5 * extents[:2]
    rim = 0.5 * float(extents[2])
    centre = np.array([*(0.5 * (lower + upper)), 0.5 * (floor + rim)])
    return Interior(centre, np.array([*(upper - lower), rim - floor]))


@njit(cache=True, nogil=True)
def _water_level(ground):
    """Lowest height over which water drains from each cell of (U, V); it drains at the border and where ground is -inf.

    Water that stands everywhere runs off in sweeps (O. Planchon, F. Darboux, Catena 46, 2002).
    """
    nu, nv = ground.shape
    level = np.full((nu + 2, nv + 2), -np.inf)
    for i in range(nu):  # element by element: whole arrays would take ten times as long to compile
        for j in range(nv):
            if ground[i, j] != -np.inf:
                level[i + 1, j + 1] = np.inf
    sweep = 0
    falls = True
    while falls:
        falls = False
        for row in range(nu):
            i = row + 1 if sweep % 2 == 0 else nu - row
            for column in range(nv):
                j = column + 1 if sweep % 4 < 2 else nv - column
                drain = min(level[i - 1, j], level[i + 1, j], level[i, j - 1], level[i, j + 1])
                lower = max(ground[i - 1, j - 1], drain)
                if lower < level[i, j]:
                    level[i, j] = lower
                    falls = True
        sweep += 1
    return level[1:-1, 1:-1]


@njit(cache=True, nogil=True)
def _rasterise(points, faces, size, nu, nv):
    """Highest and lowest surface over a grid centred on the origin; (nu, nv) each, -inf and +inf where there is none.

    Cell centres inside a triangle are interpolated; edges are sampled on top, so that thin walls leave no gap.
    """
    highest = np.full((nu, nv), -np.inf)
    lowest = np.full((nu, nv), np.inf)
    cells = np.empty_like(points)  # in cells from the grid's corner, heights as they are
    for v in range(points.shape[0]):
        cells[v, 0] = (points[v, 0] + 0.5 * size[0]) / (size[0] / nu)
        cells[v, 1] = (points[v, 1] + 0.5 * size[1]) / (size[1] / nv)
        cells[v, 2] = points[v, 2]
    for f in range(faces.shape[0]):
        for k in range(3):
            p, q = faces[f, k], faces[f, (k + 1) % 3]
            x, y, z = cells[p, 0], cells[p, 1], cells[p, 2]
            dx, dy, dz = cells[q, 0] - x, cells[q, 1] - y, cells[q, 2] - z
            steps = int(2.0 * max(abs(dx), abs(dy))) + 1
            share = 1.0 / steps
            for s in range(steps + 1):
                i = min(max(int(x + s * share * dx), 0), nu - 1)
                j = min(max(int(y + s * share * dy), 0), nv - 1)
                height = z + s * share * dz
                highest[i, j] = max(highest[i, j], height)
                lowest[i, j] = min(lowest[i, j], height)
        ax, ay, az = cells[faces[f, 0], 0], cells[faces[f, 0], 1], cells[faces[f, 0], 2]
        bx, by, bz = cells[faces[f, 1], 0] - ax, cells[faces[f, 1], 1] - ay, cells[faces[f, 1], 2] - az
        cx, cy, cz = cells[faces[f, 2], 0] - ax, cells[faces[f, 2], 1] - ay, cells[faces[f, 2], 2] - az
        area = bx * cy - by * cx
        if abs(area) < 1e-9:
            continue
        i0, i1 = max(int(ax + min(bx, cx, 0.0)), 0), min(int(ax + max(bx, cx, 0.0)) + 1, nu)
        j0, j1 = max(int(ay + min(by, cy, 0.0)), 0), min(int(ay + max(by, cy, 0.0)) + 1, nv)
        for i in range(i0, i1):
            x = i + 0.5 - ax
            for j in range(j0, j1):
                y = j + 0.5 - ay
                wb = (x * cy - y * cx) / area
                wc = (bx * y - by * x) / area
                if wb >= 0.0 and wc >= 0.0 and wb + wc <= 1.0:
                    height = az + wb * bz + wc * cz
                    highest[i, j] = max(highest[i, j], height)
                    lowest[i, j] = min(lowest[i, j], height)
    return highest, lowest
