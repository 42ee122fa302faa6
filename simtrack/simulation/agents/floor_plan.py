"""A floor plan from the surveyed mesh: where a round robot can be, and ways from place to place."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from simtrack.contracts import Bool, Float64, Int32, Room, StaticMap
from simtrack.errors import InvalidValueError


@dataclass(frozen=True, slots=True)
class FloorPlanConfig:
    """How the plan is drawn and used."""

    cell: float = 0.05
    """Side of a grid cell, metres."""
    low: float = 0.1
    """Metres above the floor: lower things are driven over (thresholds, noise of the survey)."""
    high: float = 1.4
    """Metres above the floor: higher things are driven under."""
    radius: float = 0.27
    """Radius of the robot, metres."""
    margin: float = 0.04
    """Least distance from obstacles on planned ways, metres."""
    comfort: float = 0.45
    """Metres from the robot's rim within which ways are the more expensive the closer they pass to obstacles."""

    def __post_init__(self) -> None:
        if not 0.01 <= self.cell <= 0.5:
            raise InvalidValueError("FloorPlanConfig.cell", self.cell, "0.01 to 0.5 metres")
        if not 0.0 <= self.low < self.high:
            raise InvalidValueError("FloorPlanConfig.low, high", (self.low, self.high), "0 <= low < high")
        if min(self.radius, self.margin, self.comfort) < 0.0:
            raise InvalidValueError("FloorPlanConfig", self, "radius, margin and comfort that are not negative")


