"""Compiled loops that fill Embree's ray packets, trace them and read them back, without the interpreter or its lock.

Layout of RTCRayHitW for W rays, in units of W 4-byte words: origin xyz 0-2, tnear 3, direction xyz 4-6, time 7, tfar 8,
mask 9, id 10, flags 11 | normal xyz 12-14, u 15, v 16, primitive 17, geometry 18, instance 19, instance primitive 20.
Every output element is written from one packet only, so the results do not depend on the number of threads.
"""

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

# numba does not cache kernels that hold an address; a symbol's name is cached, and `embree.embree` registers it.
_QUERY = types.void(types.intp, types.intp, types.intp, types.intp)
_rtcIntersect8 = types.ExternalFunction("rtcIntersect8", _QUERY)
_rtcIntersect16 = types.ExternalFunction("rtcIntersect16", _QUERY)
_rtcOccluded8 = types.ExternalFunction("rtcOccluded8", _QUERY)
_rtcOccluded16 = types.ExternalFunction("rtcOccluded16", _QUERY)


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


class Bundle(NamedTuple):
    """Rays from one origin; the fields are arguments of `cast`."""

    packed: np.ndarray
    """(B, 3, W) float32, sensor frame."""
    order: np.ndarray
    """(B * W,) int32."""
    rotation: np.ndarray
    """(3, 3) float32, map from sensor."""
    origin: np.ndarray
    """(3,) float32, map frame."""
    time: np.float32


class Rays(NamedTuple):
    """Rays of their own origin and time, map frame."""

    origins: np.ndarray
    """(N, 3) float32."""
    directions: np.ndarray
    """(N, 3) float32."""
    times: np.ndarray
    """(N,) float32, or empty for time 0."""
    order: np.ndarray
    """(B * W,) int32."""


class Output(NamedTuple):
    """The arrays of `RayHits`."""

    distances: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    instances: np.ndarray


def run(serial: Any, parallel: Any, *arguments: Any) -> None:
    """Call a kernel with `numba.get_num_threads()` threads; numba's own pool is entered by one thread at a time."""
    if nb.get_num_threads() == 1:
        serial(*arguments)
        return
    with _POOL_LOCK:
        parallel(*arguments)


@nb.njit(cache=True, nogil=True)
def _normal_matrix(linear):
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
def _moving_normal_matrix(table, instance, time):
    """Normal matrix between two motion keys, which Embree interpolates linearly."""
    segments = table.key_count[instance] - 1
    position = min(max(time, np.float32(0.0)), np.float32(1.0)) * segments
    segment = min(int(position), segments - 1)
    fraction = np.float32(position - segment)
    row = table.key_start[instance] + segment
    return _normal_matrix((np.float32(1) - fraction) * table.keys[row] + fraction * table.keys[row + 1])


