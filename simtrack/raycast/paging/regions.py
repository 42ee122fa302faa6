"""Regions of a world and the portals between them: where a point lies, and what rays from there can reach."""

import numpy as np
import numpy.typing as npt
from numba import njit

from simtrack.contracts import Bool, Float32, Float64, Int32
from simtrack.errors import InvalidValueError
from simtrack.raycast.paging import sight
from simtrack.raycast.paging.grid import BoxGrid

_SLACK = 2e-3
"""Metres by which everything is taken to be larger than it is: more than float32 rounds in a region."""


class Regions:
    """Rooms as boxes, and the openings through which one sees from one into another.

    A region is whatever solid surfaces enclose but for its portals: a room, a piece of a corridor, a yard. Its box only
    tells who is inside. What can be seen from inside belongs to the region, except what is seen through its portals.
    Boxes may overlap; a point in several counts as being in all of them.
    """

    def __init__(
        self,
        low: npt.ArrayLike,
        high: npt.ArrayLike,
        sides: npt.ArrayLike = (),
        centres: npt.ArrayLike = (),
        half_axes: npt.ArrayLike = (),
        is_open: npt.ArrayLike | None = None,
    ) -> None:
        """Index regions and portals.

        Args:
            low: (R, 3) lower corners of the regions' boxes, map frame, metres.
            high: (R, 3) upper corners.
            sides: (P, 2) the regions that each portal joins.
            centres: (P, 3) of the portals' rectangles, map frame, metres.
            half_axes: (P, 2, 3) perpendicular half-axes of the rectangles, map frame, metres.
            is_open: (P,) whether one sees through; all if None.

        Raises:
            InvalidValueError: wrong shapes, numbers that are not finite, boxes turned inside out, portals that join a
                region with itself or one that is not there, rectangles without area or with a skew corner.
        """
        self.low, self.high = _boxes(low, high)
        """(R, 3) float64 each, map frame, metres."""
        count = len(self.low)
        portals = len(np.asarray(sides).reshape(-1, 2))
        self._sides = _sides(np.asarray(sides).reshape(-1, 2), count)
        centre = np.array(centres, np.float64).reshape(-1, 3)
        axes = np.array(half_axes, np.float32).reshape(-1, 2, 3)
        opened = np.ones(portals, bool) if is_open is None else np.array(is_open, bool)
        _check_rectangles(centre, axes, portals)
        if opened.shape != (portals,):
            raise InvalidValueError("is_open", opened.shape, f"({portals},)")
        start, incident = _incidence(self._sides, count)
        self._graph = sight.Graph(self._sides, centre, axes, opened, start, incident)
        self._grid = BoxGrid(self.low, self.high)
        self._rows = np.full(2 * portals, -1, np.int32)

    def __len__(self) -> int:
        return len(self.low)

    @property
    def sides(self) -> Int32:
        """(P, 2), the regions that each portal joins."""
        return self._graph.sides

    @property
    def centres(self) -> Float64:
        """(P, 3) of the portals' rectangles, map frame, metres."""
        return self._graph.centre

    @property
    def half_axes(self) -> Float32:
        """(P, 2, 3) half-axes of the portals' rectangles, map frame, metres."""
        return self._graph.half_axes

    @property
    def is_open(self) -> Bool:
        """(P,) whether one sees through a portal; change it with `set_open`."""
        return self._graph.open

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        arrays = (self.low, self.high, self._rows, *self._graph)
        return sum(array.nbytes for array in arrays) + self._grid.nbytes

    def set_open(self, portal: int, is_open: bool) -> None:
        """Open or close a portal (where a `PagedScene` uses the regions, call its `set_open` instead)."""
        self.check_portal(portal)
        self._graph.open[portal] = is_open

    def portals_of(self, region: int) -> Int32:
        """(K,) portals of a region, ascending."""
        self.check_region(region)
        return self._graph.portals[self._graph.start[region] : self._graph.start[region + 1]]

    def rectangle(self, portal: int) -> Float64:
        """(4, 4) affine transform that takes the square -1..1 of the xy plane to a portal's rectangle, map frame."""
        self.check_portal(portal)
        u, v = self.half_axes[portal].astype(np.float64)
        normal = np.cross(u, v)
        T = np.eye(4)
        T[:3, :3] = np.stack([u, v, normal / np.linalg.norm(normal)], axis=1)
        T[:3, 3] = self.centres[portal]
        return T

    def containing(self, point: npt.ArrayLike) -> Int32:
        """(K,) regions whose box holds a point (3,) of the map frame, ascending."""
        return self._grid.containing(_point(point))

    def locate(self, points: npt.ArrayLike) -> Int32:
        """(N,) region of each of (N, 3) points of the map frame: the lowest of those whose box holds it, -1 if none."""
        queries = np.asarray(points, np.float64)
        if queries.ndim != 2 or queries.shape[1] != 3:
            raise InvalidValueError("points", queries.shape, "(N, 3)")
        found = (self.containing(point) for point in queries)
        return np.array([regions[0] if len(regions) else -1 for regions in found], np.int32)

    def reachable(self, point: npt.ArrayLike, reach: float, radius: float = 0.0) -> tuple[Int32, Float64]:
        """Regions that rays of limited length can meet, nearest first.

        The answer is conservative: it may hold regions that no ray meets, but never lacks one that a ray meets. From
        outside all regions that is every region within reach, as nothing is known of what stands in between.

        Args:
            point: (3,) where the rays start, map frame.
            reach: length of the rays, metres.
            radius: rays may start this far from the point, in any region that lies as near, metres.

        Returns:
            (K,) regions, and (K,) lower bounds of a ray's way from the point, ascending; equal ones by region.
        """
        position = _point(point)
        if not (0 <= reach < np.inf and 0 <= radius < np.inf):
            raise InvalidValueError("reach, radius", (reach, radius), "finite numbers >= 0")
        if not len(self._grid.containing(position)):
            return self._within(position, reach + radius + _SLACK)
        sources, ways = self._within(position, radius)
        edges, onwards = sight.reachable(self._graph, sources, position, radius + _SLACK, reach, self._rows)
        entered = self._sides[edges // 2, edges % 2]
        return _nearest_first(np.concatenate([sources, entered]), np.concatenate([ways, onwards]))

    def check_region(self, region: int) -> None:
        """Raise InvalidValueError unless there is such a region."""
        if not 0 <= region < len(self):
            raise InvalidValueError("region", region, f"0..{len(self) - 1}")

    def check_portal(self, portal: int) -> None:
        """Raise InvalidValueError unless there is such a portal."""
        if not 0 <= portal < len(self._sides):
            raise InvalidValueError("portal", portal, f"0..{len(self._sides) - 1}" if len(self._sides) else "none")

    def _within(self, point: Float64, distance: float) -> tuple[Int32, Float64]:
        regions = self._grid.near(point, distance)
        outside = np.maximum(np.maximum(self.low[regions] - point, point - self.high[regions]), 0.0)
        return _nearest_first(regions, np.linalg.norm(outside, axis=1))


def _nearest_first(regions: Int32, ways: Float64) -> tuple[Int32, Float64]:
    """Each region once, with its shortest way, by way and number."""
    order = np.lexsort((ways, regions))
    regions, ways = regions[order], ways[order]
    first = np.ones(len(regions), bool)
    first[1:] = regions[1:] != regions[:-1]
    regions, ways = regions[first], ways[first]
    order = np.argsort(ways, kind="stable")
    return regions[order], ways[order]


def _point(point: npt.ArrayLike) -> Float64:
    position = np.asarray(point, np.float64)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise InvalidValueError("point", point, "three finite numbers")
    return position


def _boxes(low: npt.ArrayLike, high: npt.ArrayLike) -> tuple[Float64, Float64]:
    corners = np.array(low, np.float64).reshape(-1, 3), np.array(high, np.float64).reshape(-1, 3)
    if corners[0].shape != corners[1].shape or not len(corners[0]):
        raise InvalidValueError("low, high", (corners[0].shape, corners[1].shape), "two arrays (R, 3), R >= 1")
    if not (np.isfinite(corners[0]).all() and np.isfinite(corners[1]).all()):
        raise InvalidValueError("low, high", "numbers that are not finite", "finite corners")
    wrong = np.flatnonzero((corners[0] > corners[1]).any(axis=1))
    if len(wrong):
        raise InvalidValueError(f"low of region {wrong[0]}", corners[0][wrong[0]].tolist(), "not above high")
    return corners


def _sides(sides: np.ndarray, count: int) -> Int32:
    if sides.size and not np.issubdtype(sides.dtype, np.integer):
        raise InvalidValueError("sides", sides.dtype, "integers")
    wrong = np.flatnonzero((sides < 0).any(axis=1) | (sides >= count).any(axis=1) | (sides[:, 0] == sides[:, 1]))
    if len(wrong):
        raise InvalidValueError(f"sides of portal {wrong[0]}", sides[wrong[0]].tolist(), f"two of 0..{count - 1}")
    return sides.astype(np.int32)


def _check_rectangles(centre: Float64, axes: Float32, count: int) -> None:
    if len(centre) != count or len(axes) != count:
        shapes = centre.shape, axes.shape
        raise InvalidValueError("centres, half_axes", shapes, f"({count}, 3) and ({count}, 2, 3), one for each portal")
    if not (np.isfinite(centre).all() and np.isfinite(axes).all()):
        raise InvalidValueError("centres, half_axes", "numbers that are not finite", "finite rectangles")
    lengths = np.linalg.norm(axes, axis=2)
    skew = np.abs((axes[:, 0] * axes[:, 1]).sum(axis=1)) > 1e-3 * lengths[:, 0] * lengths[:, 1]
    wrong = np.flatnonzero(skew | (lengths <= 0).any(axis=1))
    if len(wrong):
        value = axes[wrong[0]].tolist()
        raise InvalidValueError(f"half_axes of portal {wrong[0]}", value, "two perpendicular vectors that are not zero")


@njit(cache=True, nogil=True)
def _incidence(sides, regions):
    """Start of every region's portals (R + 1,) and the portals (2 P,), ascending within a region."""
    start = np.zeros(regions + 1, np.int64)
    portals = np.empty(2 * sides.shape[0], np.int32)
    for p in range(sides.shape[0]):
        for s in range(2):
            start[sides[p, s]] += 1
    for r in range(regions):
        start[r + 1] += start[r]
    for reverse in range(sides.shape[0]):
        p = sides.shape[0] - 1 - reverse
        for s in range(2):
            start[sides[p, s]] -= 1
            portals[start[sides[p, s]]] = p
    return start, portals
