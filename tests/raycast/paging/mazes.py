"""Mazes of boxes in three dimensions, and an exact walk of rays through them."""

import numpy as np

from simtrack.raycast.paging import Regions


def maze(seed: int, shape: tuple[int, int, int] = (6, 5, 3), share_open: float = 0.8) -> Regions:
    """A grid of cells of uneven size; most walls, floors and ceilings have an opening, most of which are open."""
    rng = np.random.default_rng(seed)
    cuts = [np.cumsum(np.append(-4.0, rng.uniform(1.5, 4.0, n))) for n in shape]
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(cells)).reshape(shape)
    low = np.stack([cuts[a][cells[:, a]] for a in range(3)], axis=1)
    high = np.stack([cuts[a][cells[:, a] + 1] for a in range(3)], axis=1)
    sides, centres, axes = [], [], []
    for cell in cells:
        for axis in range(3):
            beyond = cell + np.eye(3, dtype=int)[axis]
            if beyond[axis] == shape[axis] or rng.random() < 0.2:
                continue
            here = number[tuple(cell)]
            extent = high[here] - low[here]
            half = 0.5 * extent * rng.uniform(0.2, 0.8, 3)
            centre = low[here] + half + rng.random(3) * (extent - 2 * half)
            centre[axis] = high[here, axis]
            sides.append((here, number[tuple(beyond)]))
            centres.append(centre)
            axes.append(np.diag(half)[[a for a in range(3) if a != axis]])
    return Regions(low, high, sides, centres, axes, rng.random(len(sides)) < share_open)


def passed(regions: Regions, origin: np.ndarray, direction: np.ndarray, reach: float) -> list[tuple[int, float]]:
    """Regions that a ray from inside a maze's cell gets into, and how far it has come by then."""
    here, travelled = int(regions.containing(origin)[0]), 0.0
    out = [(here, 0.0)]
    while True:
        crossings = []
        for portal in regions.portals_of(here):
            if not regions.is_open[portal]:
                continue
            u, v = regions.half_axes[portal].astype(float)
            normal = np.cross(u, v)
            way = ((regions.centres[portal] - origin) @ normal) / (direction @ normal)
            offset = origin + way * direction - regions.centres[portal]
            if way > travelled + 1e-9 and abs(offset @ u) <= u @ u and abs(offset @ v) <= v @ v:
                crossings.append((way, int(portal)))
        if not crossings or min(crossings)[0] > reach:
            return out
        travelled, portal = min(crossings)
        a, b = regions.sides[portal]
        here = int(b if a == here else a)
        out.append((here, travelled))


def inside(regions: Regions, rng: np.random.Generator) -> np.ndarray:
    """A point inside a cell."""
    cell = int(rng.integers(len(regions)))
    return regions.low[cell] + rng.uniform(0.05, 0.95, 3) * (regions.high[cell] - regions.low[cell])
