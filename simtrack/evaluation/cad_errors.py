"""How far the model that an entity got is from what really stands there: class, up-axis, yaw, height, surface.

Front and up are those of the models' own frames (front -y, up +z). Turns that map either model onto itself are no
errors; of things that may lie on any side (a book on its edge), half turns about their axes are tried, too.
"""

from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.meshes import Mesh, area, sample_surface
from simtrack.geometry.transforms import rotation_from_rpy
from simtrack.objects.cad.model import CadModel

SAMPLES = 2000
"""Points on each surface."""
TOLERANCE = 0.03
"""Of the largest side: how far a turned surface may lie from itself in the 98th percentile."""


@dataclass(frozen=True, slots=True)
class RotationError:
    """The turn from a true to an estimated orientation, symmetries respected."""

    up: float
    """Radians between the up-axes."""
    yaw: float
    """Radians about the true up-axis, absolute."""


def rotation_error(true: CadModel, T_true: Float64, estimate: CadModel, T_estimate: Float64) -> RotationError:
    """Smallest turn between two models' frames, over the symmetries of both.

    Args:
        true: what stands there.
        T_true: (4, 4) T_map_model.
        estimate: what was found.
        T_estimate: (4, 4) T_map_model, rigid.
    """
    a = np.einsum("ij,njk->nik", T_true[:3, :3], symmetries(true))
    b = np.einsum("ij,njk->nik", T_estimate[:3, :3], symmetries(estimate))
    turns = np.einsum("nji,mjk->nmik", a, b).reshape(-1, 3, 3)
    best = turns[np.argmax(np.trace(turns, axis1=1, axis2=2))]
    up = float(np.arccos(np.clip(best[2, 2], -1.0, 1.0)))
    return RotationError(up, abs(float(np.arctan2(best[1, 0] - best[0, 1], best[0, 0] + best[1, 1]))))


def symmetries(model: CadModel) -> Float64:
    """(S, 3, 3) rotations that map a model onto itself, the identity first; a model with joints has no other.

    Turns about z are those that the model declares; half turns about x and y are tried on its surface.
    """
    if model.joints:
        return np.eye(3)[None]
    turns = [rotation_from_rpy(0.0, 0.0, float(yaw)) for yaw in model.yaw_symmetries]
    flips = [np.eye(3), *(flip for flip in (np.diag([1.0, -1.0, -1.0]),) if _maps_onto_itself(model.mesh(), flip))]
    if len(flips) == 1 and _maps_onto_itself(model.mesh(), np.diag([-1.0, 1.0, -1.0])):
        flips.append(np.diag([-1.0, 1.0, -1.0]))
    return np.stack([turn @ flip for flip in flips for turn in turns])


def _maps_onto_itself(mesh: Mesh, rotation: Float64) -> bool:
    from scipy.spatial import KDTree

    rng = np.random.default_rng(0)
    dense = sample_surface(mesh, 4 * SAMPLES, rng)[0]
    limit = max(TOLERANCE * float(mesh.extents.max()), 1.5 * np.sqrt(area(mesh) / len(dense)))
    turned = sample_surface(mesh, SAMPLES, rng)[0] @ rotation.T
    return bool(np.quantile(KDTree(dense).query(turned)[0], 0.98) <= limit)


def chamfer_distance(first: Mesh, second: Mesh, rng: np.random.Generator) -> float:
    """Mean distance between two surfaces, metres: the mean over both directions of that to the nearest point."""
    from scipy.spatial import KDTree

    a, b = sample_surface(first, SAMPLES, rng)[0], sample_surface(second, SAMPLES, rng)[0]
    return float(0.5 * (KDTree(b).query(a)[0].mean() + KDTree(a).query(b)[0].mean()))
