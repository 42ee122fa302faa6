"""What formats want to know of the keypoints of an object's box: names, skeleton, and which of them a mirror swaps."""

from collections.abc import Sequence

import numpy as np

from simtrack.datasets.frame import Category
from simtrack.geometry.meshes import Mesh
from simtrack.objects.model import BOX_CORNERS, BOX_EDGES

NAMES = tuple(
    "".join(f"{axis}{'+' if sign > 0 else '-'}" for axis, sign in zip("xyz", corner, strict=True))
    for corner in BOX_CORNERS
) + ("centre",)
"""Of the nine keypoints: on which side of the object frame's axes a corner lies."""
SKELETON = tuple((a + 1, b + 1) for a, b in BOX_EDGES)
"""The box's edges as pairs of keypoints counted from 1."""

_AXES = (1, 0, 2)
"""In the order of preference: left and right first, then front and back, then above and below."""
_SAMPLES = 2000


def mirrored(axis: int) -> list[int]:
    """Where each keypoint comes to lie when the box is mirrored along an axis (0, 1, 2)."""
    return [corner ^ (1 << axis) for corner in range(len(BOX_CORNERS))] + [len(BOX_CORNERS)]


def flip_index(categories: Sequence[Category]) -> list[int]:
    """Keypoints after an image was mirrored.

    A mirrored image shows mirrored objects. That of an object which is its own mirror image along one of its axes is an
    image of the same object, in which the keypoints on both sides of that axis have changed places. One list serves all
    classes: it swaps along the axis along which the objects are closest to being symmetric.
    """
    errors = {axis: sum(mirror_error(category.model.mesh, axis) for category in categories) for axis in _AXES}
    return mirrored(min(_AXES, key=lambda axis: round(errors[axis], 6)))


def mirror_error(mesh: Mesh, axis: int) -> float:
    """Mean distance of a mesh's vertices from its mirror image along an axis, in shares of its box's diagonal."""
    from scipy.spatial import KDTree

    vertices = np.asarray(mesh.vertices, float)
    chosen = vertices[:: max(1, len(vertices) // _SAMPLES)].copy()
    chosen[:, axis] *= -1.0
    distances, _ = KDTree(vertices).query(chosen)
    return float(np.mean(distances) / np.linalg.norm(mesh.extents))
