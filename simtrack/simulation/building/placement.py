"""Placing furniture on the free floor of a room without closing the ways between its doors."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from simtrack.contracts import Bool, Float64, Room

CELL = 0.05
"""Metres."""
PASSAGE = 0.36
"""Metres: half the width of the ways that stay open (a base of 0.54 m diameter and 9 cm to either side)."""
LANDING = 0.6
"""Metres from the wall at which a way through a door has to be reached."""


class Piece(Protocol):
    """What stands on the floor."""

    @property
    def extents(self) -> Float64:
        """(3,), depth (from its front to its rear), width, height in metres."""
        ...


class FloorSpace:
    """The free floor of one room while it is being furnished.

    Args:
        room: its polygon is the clear floor.
        doors: (middle (2,) on the wall's face, direction (2,) into the room, width) of each passage.
    """

    def __init__(self, room: Room, doors: Sequence[tuple[Float64, Float64, float]]) -> None:
        import cv2

        self.room = room
        low, high = room.polygon.min(axis=0), room.polygon.max(axis=0)
        self.origin = low - 2 * CELL
        rows, columns = (np.ceil((high - low) / CELL).astype(int) + 4).tolist()
        inside = np.zeros((rows, columns), np.uint8)
        # pixel centres of cv2 lie at integers, the middles of cells here; x runs along the rows
        corners = np.round((room.polygon - self.origin) / CELL - 0.5).astype(np.int32)
        cv2.fillPoly(inside, [corners[:, ::-1]], 1)
        self.free: Bool = inside > 0
        self.reserved = np.zeros_like(self.free)
        self.landings: list[tuple[int, int]] = []
        for middle, inwards, width in doors:
            x, y = middle + 0.5 * inwards
            window, mask = self._window(x, y, float(np.arctan2(inwards[1], inwards[0])), 1.0, width + 0.1)
            self.reserved[window] |= mask
            cell = (middle + LANDING * inwards - self.origin) / CELL
            self.landings.append((int(cell[0]), int(cell[1])))
        self.ways = self._ways(self.free)

    def _window(self, x: float, y: float, yaw: float, depth: float, width: float) -> tuple[tuple[slice, slice], Bool]:
        """The window of the grid around a turned rectangle, and the cells of it whose middles lie inside."""
        c, s = np.cos(yaw), np.sin(yaw)
        reach = np.array([abs(c) * depth + abs(s) * width, abs(s) * depth + abs(c) * width]) / 2
        first = np.floor((np.array([x, y]) - reach - self.origin) / CELL).astype(int).clip(0, self.free.shape)
        last = np.ceil((np.array([x, y]) + reach - self.origin) / CELL).astype(int).clip(0, self.free.shape)
        dx, dy = (self.origin[k] + (np.arange(first[k], last[k]) + 0.5) * CELL - (x, y)[k] for k in (0, 1))
        dx, dy = dx[:, None], dy[None, :]
        mask = (np.abs(c * dx + s * dy) <= depth / 2) & (np.abs(c * dy - s * dx) <= width / 2)
        return (slice(first[0], last[0]), slice(first[1], last[1])), mask

    def _ways(self, free: Bool) -> int:
        """Number of cells where a robot can be that are joined to all doors; -1 if a door is cut off."""
        import cv2

        distances = cv2.distanceTransform(free.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        drivable = distances * CELL > PASSAGE
        _, regions = cv2.connectedComponents(drivable.astype(np.uint8), connectivity=4)
        if not self.landings:
            return int(drivable.sum())
        found = {int(regions[cell]) for cell in self.landings}
        if len(found) != 1 or 0 in found:
            return -1
        return int(np.count_nonzero(regions == found.pop()))

    def put(self, piece: Piece, x: float, y: float, yaw: float, *, gap: float = 0.03, on_way: bool = False) -> bool:
        """Take up the floor below a piece if it is free and the ways stay open; says whether it was.

        `on_way` ones (open door leaves) may stand on the floor that is reserved in front of doors.
        """
        depth, width = piece.extents[:2].tolist()
        window, wanted = self._window(x, y, yaw, depth + 2 * gap, width + 2 * gap)
        if not self.free[window][wanted].all() or (not on_way and self.reserved[window][wanted].any()):
            return False
        remaining = self.free.copy()
        window, covered = self._window(x, y, yaw, depth + CELL, width + CELL)
        remaining[window] &= ~covered
        ways = self._ways(remaining)
        if ways < 0 or (self.ways > 0 and ways < 0.35 * self.ways):
            return False
        self.free = remaining
        return True

    def keep_clear(self, x: float, y: float, yaw: float, depth: float, width: float) -> bool:
        """Keep the floor of a rectangle clear and joined to the doors, if nothing stands on it; says whether it does.

        Args:
            x: of its middle, metres, as `y`.
            y: of its middle.
            yaw: direction of its depth, radians.
            depth: metres.
            width: metres.
        """
        window, wanted = self._window(x, y, yaw, depth, width)
        cell = (np.array([x, y]) - self.origin) / CELL
        landing = (int(cell[0]), int(cell[1]))
        # a rectangle that sticks out of the grid has fewer cells than its area
        if np.count_nonzero(wanted) < 0.95 * depth * width / CELL**2 or not self.free[window][wanted].all():
            return False
        self.landings.append(landing)
        ways = self._ways(self.free)
        if ways < 0:
            self.landings.pop()
            return False
        self.reserved[window] |= wanted
        self.ways = ways
        return True

    def put_at_wall(
        self,
        piece: Piece,
        rng: np.random.Generator,
        *,
        attempts: int = 24,
        gap: float = 0.04,
        free_gap: float = 0.02,
    ) -> tuple[float, float, float] | None:
        """Try random places with the piece's rear to a wall; (x, y, yaw) of the first that is free."""
        corners = self.room.polygon
        ways = np.roll(corners, -1, axis=0) - corners
        lengths = np.linalg.norm(ways, axis=1)
        depth, width = piece.extents[:2]
        for _ in range(attempts):
            k = int(rng.choice(len(corners), p=lengths / lengths.sum()))
            if lengths[k] < width + 0.1:
                continue
            along = ways[k] / lengths[k]
            inwards = np.array([-along[1], along[0]])
            s = rng.uniform(width / 2 + 0.05, lengths[k] - width / 2 - 0.05)
            yaw = float(np.arctan2(inwards[1], inwards[0])) + rng.normal(0.0, 0.01) * (gap > 0.0)
            # a little more than the gap, so that a turned corner stays out of the wall
            away = gap * (1.0 + rng.random()) + 0.012 * width * (gap > 0.0)
            x, y = corners[k] + s * along + (depth / 2 + away) * inwards
            if self.put(piece, float(x), float(y), yaw, gap=min(free_gap, gap)):
                return float(x), float(y), yaw
        return None

    def put_anywhere(
        self, piece: Piece, rng: np.random.Generator, *, attempts: int = 24, square: bool = True
    ) -> tuple[float, float, float] | None:
        """Try random places; `square` ones stand about parallel to the walls. (x, y, yaw) of the first that is free."""
        low, high = self.room.polygon.min(axis=0), self.room.polygon.max(axis=0)
        for _ in range(attempts):
            x, y = rng.uniform(low, high)
            yaw = rng.integers(4) * np.pi / 2 + rng.normal(0.0, 0.05) if square else rng.uniform(-np.pi, np.pi)
            if self.put(piece, float(x), float(y), float(yaw), gap=0.06):
                return float(x), float(y), float(yaw)
        return None
