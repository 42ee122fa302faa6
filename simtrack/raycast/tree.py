"""A tree of boxes over the faces of a mesh, for what Embree does not answer: distances between meshes.

Faces are sorted along a Morton curve and halved again and again, so the tree is an implicit complete one: node 1 is the
root, node i has the children 2 i and 2 i + 1, and the leaves hold a face each. Places without a face have empty boxes.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float32, Int32


@dataclass(frozen=True, slots=True, eq=False)
class FaceTree:
    """Boxes in the mesh frame."""

    boxes: Float32
    """(2 L, 6), lower and upper corner of each node; row 0 is not used, an empty box has lower > upper."""
    faces: Int32
    """(L,), face of leaf L + k at k, -1 for an empty one."""

    @staticmethod
    def of(vertices: Float32, faces: npt.NDArray[np.uint32]) -> "FaceTree":
        """Tree over (F, 3) faces with (V, 3) vertices."""
        triangles = vertices[faces]
        low, high = triangles.min(axis=1), triangles.max(axis=1)
        order = np.argsort(_morton(0.5 * (low.astype(np.float64) + high)), kind="stable")
        leaves = 1 << max(0, int(len(faces) - 1).bit_length())
        boxes = np.empty((2 * leaves, 6), np.float32)
        boxes[:, :3], boxes[:, 3:] = np.inf, -np.inf
        # Faces spread evenly over the leaves, so that both halves of every node are about equally full.
        places = np.arange(len(faces)) * leaves // len(faces)
        boxes[leaves + places, :3], boxes[leaves + places, 3:] = low[order], high[order]
        members = np.full(leaves, -1, np.int32)
        members[places] = order
        level = leaves
        while level > 1:
            children = boxes[level : 2 * level].reshape(-1, 2, 6)
            boxes[level // 2 : level, :3] = children[:, :, :3].min(axis=1)
            boxes[level // 2 : level, 3:] = children[:, :, 3:].max(axis=1)
            level //= 2
        return FaceTree(boxes, members)


def _morton(points: npt.NDArray[np.float64]) -> npt.NDArray[np.uint64]:
    """(N,) codes of (N, 3) points, 20 bits an axis of a cube around them."""
    low = points.min(axis=0)
    size = max(float((points - low).max()), np.finfo(np.float64).tiny)
    cells = ((points - low) * ((1 << 20) - 1) / size).astype(np.uint64)
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        cells = (cells | (cells << np.uint64(shift))) & np.uint64(mask)
    return cells[:, 0] | (cells[:, 1] << np.uint64(1)) | (cells[:, 2] << np.uint64(2))
