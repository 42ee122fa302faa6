"""Compiled loops that fill Embree's ray packets, trace them and read them back, without the interpreter or its lock.

Layout of RTCRayHitW for W rays, in units of W 4-byte words: origin xyz 0-2, tnear 3, direction xyz 4-6, time 7, tfar 8,
mask 9, id 10, flags 11 | normal xyz 12-14, u 15, v 16, primitive 17, geometry 18, instance 19, instance primitive 20.
Every output element is written from one packet only, so the results do not depend on the number of threads.
"""

from collections.abc import Callable
from functools import lru_cache
from threading import Lock
from typing import Any, NamedTuple

import numba as nb
import numpy as np
from numba import types

_CHUNK = 64
"""Packets a thread takes at a time."""
_COHERENT = np.uint32(1 << 16)
"""RTC_RAY_QUERY_FLAG_COHERENT."""
_POOL_LOCK = Lock()


class InstanceTable(NamedTuple):
    """What kernels must know of the instances, indexed by instance id."""

    normal: np.ndarray
    """(M, 3, 3) float32, takes normals from the mesh to the map frame (inverse transpose, any positive scale)."""
    key_start: np.ndarray
    """(M,) int32, first row in `keys`."""
    key_count: np.ndarray
    """(M,) int32, 1 for an instance at rest."""
    keys: np.ndarray
    """(K, 3, 3) float32, linear parts of the motion keys."""


class PacketKernels(NamedTuple):
    """The two queries of one packet width."""

    cast_bundle: Callable[..., None]
    cast_rays: Callable[..., None]
    occluded: Callable[..., None]


def run(width: int, query: str, *arguments: Any) -> None:
    """Call one query with `numba.get_num_threads()` threads; numba's own pool is entered by one thread at a time."""
    if nb.get_num_threads() == 1:
        getattr(packet_kernels(width, parallel=False), query)(*arguments)
        return
    kernel = getattr(packet_kernels(width, parallel=True), query)
    with _POOL_LOCK:
        kernel(*arguments)


@nb.njit(cache=True, nogil=True)
def _normal_matrix(linear):  # noqa: ANN001, ANN202
    """Cofactor matrix of a (3, 3) with the sign of the determinant: the inverse transpose up to a positive scale."""
    out = np.empty((3, 3), np.float32)
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            out[i, j] = linear[a, c] * linear[b, d] - linear[a, d] * linear[b, c]
    determinant = linear[0, 0] * out[0, 0] + linear[0, 1] * out[0, 1] + linear[0, 2] * out[0, 2]
    return -out if determinant < 0 else out


@nb.njit(cache=True, nogil=True)
def _moving_normal_matrix(table, instance, time):  # noqa: ANN001, ANN202
    """Normal matrix between two motion keys, which Embree interpolates linearly."""
    segments = table.key_count[instance] - 1
    position = min(max(time, np.float32(0.0)), np.float32(1.0)) * segments
    segment = min(int(position), segments - 1)
    fraction = np.float32(position - segment)
    row = table.key_start[instance] + segment
    return _normal_matrix((np.float32(1) - fraction) * table.keys[row] + fraction * table.keys[row + 1])


