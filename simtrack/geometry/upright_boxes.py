"""Gravity-aligned minimal boxes: z is up, the turn about it makes the horizontal cross-section smallest.

The smallest rectangle around a convex polygon has a side along one of the polygon's (H. Freeman, R. Shapira, 1975), so
all sides of the hull are tried. A box that is minimal and upright is what the reconstruction paper gives an entity.
"""

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import MeshError
from simtrack.geometry.boxes import OrientedBox
from simtrack.geometry.transforms import transform_planar

MIN_SIDE = 1e-6
"""Metres: sides of the boxes of flat things."""


def upright_box(points: Float64) -> OrientedBox:
    """Smallest box with vertical z axis around (N, 3) map points; its x axis is within 45 degrees of the map's.

    Raises:
        MeshError: no points, or points that are not finite.
    """
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    if len(points) == 0 or not np.isfinite(points).all():
        raise MeshError("upright box", f"{len(points)} points, all of which have to be finite and at least one given")
    outline = horizontal_hull(points)
    sides = np.roll(outline, -1, axis=0) - outline
    # quarter turns give the same rectangle; 0 stands in for a point, which has no side
    yaws = np.append((np.arctan2(sides[:, 1], sides[:, 0]) + np.pi / 4) % (np.pi / 2) - np.pi / 4, 0.0)
    along = np.stack([np.cos(yaws), np.sin(yaws)], axis=1) @ outline.T
    across = np.stack([-np.sin(yaws), np.cos(yaws)], axis=1) @ outline.T
    areas = np.maximum(np.ptp(along, axis=1), MIN_SIDE) * np.maximum(np.ptp(across, axis=1), MIN_SIDE)
    smallest = np.flatnonzero(areas <= areas.min() * (1.0 + 1e-6))
    best = smallest[np.argmin(np.abs(yaws[smallest]))]
    low = np.array([along[best].min(), across[best].min(), points[:, 2].min()])
    high = np.array([along[best].max(), across[best].max(), points[:, 2].max()])
    T = transform_planar(0.0, 0.0, float(yaws[best]))
    T[:3, 3] = T[:3, :3] @ (0.5 * (low + high))
    return OrientedBox(T, np.maximum(high - low, MIN_SIDE))


def horizontal_hull(points: Float64) -> Float64:
    """(K, 2) corners, counter-clockwise, of the convex hull of the x, y of (N, 2 or 3) points.

    Points on one line give its two ends, a single one itself.
    """
    from scipy.spatial import ConvexHull, QhullError

    flat = np.asarray(points, dtype=float)[:, :2]
    try:
        return flat[ConvexHull(flat).vertices]
    except (QhullError, ValueError):  # on one line, or too few
        spread = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[2][0]
        order = np.argsort(flat @ spread)
        ends = flat[order[[0, -1]]]
        return ends if np.ptp(ends, axis=0).max() > 0.0 else ends[:1]
