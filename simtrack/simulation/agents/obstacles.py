"""Memory of things that no survey explains and that stand where the robot wants to drive."""

import numpy as np

from simtrack.contracts import Belief, Float64, RegionOfInterest
from simtrack.simulation.agents.floor_plan import FloorPlan

REACH = 4.0
"""Metres from the robot up to which unexplained things are noticed."""
LARGEST = 2.2
"""Metres: longer regions are walls seen from a wrong pose rather than furniture."""
BESIDE_SURVEYED = 0.1
"""Metres around surveyed things within which unexplained measurements add no obstacle."""


class ObstacleMemory:
    """Counts, cell by cell, how often the pre-segmentation reported something unexplained.

    Args:
        plan: the floor plan that ways are planned on.
        sightings: reports that it takes to believe in an obstacle.
    """

    def __init__(self, plan: FloorPlan, sightings: int) -> None:
        import cv2

        self.plan, self.sightings = plan, sightings
        self.counts = np.zeros(plan.occupied.shape, np.uint8)
        """(rows, columns), reports so far, at most 250."""
        reach = max(1, round(BESIDE_SURVEYED / plan.config.cell))
        kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
        self._surveyed = cv2.dilate(plan.occupied.astype(np.uint8), kernel) > 0
        self._stamps: dict[str, int] = {}

    def notice(self, belief: Belief, xy: Float64, path: Float64) -> Float64:
        """Take the regions of a belief, each scan and image once.

        Args:
            belief: its pre-segmentations are read.
            xy: (2,), where the robot stands.
            path: (M, 2), where it is about to drive.

        Returns:
            (N, 2) obstacles near the robot that the plan does not know yet, if any of them is too close to the path.
        """
        fresh = [
            result
            for result in (belief.lidar, belief.camera)
            if result is not None and self._stamps.get(result.sensor) != result.stamp
        ]
        for result in fresh:
            self._stamps[result.sensor] = result.stamp
            for region in result.regions:
                self._mark(region, xy)
        return self._in_the_way(xy, path) if fresh and len(path) else np.empty((0, 2))

    def _mark(self, region: RegionOfInterest, xy: Float64) -> None:
        config = self.plan.config
        low, high = region.centre - region.extents / 2, region.centre + region.extents / 2
        standing = high[2] > config.low and low[2] < config.high
        near = np.linalg.norm(region.centre[:2] - xy) < REACH
        if not standing or not near or region.extents[:2].max() > LARGEST:
            return
        first, last = self.plan.cell_of(low[0], low[1]), self.plan.cell_of(high[0], high[1])
        window = tuple(slice(max(a, 0), max(b + 1, 0)) for a, b in zip(first, last, strict=True))
        rows, columns = np.nonzero(~self._surveyed[window])
        rows, columns = rows + max(first[0], 0), columns + max(first[1], 0)
        x, y = (self.plan.origin[:, None] + (np.array([columns, rows]) + 0.5) * config.cell) - xy[:, None]
        clear = np.hypot(x, y) > config.radius + config.cell  # the robot stands there, so nothing else does
        cells = rows[clear], columns[clear]
        self.counts[cells] = np.minimum(self.counts[cells] + 1, 250)

    def _in_the_way(self, xy: Float64, path: Float64) -> Float64:
        plan, reach = self.plan, REACH + LARGEST
        first, last = plan.cell_of(*(xy - reach)), plan.cell_of(*(xy + reach))
        window = tuple(slice(max(a, 0), max(b + 1, 0)) for a, b in zip(first, last, strict=True))
        rows, columns = np.nonzero((self.counts[window] >= self.sightings) & ~plan.extra[window])
        cells = np.stack([columns + max(first[1], 0), rows + max(first[0], 0)], axis=1)
        points = plan.origin + (cells + 0.5) * plan.config.cell
        gaps = np.linalg.norm(points[:, None] - path[None], axis=2)
        close = gaps.min(initial=np.inf) < plan.config.radius + plan.config.margin
        return points if close else np.empty((0, 2))

    def forget(self) -> None:
        """Start anew, as when no way is left."""
        self.counts[:] = 0
        self.plan.unblock()