@lru_cache(maxsize=4)
def packet_kernels(width: int, parallel: bool) -> PacketKernels:
    """Kernels for packets of `width` rays (8 or 16). The symbols must have been registered: see `embree.embree`."""
    intersect = types.ExternalFunction(f"rtcIntersect{width}", types.void(*[types.intp] * 4))
    occlude = types.ExternalFunction(f"rtcOccluded{width}", types.void(*[types.intp] * 4))
    lanes = width
    words = 21 * width
    spare = 16  # words, to start the packet at a multiple of 64 bytes

    @nb.njit(cache=True, nogil=True)
    def aligned(count):  # noqa: ANN001, ANN202
        raw = np.zeros(count + spare, np.float32)
        return raw[(-raw.ctypes.data % 64) // 4 :]

    @nb.njit(cache=True, nogil=True)
    def arguments(coherent):  # noqa: ANN001, ANN202
        """RTCIntersectArguments and RTCOccludedArguments: flags, feature mask, three null pointers."""
        query = np.zeros(16, np.uint32)
        query[0] = _COHERENT if coherent else np.uint32(0)
        query[1] = np.uint32(0xFFFFFFFF)
        return query

    @nb.njit(cache=True, nogil=True)
    def new_packet(tnear, time):  # noqa: ANN001, ANN202
        packet = aligned(words)
        integers = packet.view(np.int32)
        for k in range(lanes):
            packet[3 * lanes + k] = tnear
            packet[7 * lanes + k] = time
            integers[9 * lanes + k] = -1
            integers[10 * lanes + k] = k
        return packet, integers

    @nb.njit(cache=True, nogil=True)
    def all_lanes():  # noqa: ANN202
        valid = aligned(lanes).view(np.int32)
        valid[:lanes] = -1
        return valid

    @nb.njit(cache=True, nogil=True)
    def read(packet, integers, order, base, table, distances, normals, faces, instances):  # noqa: ANN001, ANN202
        """Copy the hits of one packet to the outputs, normals turned into the map frame."""
        for k in range(lanes):
            ray = order[base + k]
            instance = integers[19 * lanes + k]
            if instance < 0:
                distances[ray] = np.inf
                faces[ray] = -1
                instances[ray] = -1
                normals[ray, 0] = 0.0
                normals[ray, 1] = 0.0
                normals[ray, 2] = 0.0
                continue
            distances[ray] = packet[8 * lanes + k]
            faces[ray] = integers[17 * lanes + k]
            instances[ray] = instance
            m = table.normal[instance]
            if table.key_count[instance] > 1:
                m = _moving_normal_matrix(table, instance, packet[7 * lanes + k])
            a, b, c = packet[12 * lanes + k], packet[13 * lanes + k], packet[14 * lanes + k]
            x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c
            y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c
            z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c
            scale = np.float32(1.0) / np.sqrt(x * x + y * y + z * z)
            normals[ray, 0] = x * scale
            normals[ray, 1] = y * scale
            normals[ray, 2] = z * scale

    @nb.njit(cache=True, nogil=True, parallel=parallel)
    def cast_bundle(  # noqa: ANN202
        scene, packed, order, rotation, origin, near, far, time, table, distances, normals, faces, instances  # noqa: ANN001
    ):
        blocks = packed.shape[0]
        chunks = (blocks + _CHUNK - 1) // _CHUNK
        for c in nb.prange(chunks):
            packet, integers = new_packet(near, time)
            valid, query = all_lanes(), arguments(True)
            for k in range(lanes):
                packet[k], packet[lanes + k], packet[2 * lanes + k] = origin[0], origin[1], origin[2]
            for block in range(c * _CHUNK, min((c + 1) * _CHUNK, blocks)):
                for axis in range(3):
                    r0, r1, r2 = rotation[axis, 0], rotation[axis, 1], rotation[axis, 2]
                    for k in range(lanes):
                        packet[(4 + axis) * lanes + k] = (
                            r0 * packed[block, 0, k] + r1 * packed[block, 1, k] + r2 * packed[block, 2, k]
                        )
                for k in range(lanes):
                    packet[8 * lanes + k] = far
                    integers[18 * lanes + k] = -1
                    integers[19 * lanes + k] = -1
                intersect(valid.ctypes.data, scene, packet.ctypes.data, query.ctypes.data)
                read(packet, integers, order, block * lanes, table, distances, normals, faces, instances)

    @nb.njit(cache=True, nogil=True)
    def load(packet, integers, valid, order, base, origins, directions, times, far):  # noqa: ANN001, ANN202
        """Fill one packet with rays of their own origin and time; a ray that is not finite or has no direction is off."""
        for k in range(lanes):
            ray = order[base + k]
            checksum = np.float32(0.0)
            length = np.float32(0.0)
            for axis in range(3):
                packet[axis * lanes + k] = origins[ray, axis]
                packet[(4 + axis) * lanes + k] = directions[ray, axis]
                checksum += np.float32(0.0) * (origins[ray, axis] + directions[ray, axis])
                length += abs(directions[ray, axis])
            if times.shape[0] > 0:
                packet[7 * lanes + k] = times[ray]
                checksum += np.float32(0.0) * times[ray]
            packet[8 * lanes + k] = far
            integers[18 * lanes + k] = -1
            integers[19 * lanes + k] = -1
            valid[k] = -1 if checksum == 0.0 and length > 0.0 else 0

    @nb.njit(cache=True, nogil=True, parallel=parallel)
    def cast_rays(  # noqa: ANN202
        scene, origins, directions, times, order, near, far, coherent, table, distances, normals, faces, instances  # noqa: ANN001
    ):
        blocks = order.shape[0] // lanes
        chunks = (blocks + _CHUNK - 1) // _CHUNK
        for c in nb.prange(chunks):
            packet, integers = new_packet(near, np.float32(0.0))
            valid, query = all_lanes(), arguments(coherent)
            for block in range(c * _CHUNK, min((c + 1) * _CHUNK, blocks)):
                load(packet, integers, valid, order, block * lanes, origins, directions, times, far)
                intersect(valid.ctypes.data, scene, packet.ctypes.data, query.ctypes.data)
                read(packet, integers, order, block * lanes, table, distances, normals, faces, instances)

    @nb.njit(cache=True, nogil=True, parallel=parallel)
    def occluded(scene, origins, directions, times, order, near, distances, blocked):  # noqa: ANN001, ANN202
        blocks = order.shape[0] // lanes
        chunks = (blocks + _CHUNK - 1) // _CHUNK
        for c in nb.prange(chunks):
            packet, integers = new_packet(near, np.float32(0.0))
            valid, query = all_lanes(), arguments(False)
            for block in range(c * _CHUNK, min((c + 1) * _CHUNK, blocks)):
                load(packet, integers, valid, order, block * lanes, origins, directions, times, np.float32(0.0))
                for k in range(lanes):
                    far = distances[order[block * lanes + k]]
                    packet[8 * lanes + k] = far
                    if not far > near:
                        valid[k] = 0
                occlude(valid.ctypes.data, scene, packet.ctypes.data, query.ctypes.data)
                for k in range(lanes):
                    blocked[order[block * lanes + k]] = valid[k] != 0 and packet[8 * lanes + k] < 0.0

    return PacketKernels(cast_bundle, cast_rays, occluded)