@nb.njit(cache=True, nogil=True)
def _aligned(words):
    """At least `words` zeroed float32 from a multiple of 64 bytes on."""
    raw = np.zeros(words + 16, np.float32)
    return raw[(-raw.ctypes.data % 64) // 4 :]


@nb.njit(cache=True, nogil=True)
def _new_packet(lanes, near, time, coherent):
    """Packet with its constant fields set, lane mask, and query arguments (flags, feature mask, null pointers).

    `lanes` is a tuple as long as the packet is wide: the type fixes its length, so that loops over lanes unroll.
    """
    packet = _aligned(21 * len(lanes))
    integers = packet.view(np.int32)
    for k in range(len(lanes)):
        packet[3 * len(lanes) + k] = near
        packet[7 * len(lanes) + k] = time
        integers[9 * len(lanes) + k] = -1
        integers[10 * len(lanes) + k] = k
    valid = _aligned(len(lanes)).view(np.int32)
    valid[: len(lanes)] = -1
    query = np.zeros(16, np.uint32)
    query[0] = _COHERENT if coherent else np.uint32(0)
    query[1] = np.uint32(0xFFFFFFFF)
    return packet, integers, valid, query


@nb.njit(cache=True, nogil=True)
def _intersect(lanes, valid, scene, packet, query):
    if len(lanes) == 16:
        _rtcIntersect16(valid.ctypes.data, scene, packet.ctypes.data, query.ctypes.data)
    else:
        _rtcIntersect8(valid.ctypes.data, scene, packet.ctypes.data, query.ctypes.data)


@nb.njit(cache=True, nogil=True)
def _occlude(lanes, valid, scene, packet, query):
    if len(lanes) == 16:
        _rtcOccluded16(valid.ctypes.data, scene, packet.ctypes.data, query.ctypes.data)
    else:
        _rtcOccluded8(valid.ctypes.data, scene, packet.ctypes.data, query.ctypes.data)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _turn_normals(lanes, packet, m, first, last):
    """Normals of some lanes, in place: mesh frame, any length -> map frame, unit."""
    width = len(lanes)
    for k in range(first, last):
        a, b, c = packet[12 * width + k], packet[13 * width + k], packet[14 * width + k]
        x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c
        y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c
        z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c
        scale = np.float32(1.0) / np.sqrt(x * x + y * y + z * z)
        packet[12 * width + k] = x * scale
        packet[13 * width + k] = y * scale
        packet[14 * width + k] = z * scale


@nb.njit(cache=True, nogil=True)
def _read(lanes, packet, integers, order, base, table, out):
    """Copy the hits of one packet to the outputs, normals turned into the map frame."""
    width = len(lanes)
    instance = integers[19 * width]
    uniform = instance >= 0
    for k in range(width):
        uniform &= integers[19 * width + k] == instance
    if uniform and table.key_count[instance] == 1:  # nearly always, and then one vector loop does
        _turn_normals(lanes, packet, table.normal[instance], 0, width)
    else:
        for k in range(width):
            instance = integers[19 * width + k]
            if instance < 0:
                packet[8 * width + k] = np.inf
                integers[17 * width + k] = -1
                for axis in range(3):
                    packet[(12 + axis) * width + k] = 0.0
            elif table.key_count[instance] > 1:
                turn = _moving_normal_matrix(table, instance, packet[7 * width + k])
                _turn_normals(lanes, packet, turn, k, k + 1)
            else:
                _turn_normals(lanes, packet, table.normal[instance], k, k + 1)
    for k in range(width):
        ray = np.uint32(order[base + k])
        out.distances[ray] = packet[8 * width + k]
        out.faces[ray] = integers[17 * width + k]
        out.instances[ray] = integers[19 * width + k]
        for axis in range(3):
            out.normals[ray, axis] = packet[(12 + axis) * width + k]


@nb.njit(cache=True, nogil=True)
def _bundle_chunk(chunk, lanes, scene, bundle, near, far, table, out):
    packet, integers, valid, query = _new_packet(lanes, near, bundle.time, True)
    for axis in range(3):
        for k in range(len(lanes)):
            packet[axis * len(lanes) + k] = bundle.origin[axis]
    for block in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, bundle.packed.shape[0])):
        for axis in range(3):
            r0, r1, r2 = bundle.rotation[axis, 0], bundle.rotation[axis, 1], bundle.rotation[axis, 2]
            for k in range(len(lanes)):
                x, y, z = bundle.packed[block, 0, k], bundle.packed[block, 1, k], bundle.packed[block, 2, k]
                packet[(4 + axis) * len(lanes) + k] = r0 * x + r1 * y + r2 * z
        for k in range(len(lanes)):
            packet[8 * len(lanes) + k] = far
            integers[18 * len(lanes) + k] = -1
            integers[19 * len(lanes) + k] = -1
        _intersect(lanes, valid, scene, packet, query)
        _read(lanes, packet, integers, bundle.order, block * len(lanes), table, out)


