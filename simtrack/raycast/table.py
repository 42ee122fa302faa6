"""What compiled kernels know of a scene's instances, kept up to date one instance at a time."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numba as nb
import numpy as np
import numpy.typing as npt

from simtrack.contracts import Bool, Float32, Float64, Int32
from simtrack.errors import InvalidValueError
from simtrack.raycast.packets import ROW

if TYPE_CHECKING:
    from simtrack.raycast.mesh import TriangleMesh

_AFFINE = "finite invertible affine 4x4 with last row 0 0 0 1"


class InstanceTable:
    """Arrays by instance id; they grow, so they are to be fetched anew for each call of a kernel."""

    def __init__(self) -> None:
        self.poses: Float64 = np.zeros((0, 4, 4))
        """(M, 4, 4) T_map_mesh, of the first motion key."""
        self.spheres: Float64 = np.zeros((0, 4))
        """(M, 4) bounding spheres in the mesh frame: centre, radius."""
        self.halves: Float64 = np.zeros((0, 3))
        """(M, 3) half the sizes of the boxes in the mesh frame that have the spheres' centres."""
        self.handles: npt.NDArray[np.int64] = np.zeros(0, np.int64)
        """(M,) addresses of the RTCGeometry, 0 where there is none."""
        self.buffers: npt.NDArray[np.int64] = np.zeros((0, 2), np.int64)
        """(M, 2) addresses of the float32 vertices and of the uint32 faces of the mesh."""
        self.rows: Float32 = np.zeros((0, ROW), np.float32)
        """(M, 23): normal matrix (inverse transpose of the linear part, any positive scale), bounding sphere in the map
        frame (of all motion keys), number of faces, and the half axes of the box around the mesh, map frame, from the
        sphere's centre; infinite for what moves."""
        self.motion: Int32 = np.zeros((0, 2), np.int32)
        """(M, 2): first row in `keys`, number of keys; 1 at rest."""
        self.keys: Float32 = np.zeros((0, 3, 3), np.float32)
        """(K, 3, 3), linear parts of the motion keys."""
        self.enabled: Bool = np.zeros(0, np.bool_)
        """(M,), of instances that exist."""
        self.rigid: Bool = np.zeros(0, np.bool_)
        """(M,), whether the instance is at rest at a pose that keeps lengths and does not mirror."""
        self.members_changed = True
        """Whether instances were added, removed, shown or hidden, or `rigid` changed; reset by who has looked."""

    def reserve(self, number: int) -> None:
        """Make room for an instance id."""
        have = len(self.poses)
        if number < have:
            return
        size = max(number + 1, 2 * have, 16)
        for name in ("poses", "spheres", "halves", "handles", "buffers", "rows", "motion", "enabled", "rigid"):
            old = getattr(self, name)
            new = np.zeros((size, *old.shape[1:]), old.dtype)
            new[:have] = old
            setattr(self, name, new)

    def add(self, numbers: npt.NDArray[np.int64], meshes: Sequence["TriangleMesh"], poses: Float64) -> None:
        """Enter new instances, enabled and at rest."""
        self.reserve(int(numbers.max()))
        self.spheres[numbers] = [(*mesh.bounding_sphere[0], mesh.bounding_sphere[1]) for mesh in meshes]
        self.halves[numbers] = [mesh.half_extents for mesh in meshes]
        self.buffers[numbers] = [(mesh.vertices.ctypes.data, mesh.faces.ctypes.data) for mesh in meshes]
        self.rows[numbers, 13] = [len(mesh.faces) for mesh in meshes]
        self.handles[numbers], self.enabled[numbers], self.rigid[numbers] = 0, True, False
        self.members_changed = True
        self.place(numbers, poses)

    def remove(self, numbers: npt.NDArray[np.int64]) -> None:
        """Strike instances out."""
        self.members_changed = True
        self.enabled[numbers] = self.rigid[numbers] = False

    def enable(self, number: int, enabled: bool) -> None:
        """Show or hide an instance."""
        self.members_changed = True
        self.enabled[number] = enabled

    def place(self, numbers: npt.NDArray[np.int64], poses: Float64) -> None:
        """Put instances to rest at (N, 4, 4) valid poses."""
        arrays = self.poses, self.spheres, self.halves, self.rows, self.motion, self.rigid
        self.members_changed |= bool(_place(numbers, poses, *arrays))

    def set_off(self, numbers: npt.NDArray[np.int64]) -> None:
        """Note that instances move; their keys come with `set_motions`."""
        self.members_changed = True
        self.rigid[numbers] = False

    def set_motions(self, motions: Mapping[int, Float64]) -> None:
        """Fill `keys` and `motion` for the instances that move, by id (K, 4, 4), and bound all of their way."""
        if not motions:
            self.keys = np.zeros((0, 3, 3), np.float32)
            return
        numbers = np.fromiter(motions, np.int64, len(motions))
        counts = np.array([len(keys) for keys in motions.values()])
        first = np.cumsum(counts) - counts
        self.motion[numbers, 0], self.motion[numbers, 1] = first, counts
        keys = np.concatenate(list(motions.values()))
        linear, owners = keys[:, :3, :3], np.repeat(numbers, counts)
        centres = (linear @ self.spheres[owners, :3, None])[:, :, 0] + keys[:, :3, 3]
        reach = self.spheres[owners, 3] * _largest_stretch(linear)
        way = np.linalg.norm(centres - np.repeat(centres[first], counts, axis=0), axis=1)
        self.rows[numbers, 9:12] = centres[first]
        self.rows[numbers, 12] = np.maximum.reduceat(reach + way, first)
        self.rows[numbers, 14:] = np.inf
        self.keys = linear.astype(np.float32)


