"""Many instances at a time: placing and moving them in compiled loops, and the table that ray kernels read.

Through ctypes an instance costs about as much as casting a hundred rays; a room comes into reach with dozens of them.
"""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numba import njit, types

from simtrack.contracts import Float32, Float64
from simtrack.raycast import embree as rtc
from simtrack.raycast.kernels import InstanceTable

if TYPE_CHECKING:
    from simtrack.raycast.scene import Instance

_p, _u, _i = types.intp, types.uint32, types.int32
_rtcNewGeometry = types.ExternalFunction("rtcNewGeometry", _p(_p, _i))
_rtcSetGeometryInstancedScene = types.ExternalFunction("rtcSetGeometryInstancedScene", types.void(_p, _p))
_rtcSetGeometryTimeStepCount = types.ExternalFunction("rtcSetGeometryTimeStepCount", types.void(_p, _u))
_rtcSetGeometryTransform = types.ExternalFunction("rtcSetGeometryTransform", types.void(_p, _u, _i, _p))
_rtcCommitGeometry = types.ExternalFunction("rtcCommitGeometry", types.void(_p))
_rtcAttachGeometryByID = types.ExternalFunction("rtcAttachGeometryByID", types.void(_p, _p, _u))
_rtcReleaseGeometry = types.ExternalFunction("rtcReleaseGeometry", types.void(_p))
_rtcDetachGeometry = types.ExternalFunction("rtcDetachGeometry", types.void(_p, _u))

_INSTANCE, _COLUMNS = np.int32(rtc.RTC_GEOMETRY_TYPE_INSTANCE), np.int32(rtc.RTC_FORMAT_FLOAT3X4_COLUMN_MAJOR)


def columns(transforms: Float64) -> Float32:
    """(N, 12) the upper three rows of transforms (N, 4, 4), column by column, as Embree takes them."""
    return np.ascontiguousarray(transforms[:, :3].transpose(0, 2, 1), np.float32).reshape(-1, 12)


@njit(cache=True, nogil=True)
def place(device, top, meshes, numbers, transforms, geometries):
    """Instance the scenes `meshes` (N,) in the scene `top` under `numbers` (N,); writes their addresses (N,)."""
    for k in range(numbers.shape[0]):
        geometry = _rtcNewGeometry(device, _INSTANCE)
        geometries[k] = geometry
        _rtcSetGeometryInstancedScene(geometry, meshes[k])
        _rtcSetGeometryTransform(geometry, np.uint32(0), _COLUMNS, transforms.ctypes.data + 48 * k)
        _rtcCommitGeometry(geometry)
        _rtcAttachGeometryByID(top, geometry, np.uint32(numbers[k]))
        _rtcReleaseGeometry(geometry)  # the scene keeps it


@njit(cache=True, nogil=True)
def move(geometries, transforms):
    """Set instances (N,) at rest to `transforms` (N, 12)."""
    for k in range(geometries.shape[0]):
        _rtcSetGeometryTimeStepCount(geometries[k], np.uint32(1))
        _rtcSetGeometryTransform(geometries[k], np.uint32(0), _COLUMNS, transforms.ctypes.data + 48 * k)
        _rtcCommitGeometry(geometries[k])


@njit(cache=True, nogil=True)
def detach(top, numbers):
    """Take instances out of a scene."""
    for k in range(numbers.shape[0]):
        _rtcDetachGeometry(top, np.uint32(numbers[k]))


class TableKeeper:
    """Keeps the kernels' table in step with the instances; what changed is written anew, no more."""

    def __init__(self) -> None:
        self._changed: set[int] = set()
        self._table = InstanceTable(
            np.zeros((0, 3, 3), np.float32),
            np.zeros(0, np.int32),
            np.zeros(0, np.int32),
            np.zeros((0, 3, 3), np.float32),
        )

    def changed(self, numbers: Iterable[int]) -> None:
        """Remember instances that were added or moved, or that move differently."""
        self._changed.update(numbers)

    def update(self, instances: "Mapping[int, Instance]") -> InstanceTable:
        """The table of the instances as they are now."""
        rows = sorted(number for number in self._changed if number in instances)
        self._changed.clear()
        if not rows:
            return self._table
        self._grow(rows[-1] + 1)
        table, entries = self._table, [instances[number] for number in rows]
        table.normal[rows] = _normal_matrices(np.array([entry.keys[0] for entry in entries]))
        if (table.key_count[rows] > 1).any() or any(len(entry.keys) > 1 for entry in entries):
            self._write_motion(instances)
        return self._table

    def _grow(self, size: int) -> None:
        old = len(self._table.normal)
        if size <= old:
            return
        more = max(size, 2 * old) - old
        normal = np.concatenate([self._table.normal, np.zeros((more, 3, 3), np.float32)])
        start = np.concatenate([self._table.key_start, np.zeros(more, np.int32)])
        count = np.concatenate([self._table.key_count, np.ones(more, np.int32)])
        self._table = InstanceTable(normal, start, count, self._table.keys)

    def _write_motion(self, instances: "Mapping[int, Instance]") -> None:
        self._table.key_start[:], self._table.key_count[:] = 0, 1
        keys, rows = [np.zeros((0, 3, 3))], 0
        for number in sorted(number for number, entry in instances.items() if len(entry.keys) > 1):
            linear = instances[number].keys[:, :3, :3]
            self._table.key_start[number], self._table.key_count[number] = rows, len(linear)
            keys.append(linear)
            rows += len(linear)
        self._table = self._table._replace(keys=np.concatenate(keys).astype(np.float32))


def _normal_matrices(transforms: Float64) -> Float64:
    """(N, 3, 3) inverse transposes, scaled, of the linear parts of transforms (N, 4, 4)."""
    matrices = np.linalg.inv(transforms[:, :3, :3]).transpose(0, 2, 1)
    return np.asarray(matrices / np.abs(matrices).max(axis=(1, 2), keepdims=True))
