"""Where to look: patches of the surfaces that things can stand on, and the head angles that point the camera."""

from dataclasses import dataclass

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float64, StaticMap
from simtrack.geometry.transforms import apply, inverse

PAN_LIMIT = 1.2
"""Head pan that is used, rad; the joint allows 1.24."""
TILT_LIMITS = (-0.95, 0.65)
"""Head tilt that is used, rad, negative looks down."""


@dataclass(slots=True)
class Patch:
    """A piece of a support surface, and what the agent remembers of it."""

    entity: str
    """Name of the map entity that it belongs to."""
    centre: Float64
    """(3,), map frame, a little above the surface, metres."""
    front: Float64
    """(2,), unit vector in the map from which the entity is open to view."""
    seen_for: float = 0.0
    """Seconds for which it was well in view so far."""
    last_seen: int = -1
    """Nanoseconds; -1 = never."""


def support_patches(static_map: StaticMap, classes: tuple[str, ...], size: float = 0.45) -> list[Patch]:
    """Split the support surfaces of the map's entities of the given classes into patches of at most `size` metres."""
    patches = []
    for entity in static_map.entities:
        if entity.semantic_class not in classes:
            continue
        front = entity.T_map_entity[:2, 0] / max(float(np.linalg.norm(entity.T_map_entity[:2, 0])), 1e-9)
        for T_map_face, sides in entity.supports:
            if not 0.35 <= T_map_face[2, 3] <= 1.55 or min(sides) < 0.12:
                continue
            counts = np.maximum(1, np.ceil(np.asarray(sides) / size).astype(int))
            for i in range(counts[0]):
                for j in range(counts[1]):
                    offset = ((np.array([i, j]) + 0.5) / counts - 0.5) * sides
                    centre = apply(T_map_face, np.array([[offset[0], offset[1], 0.05]]))[0]
                    patches.append(Patch(entity.name, centre, front))
    return patches


def in_view(point: Float64, T_map_camera: Float64, K: CameraIntrinsics, margin: float, reach: float) -> bool:
    """Whether a map point projects into the image, `margin` pixels from its border, not further than `reach` metres."""
    x, y, z = apply(inverse(T_map_camera), point[None])[0]
    if not 0.4 < z < reach:
        return False
    u, v = K.fx * x / z + K.cx, K.fy * y / z + K.cy
    return margin <= u <= K.width - 1 - margin and margin <= v <= K.height - 1 - margin


def head_angles(target: Float64, T_map_base: Float64, camera: Float64) -> tuple[float, float]:
    """Pan and tilt, rad, unclipped, that point the camera at a map point; `camera` (3,) is where it is, map frame."""
    direction = T_map_base[:3, :3].T @ (target - camera)
    pan = float(np.arctan2(direction[1], direction[0]))
    tilt = float(np.arctan2(direction[2], np.hypot(direction[0], direction[1])))
    return pan, tilt


def clipped(pan: float, tilt: float) -> tuple[float, float]:
    """Pan and tilt within the head's limits."""
    return float(np.clip(pan, -PAN_LIMIT, PAN_LIMIT)), float(np.clip(tilt, *TILT_LIMITS))