class FloorPlan:
    """Occupancy of the floor, and ways for a round robot.

    Grids are indexed [row, column] = [y, x]; row 0 is the lowest y. `extent` is what matplotlib's `imshow` wants with
    ``origin="lower"``.

    Args:
        static_map: the survey; its floors are at the heights that its rooms state.
        config: heights, robot and clearances.
    """

    def __init__(self, static_map: StaticMap, config: FloorPlanConfig | None = None) -> None:
        self.config = FloorPlanConfig() if config is None else config
        cell = self.config.cell
        corners = [room.polygon for room in static_map.rooms] or [static_map.vertices[:, :2]]
        points = np.concatenate(corners).astype(float)
        self.origin: Float64 = np.floor(points.min(axis=0) / cell) * cell - 4 * cell
        """(2,), map x and y of the lower left corner of cell [0, 0], metres."""
        columns, rows = (np.ceil((points.max(axis=0) - self.origin) / cell).astype(int) + 4).tolist()
        floor = min((room.floor for room in static_map.rooms), default=0.0)
        band = (floor + self.config.low, floor + self.config.high)
        self.occupied: Bool = rasterised(static_map, self.origin, cell, (rows, columns), band)
        """(rows, columns), cells that the survey shows something in between `low` and `high`."""
        self.known: Bool = _inside_rooms(static_map, self.origin, cell, (rows, columns))
        """(rows, columns), cells inside a room or a doorway."""
        self.extra: Bool = np.zeros_like(self.occupied)
        """(rows, columns), obstacles that were met and are in no survey; see `block`."""
        self._update()

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """(left, right, bottom, top) of the grid in the map, metres."""
        rows, columns = self.occupied.shape
        x, y = self.origin
        return x, x + columns * self.config.cell, y, y + rows * self.config.cell

    def image(self) -> np.ndarray:
        """(rows, columns) uint8 for drawing: 255 free, 200 outside of all rooms, 128 met obstacles, 0 surveyed ones."""
        image = np.where(self.known, 255, 200).astype(np.uint8)
        image[self.extra] = 128
        image[self.occupied] = 0
        return image

    # --------------------------------------------------------------------------------------------------------- queries

    def cell_of(self, x: float, y: float) -> tuple[int, int]:
        """(row, column) of a point of the map; may lie outside of the grid."""
        column, row = np.floor((np.array([x, y]) - self.origin) / self.config.cell).astype(int).tolist()
        return row, column

    def point_of(self, row: int, column: int) -> Float64:
        """(2,), map x and y of a cell's middle."""
        return self.origin + (np.array([column, row]) + 0.5) * self.config.cell

    def clearance_at(self, x: float, y: float) -> float:
        """Metres from a point to the nearest obstacle or unknown ground; 0 outside of the grid."""
        row, column = self.cell_of(x, y)
        inside = 0 <= row < self.clearance.shape[0] and 0 <= column < self.clearance.shape[1]
        return float(self.clearance[row, column]) if inside else 0.0

    def free(self, x: float, y: float) -> bool:
        """Whether the robot can stand at a point of the map."""
        return self.clearance_at(x, y) > self.config.radius

    def place_in(self, room: Room, rng: np.random.Generator) -> Float64 | None:
        """(2,) a random place in a room that can be driven to, rather in its open parts; None if there is none."""
        import cv2

        inside = np.zeros(self.occupied.shape, np.uint8)
        cv2.fillPoly(inside, [np.round((room.polygon - self.origin) / self.config.cell - 0.5).astype(np.int32)], 1)
        rows, columns = np.nonzero((inside > 0) & self.reachable)
        if len(rows) == 0:
            return None
        weights = np.minimum(self.clearance[rows, columns], 1.0) ** 4
        k = int(rng.choice(len(rows), p=weights / weights.sum()))
        return self.point_of(int(rows[k]), int(columns[k]))

    def random_free(self, rng: np.random.Generator) -> Float64:
        """(2,) a place on the largest connected piece of floor, uniformly drawn.

        Raises:
            InvalidValueError: there is no free floor.
        """
        rows, columns = np.nonzero(self.reachable)
        if len(rows) == 0:
            raise InvalidValueError("static_map", "no free floor", "a map with floor that the robot fits on")
        k = int(rng.integers(len(rows)))
        return self.point_of(int(rows[k]), int(columns[k])) + rng.uniform(-0.5, 0.5, 2) * self.config.cell

    # -------------------------------------------------------------------------------------------------------- planning

    def block(self, points: Float64) -> None:
        """Take (N, 2) points of the map as obstacles from now on."""
        cells = np.floor((np.asarray(points) - self.origin) / self.config.cell).astype(int)
        inside = ((cells >= 0) & (cells < np.array(self.occupied.shape)[::-1])).all(axis=1)
        before = int(self.extra.sum())
        self.extra[cells[inside, 1], cells[inside, 0]] = True
        if int(self.extra.sum()) != before:
            self._update()

    def unblock(self) -> None:
        """Forget the obstacles that were met."""
        if self.extra.any():
            self.extra[:] = False
            self._update()

    def plan(self, start_xy: Float64, goal_xy: Float64) -> Float64 | None:
        """A way from place to place that keeps clear of obstacles where it can.

        Minimum cost path on the 8-connected grid (`skimage.graph.MCP_Geometric`), then shortened by lines of sight and
        resampled. Start and goal are moved to the nearest place where the robot fits.

        Returns:
            (N, 2) points of the map, at most 0.1 m apart, the first at the (moved) start; None if there is no way.
        """
        from skimage.graph import MCP_Geometric

        start, goal = self._nearest_free(start_xy), self._nearest_free(goal_xy)
        if start is None or goal is None or self.regions[start] != self.regions[goal]:
            return None
        search = MCP_Geometric(self.cost, fully_connected=True)
        search.find_costs([start], [goal], find_all_ends=True)
        cells = np.array(search.traceback(goal))
        return self._smoothed(self.origin + (cells[:, ::-1] + 0.5) * self.config.cell)

    def _nearest_free(self, xy: Float64) -> tuple[int, int] | None:
        row, column = self.cell_of(float(xy[0]), float(xy[1]))
        reach = int(1.0 / self.config.cell)
        r0, c0 = max(0, row - reach), max(0, column - reach)
        window = self.drivable[r0 : row + reach + 1, c0 : column + reach + 1]
        rows, columns = np.nonzero(window)
        if len(rows) == 0:
            return None
        k = int(np.argmin((rows + r0 - row) ** 2 + (columns + c0 - column) ** 2))
        return int(rows[k]) + r0, int(columns[k]) + c0

    def _smoothed(self, path: Float64) -> Float64:
        """Corners cut where the straight line costs no more than the way around."""
        kept, k = [0], 0
        while k < len(path) - 1:
            ahead = next(
                j for j in range(min(k + 60, len(path) - 1), k, -1) if j == k + 1 or self._shorter(path[k : j + 1])
            )
            kept.append(ahead)
            k = ahead
        return resampled(path[kept], 0.1)

    def _shorter(self, path: Float64) -> bool:
        line = resampled(path[[0, -1]], self.config.cell)
        return self._price(line) <= 1.02 * self._price(path) + 1e-9

    def _price(self, path: Float64) -> float:
        middle = (path[1:] + path[:-1]) / 2
        cells = np.floor((middle - self.origin) / self.config.cell).astype(int)
        costs = self.cost[cells[:, 1], cells[:, 0]]
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        return float(np.inf) if (costs < 0).any() else float(costs @ steps)

    def _update(self) -> None:
        import cv2

        open_cells = (self.known & ~self.occupied & ~self.extra).astype(np.uint8)
        distances = cv2.distanceTransform(open_cells, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        self.clearance: Float64 = np.asarray(distances, dtype=np.float64) * self.config.cell
        """(rows, columns), metres from each cell to the nearest obstacle or unknown ground."""
        needed = self.config.radius + self.config.margin
        self.drivable: Bool = self.clearance > needed
        """(rows, columns), cells that planned ways may lead through."""
        regions = cv2.connectedComponents(self.drivable.astype(np.uint8), connectivity=8)[1]
        self.regions: Int32 = np.asarray(regions, dtype=np.int32)
        """(rows, columns), number of the connected piece of drivable floor, 0 = none."""
        closeness = np.clip(1.0 - (self.clearance - needed) / max(self.config.comfort, 1e-9), 0.0, 1.0)
        self.cost: Float64 = np.where(self.drivable, 1.0 + 6.0 * closeness**2, -1.0)
        """(rows, columns), price of a metre of way; negative where there is none."""
        sizes = np.bincount(self.regions.ravel())
        sizes[0] = 0
        self.reachable: Bool = self.drivable & (self.regions == int(np.argmax(sizes)))
        """(rows, columns), the largest connected piece of drivable floor."""


def resampled(path: Float64, step: float) -> Float64:
    """(M, 2) points at most `step` metres apart along a (N, 2) path, its corners among them."""
    pieces = []
    for a, b in pairwise(path):
        count = max(1, int(np.ceil(np.linalg.norm(b - a) / step)))
        pieces.append(a + (b - a) * (np.arange(count) / count)[:, None])
    return np.concatenate([*pieces, path[-1:]])


def rasterised(
    static_map: StaticMap, origin: Float64, cell: float, shape: tuple[int, int], band: tuple[float, float]
) -> Bool:
    """Cells of a grid that any triangle of the map touches between two heights.

    Triangles are clipped to the band and covered with points less than a cell apart, so no wall has gaps.
    """
    from simtrack.simulation.agents.rasterise import mark_triangles

    grid = np.zeros(shape, np.uint8)
    vertices = static_map.vertices.astype(np.float64)
    heights = vertices[static_map.faces, 2]
    touching = (heights.max(axis=1) > band[0]) & (heights.min(axis=1) < band[1])
    mark_triangles(grid, vertices[static_map.faces[touching]], origin, cell, band[0], band[1])
    return grid > 0


def _inside_rooms(static_map: StaticMap, origin: Float64, cell: float, shape: tuple[int, int]) -> Bool:
    """Cells inside a room, grown over doorways by half the thickness of a thick wall."""
    import cv2

    if not static_map.rooms:
        return np.ones(shape, bool)
    grid = np.zeros(shape, np.uint8)
    for room in static_map.rooms:
        cv2.fillPoly(grid, [np.round((room.polygon - origin) / cell - 0.5).astype(np.int32)], 1)
    reach = max(1, round(0.15 / cell))
    closed = cv2.morphologyEx(grid, cv2.MORPH_CLOSE, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    return closed > 0