def _largest_stretch(linear: Float64) -> Float64:
    """(K,) upper bounds of the spectral norms of matrices (K, 3, 3); those of rotations and scalings themselves."""
    gram = np.abs(linear.transpose(0, 2, 1) @ linear)
    return np.asarray(np.sqrt(gram.sum(axis=1).max(axis=1)))


def checked_pose(T: npt.ArrayLike, name: str) -> Float64:
    """(4, 4) copy of one affine transform; raises as `checked_poses` does, and takes less time."""
    pose = np.array(T, np.float64, order="C")
    if pose.shape != (4, 4) or not _affine(pose):
        return checked_poses(pose, name, 1)[0]
    return pose


def checked_poses(T: npt.ArrayLike, name: str, count: int | None = None) -> Float64:
    """(K, 4, 4) copy of one or several affine transforms.

    Raises:
        InvalidValueError: wrong shape, another number than `count`, or one that is not finite, affine and invertible.
    """
    poses = np.array(T, np.float64, order="C", ndmin=3)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses):
        raise InvalidValueError(name, poses.shape, _AFFINE)
    if count is not None and len(poses) != count:
        raise InvalidValueError(name, poses.shape, f"{count} of {_AFFINE}")
    if not _all_affine(poses):
        raise InvalidValueError(name, poses.tolist(), _AFFINE)
    return poses


@nb.njit(cache=True, nogil=True)
def _determinant(T):
    return (
        T[0, 0] * (T[1, 1] * T[2, 2] - T[1, 2] * T[2, 1])
        - T[0, 1] * (T[1, 0] * T[2, 2] - T[1, 2] * T[2, 0])
        + T[0, 2] * (T[1, 0] * T[2, 1] - T[1, 1] * T[2, 0])
    )


@nb.njit(cache=True, nogil=True)
def _affine(T):
    for i in range(4):
        for j in range(4):
            if not np.isfinite(T[i, j]):
                return False
    last_row = T[3, 0] == 0.0 and T[3, 1] == 0.0 and T[3, 2] == 0.0 and T[3, 3] == 1.0
    return last_row and abs(_determinant(T)) >= 1e-18


@nb.njit(cache=True, nogil=True)
def _all_affine(poses):
    count = 0
    for T in poses:
        count += _affine(T)
    return count == len(poses)


@nb.njit(cache=True, nogil=True)
def _describe(T, sphere, half, row):
    """Normal matrix, bounding sphere and half axes of the box in the map frame."""
    sign = 1.0 if _determinant(T) > 0.0 else -1.0
    cofactors = np.empty((3, 3))
    largest = 0.0
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            cofactors[i, j] = sign * (T[a, c] * T[b, d] - T[a, d] * T[b, c])
            largest = max(largest, abs(cofactors[i, j]))
    square = 0.0  # an upper bound of the squared spectral norm, and equal to it for rotations and scalings
    for i in range(3):
        total = 0.0
        row[9 + i] = T[i, 3] + T[i, 0] * sphere[0] + T[i, 1] * sphere[1] + T[i, 2] * sphere[2]
        for j in range(3):
            row[3 * i + j] = cofactors[i, j] / largest
            row[14 + 3 * i + j] = T[j, i] * half[i]
            total += abs(T[0, i] * T[0, j] + T[1, i] * T[1, j] + T[2, i] * T[2, j])
        square = max(square, total)
    row[12] = sphere[3] * np.sqrt(square)


@nb.njit(cache=True, nogil=True)
def _is_rigid(T):
    for i in range(3):
        for j in range(3):
            product = T[0, i] * T[0, j] + T[1, i] * T[1, j] + T[2, i] * T[2, j]
            if abs(product - (1.0 if i == j else 0.0)) > 1e-7:
                return False
    return _determinant(T) > 0.0


@nb.njit(cache=True, nogil=True)
def _place(numbers, poses, all_poses, spheres, halves, rows, motion, rigid):
    changed = False
    for k in range(numbers.shape[0]):
        number, T = numbers[k], poses[k]
        for i in range(4):
            for j in range(4):
                all_poses[number, i, j] = T[i, j]
        now = _is_rigid(T)
        changed |= rigid[number] != now
        rigid[number] = now
        motion[number, 0], motion[number, 1] = 0, 1
        _describe(T, spheres[number], halves[number], rows[number])
    return changed