@nb.njit(cache=True, nogil=True)
def _load(lanes, packet, integers, valid, rays, base, far):
    """Fill one packet with rays of their own origin and time; a ray that is not finite or has no direction is off."""
    for k in range(len(lanes)):
        ray = rays.order[base + k]
        poison = np.float32(0.0)
        length = np.float32(0.0)
        for axis in range(3):
            packet[axis * len(lanes) + k] = rays.origins[ray, axis]
            packet[(4 + axis) * len(lanes) + k] = rays.directions[ray, axis]
            poison += np.float32(0.0) * (rays.origins[ray, axis] + rays.directions[ray, axis])
            length += abs(rays.directions[ray, axis])
        if rays.times.shape[0] > 0:
            packet[7 * len(lanes) + k] = rays.times[ray]
            poison += np.float32(0.0) * rays.times[ray]
        packet[8 * len(lanes) + k] = far
        integers[18 * len(lanes) + k] = -1
        integers[19 * len(lanes) + k] = -1
        valid[k] = -1 if poison == 0.0 and length > 0.0 else 0


@nb.njit(cache=True, nogil=True)
def _rays_chunk(chunk, lanes, scene, rays, near, far, coherent, table, out):
    packet, integers, valid, query = _new_packet(lanes, near, np.float32(0.0), coherent)
    for block in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, rays.order.shape[0] // len(lanes))):
        _load(lanes, packet, integers, valid, rays, block * len(lanes), far)
        _intersect(lanes, valid, scene, packet, query)
        _read(lanes, packet, integers, rays.order, block * len(lanes), table, out)


@nb.njit(cache=True, nogil=True)
def _occluded_chunk(chunk, lanes, scene, rays, near, distances, blocked):
    packet, integers, valid, query = _new_packet(lanes, near, np.float32(0.0), False)
    for block in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, rays.order.shape[0] // len(lanes))):
        base = block * len(lanes)
        _load(lanes, packet, integers, valid, rays, base, np.float32(0.0))
        for k in range(len(lanes)):
            packet[8 * len(lanes) + k] = distances[rays.order[base + k]]
            if not distances[rays.order[base + k]] > near:
                valid[k] = 0
        _occlude(lanes, valid, scene, packet, query)
        for k in range(len(lanes)):
            blocked[rays.order[base + k]] = valid[k] != 0 and packet[8 * len(lanes) + k] < 0.0


@nb.njit(cache=True, nogil=True)
def cast_bundle(lanes, scene, bundle, near, far, table, out):
    """Nearest hits of a bundle, on the calling thread."""
    for chunk in range((bundle.order.shape[0] // len(lanes) + _CHUNK - 1) // _CHUNK):
        _bundle_chunk(chunk, lanes, scene, bundle, near, far, table, out)


@nb.njit(cache=True, nogil=True, parallel=True)
def cast_bundle_parallel(lanes, scene, bundle, near, far, table, out):
    """`cast_bundle` on numba's threads."""
    for chunk in nb.prange((bundle.order.shape[0] // len(lanes) + _CHUNK - 1) // _CHUNK):
        _bundle_chunk(chunk, lanes, scene, bundle, near, far, table, out)


@nb.njit(cache=True, nogil=True)
def cast_rays(lanes, scene, rays, near, far, coherent, table, out):
    """Nearest hits of single rays, on the calling thread."""
    for chunk in range((rays.order.shape[0] // len(lanes) + _CHUNK - 1) // _CHUNK):
        _rays_chunk(chunk, lanes, scene, rays, near, far, coherent, table, out)


@nb.njit(cache=True, nogil=True, parallel=True)
def cast_rays_parallel(lanes, scene, rays, near, far, coherent, table, out):
    """`cast_rays` on numba's threads."""
    for chunk in nb.prange((rays.order.shape[0] // len(lanes) + _CHUNK - 1) // _CHUNK):
        _rays_chunk(chunk, lanes, scene, rays, near, far, coherent, table, out)


@nb.njit(cache=True, nogil=True)
def occluded(lanes, scene, rays, near, distances, blocked):
    """Whether anything is nearer than `distances`, on the calling thread."""
    for chunk in range((rays.order.shape[0] // len(lanes) + _CHUNK - 1) // _CHUNK):
        _occluded_chunk(chunk, lanes, scene, rays, near, distances, blocked)
