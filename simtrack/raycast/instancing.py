"""Many instances at a time: Embree's part of placing, moving and removing them, in compiled loops.

Through ctypes an instance costs about as much as casting a hundred rays; a room comes into reach with dozens of them.
"""

import numpy as np
from numba import njit, types

from simtrack.contracts import Float32, Float64
from simtrack.raycast import embree as rtc

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
def move(geometries, numbers, poses):
    """Set the instances `numbers` (N,) to rest at their `poses`, where they have a geometry (see `InstanceTable`)."""
    columns = np.empty(12, np.float32)
    for number in numbers:
        if geometries[number] == 0:
            continue
        for j in range(4):
            for i in range(3):
                columns[3 * j + i] = poses[number, i, j]
        _rtcSetGeometryTimeStepCount(geometries[number], np.uint32(1))
        _rtcSetGeometryTransform(geometries[number], np.uint32(0), _COLUMNS, columns.ctypes.data)
        _rtcCommitGeometry(geometries[number])


@njit(cache=True, nogil=True)
def set_off(geometries, transforms):
    """Let instances (N,) move through `transforms` (N, K, 12) at equidistant times from 0 to 1."""
    count = transforms.shape[1]
    for k in range(geometries.shape[0]):
        _rtcSetGeometryTimeStepCount(geometries[k], np.uint32(count))
        for step in range(count):
            address = transforms.ctypes.data + 48 * (k * count + step)
            _rtcSetGeometryTransform(geometries[k], np.uint32(step), _COLUMNS, address)
        _rtcCommitGeometry(geometries[k])


@njit(cache=True, nogil=True)
def detach(top, numbers):
    """Take instances out of a scene."""
    for k in range(numbers.shape[0]):
        _rtcDetachGeometry(top, np.uint32(numbers[k]))
