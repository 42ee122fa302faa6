"""Where a suction cup can take hold of an object: flat spots that look up, found by rays on its model."""

import numpy as np

from simtrack.contracts import Float64
from simtrack.objects import ObjectModel
from simtrack.raycast import RayScene, TriangleMesh
from simtrack.simulation.suction import RIM

SPACING = 0.006
"""Metres between the places that are tried."""
UNEVEN = 0.003
"""Largest difference of heights within the cup's rim, metres."""
CLEAR = 0.02
"""Metres around the rim in which nothing may stand higher than ..."""
HIGHER = 0.03
"""... this above it, where the fingers are."""


def suction_spot(model: ObjectModel, T_map_object: Float64) -> Float64 | None:
    """The flat spot on top of a posed object that is nearest to the vertical through its centre of mass.

    Args:
        model: its mesh is looked at from above.
        T_map_object: (4, 4).

    Returns:
        (3,) map frame, metres; None if no spot is flat enough.
    """
    centre = T_map_object[:3, :3] @ model.centre_of_mass + T_map_object[:3, 3]
    half = np.abs(T_map_object[:2, :3]) @ model.extents / 2
    axes = [np.arange(-h, h + SPACING, SPACING) for h in half]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2) + T_map_object[:2, 3]
    angles = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    offsets = np.concatenate([np.zeros((1, 2)), 1.3 * RIM * ring, (RIM + CLEAR) * ring])
    heights = _heights(model, T_map_object, (grid[:, None] + offsets).reshape(-1, 2)).reshape(len(grid), -1)
    spot, around = heights[:, :9], heights[:, 9:]
    usable = np.flatnonzero(np.isfinite(spot).all(axis=1))
    usable = usable[np.ptp(spot[usable], axis=1) <= UNEVEN]
    usable = usable[(around[usable] - spot[usable, :1] <= HIGHER).all(axis=1)]
    if len(usable) == 0:
        return None
    best = int(usable[np.argmin(np.linalg.norm(grid[usable] - centre[:2], axis=1))])
    return np.array([*grid[best], spot[best, 0]])


def _heights(model: ObjectModel, T_map_object: Float64, places: Float64) -> Float64:
    """(N,) height of the posed model's surface above places (N, 2) of the map; -inf beside it."""
    top = T_map_object[2, 3] + model.diameter
    scene = RayScene()
    try:
        scene.add(TriangleMesh(model.mesh.vertices, model.mesh.faces, model.name), T_map_object, instance=0)
        origins = np.column_stack([places, np.full(len(places), top)])
        down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), origins.shape)
        return top - scene.cast_rays(origins, down).distances.astype(float)
    finally:
        scene.close()
