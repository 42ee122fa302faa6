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
    coherent: bool
    """Whether the rays of a packet meet the same parts of the scene."""


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


SMALL = 4096
"""So few rays are faster cast by the calling thread alone."""


def run(count: int, serial: Any, parallel: Any, *arguments: Any) -> None:
    """Call a kernel for `count` rays with `numba.get_num_threads()` threads, which one caller at a time may use."""
    if count <= SMALL or nb.get_num_threads() == 1:
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
def _occlude(lanes, valid, scene, packet, query):
    if len(lanes) == 16:
        _rtcOccluded16(valid.ctypes.data, scene, packet.ctypes.data, query.ctypes.data)
    else:
        _rtcOccluded8(valid.ctypes.data, scene, packet.ctypes.data, query.ctypes.data)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _turn_mixed(lanes, packet, integers, table):
    """Normals of a packet whose lanes met different instances, moving ones or nothing, in place."""
    width = len(lanes)
    for k in range(width):
        instance = integers[19 * width + k]
        if instance < 0:
            packet[8 * width + k] = np.inf
            integers[17 * width + k] = -1
            for axis in range(3):
                packet[(12 + axis) * width + k] = 0.0
            continue
        m = table.normal[instance]
        if table.key_count[instance] > 1:
            m = _moving_normal_matrix(table, instance, packet[7 * width + k])
        a, b, c = packet[12 * width + k], packet[13 * width + k], packet[14 * width + k]
        x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c
        y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c
        z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c
        scale = np.float32(1.0) / np.sqrt(x * x + y * y + z * z)
        packet[12 * width + k] = x * scale
        packet[13 * width + k] = y * scale
        packet[14 * width + k] = z * scale


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _read(lanes, packet, integers, order, base, table, turn, resting, distances, normals, faces, instances):
    """Copy the hits of one packet to the outputs, normals turned into the map frame.

    Inlined and on plain arrays: array arguments of a call, and fields of a tuple, are reference-counted each time.
    """
    width = len(lanes)
    first = integers[19 * width]
    uniform = first >= 0 and resting[first] == 1
    for k in range(width):
        uniform &= integers[19 * width + k] == first
    if uniform:  # nearly always, and then one vector loop does
        xx, xy, xz = turn[first, 0, 0], turn[first, 0, 1], turn[first, 0, 2]
        yx, yy, yz = turn[first, 1, 0], turn[first, 1, 1], turn[first, 1, 2]
        zx, zy, zz = turn[first, 2, 0], turn[first, 2, 1], turn[first, 2, 2]
        for k in range(width):
            a, b, c = packet[12 * width + k], packet[13 * width + k], packet[14 * width + k]
            x = xx * a + xy * b + xz * c
            y = yx * a + yy * b + yz * c
            z = zx * a + zy * b + zz * c
            scale = np.float32(1.0) / np.sqrt(x * x + y * y + z * z)
            packet[12 * width + k] = x * scale
            packet[13 * width + k] = y * scale
            packet[14 * width + k] = z * scale
    else:
        _turn_mixed(lanes, packet, integers, table)
    for k in range(width):
        ray = np.uint32(order[base + k])
        distances[ray] = packet[8 * width + k]
        faces[ray] = integers[17 * width + k]
        instances[ray] = integers[19 * width + k]
        normals[ray, 0] = packet[12 * width + k]
        normals[ray, 1] = packet[13 * width + k]
        normals[ray, 2] = packet[14 * width + k]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _bundle_chunk(chunk, lanes, scene, bundle, near, far, table, out):
    width = len(lanes)
    packet, integers, valid, query = _new_packet(lanes, near, bundle.time, bundle.coherent)
    # Addresses as numbers; the arrays live until the end of the function because the loop uses them.
    p_valid, p_packet, p_query = valid.ctypes.data, packet.ctypes.data, query.ctypes.data
    packed, order, rotation = bundle.packed, bundle.order, bundle.rotation
    turn, resting = table.normal, table.key_count
    distances, normals, faces, instances = out
    for axis in range(3):
        for k in range(width):
            packet[axis * width + k] = bundle.origin[axis]
    for block in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, packed.shape[0])):
        for axis in range(3):
            r0, r1, r2 = rotation[axis, 0], rotation[axis, 1], rotation[axis, 2]
            for k in range(width):
                packet[(4 + axis) * width + k] = (
                    r0 * packed[block, 0, k] + r1 * packed[block, 1, k] + r2 * packed[block, 2, k]
                )
        for k in range(width):
            packet[8 * width + k] = far
            integers[18 * width + k] = -1
            integers[19 * width + k] = -1
        if width == 16:
            _rtcIntersect16(p_valid, scene, p_packet, p_query)
        else:
            _rtcIntersect8(p_valid, scene, p_packet, p_query)
        base = block * width
        _read(lanes, packet, integers, order, base, table, turn, resting, distances, normals, faces, instances)
    return valid[0] + np.int32(query[0])  # keeps both alive


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


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _rays_chunk(chunk, lanes, scene, rays, near, far, coherent, table, out):
    width = len(lanes)
    packet, integers, valid, query = _new_packet(lanes, near, np.float32(0.0), coherent)
    p_valid, p_packet, p_query = valid.ctypes.data, packet.ctypes.data, query.ctypes.data
    order, turn, resting = rays.order, table.normal, table.key_count
    distances, normals, faces, instances = out
    for block in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, order.shape[0] // width)):
        base = block * width
        _load(lanes, packet, integers, valid, rays, base, far)
        if width == 16:
            _rtcIntersect16(p_valid, scene, p_packet, p_query)
        else:
            _rtcIntersect8(p_valid, scene, p_packet, p_query)
        _read(lanes, packet, integers, order, base, table, turn, resting, distances, normals, faces, instances)
    return valid[0] + np.int32(query[0])  # keeps both alive


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
