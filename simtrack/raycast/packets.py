"""Embree's ray packets: filling them, tracing them, reading them back.

Layout of RTCRayHitW for W rays, in units of W 4-byte words: origin xyz 0-2, tnear 3, direction xyz 4-6, time 7, tfar 8,
mask 9, id 10, flags 11 | normal xyz 12-14, u 15, v 16, primitive 17, geometry 18, instance 19, instance primitive 20.

`lanes` is a tuple as long as the packet is wide: the type fixes its length, so that loops over lanes unroll. What runs
for each packet is inlined, because calls hand over all of its elements.
"""

import numba as nb
import numpy as np
from numba import types

from simtrack.raycast.vector import (
    carray,
    fill_float,
    fill_int,
    move,
    pointer,
    prefetch,
    rotate,
    scatter,
    scatter_vectors,
    uniformity,
    unit_normals,
)

ROW = 23
"""Numbers in a row of `simtrack.raycast.table.InstanceTable.rows`."""
_COHERENT = np.uint32(1 << 16)
"""RTC_RAY_QUERY_FLAG_COHERENT."""

# numba does not cache kernels that hold an address; a symbol's name is cached, and `embree.embree` registers it.
_QUERY = types.void(types.intp, types.intp, types.intp, types.intp)
_rtcIntersect8 = types.ExternalFunction("rtcIntersect8", _QUERY)
_rtcIntersect16 = types.ExternalFunction("rtcIntersect16", _QUERY)
_rtcOccluded8 = types.ExternalFunction("rtcOccluded8", _QUERY)
_rtcOccluded16 = types.ExternalFunction("rtcOccluded16", _QUERY)


@nb.njit(cache=True, nogil=True)
def address(array):
    """Where an array's numbers stand, as a signed number: sums of unsigned and signed ones are floats in numba."""
    return np.intp(array.ctypes.data)


@nb.njit(cache=True, nogil=True)
def aligned(words):
    """At least `words` zeroed float32 from a multiple of 64 bytes on."""
    raw = np.zeros(words + 16, np.float32)
    return raw[(-raw.ctypes.data % 64) // 4 :]


@nb.njit(cache=True, nogil=True)
def new_packet(lanes, near, time):
    """Packet with its constant fields set, the same memory as integers, and lane mask."""
    packet = aligned(21 * len(lanes))
    integers = packet.view(np.int32)
    for k in range(len(lanes)):
        packet[3 * len(lanes) + k] = near
        packet[7 * len(lanes) + k] = time
        integers[9 * len(lanes) + k] = -1
        integers[10 * len(lanes) + k] = k
    valid = aligned(len(lanes)).view(np.int32)
    valid[: len(lanes)] = -1
    return packet, integers, valid


@nb.njit(cache=True, nogil=True)
def arguments():
    """(2, 16) RTCIntersectArguments (flags, feature mask, null pointers): for rays that keep together, and not."""
    words = np.zeros((2, 16), np.uint32)
    words[0, 0] = _COHERENT
    words[:, 1] = np.uint32(0xFFFFFFFF)
    return words


@nb.njit(cache=True, nogil=True, inline="always")
def intersect(lanes, valid, scene, packet, arguments):
    """Nearest hits of a packet in a scene; all but `lanes` are addresses."""
    if len(lanes) == 16:
        _rtcIntersect16(valid, scene, packet, arguments)
    else:
        _rtcIntersect8(valid, scene, packet, arguments)


@nb.njit(cache=True, nogil=True)
def occlude(lanes, valid, scene, packet, arguments):
    """Whether anything is met: such lanes get a far distance of -inf; all but `lanes` are addresses."""
    if len(lanes) == 16:
        _rtcOccluded16(valid, scene, packet, arguments)
    else:
        _rtcOccluded8(valid, scene, packet, arguments)


@nb.njit(cache=True, nogil=True, inline="always")
def reset(lanes, packet, far):
    """Make a packet (its address) ready for another query: nothing met up to `far`."""
    row = 4 * len(lanes)
    fill_float(lanes, packet + 8 * row, far)
    fill_int(lanes, packet + 17 * row, np.int32(-1))
    fill_int(lanes, packet + 19 * row, np.int32(-1))


@nb.njit(cache=True, nogil=True, inline="always")
def stand(lanes, packet, pose):
    """All rays of a packet from the origin of a (3, 4) pose; addresses of both."""
    width = len(lanes)
    entries = carray(pointer(pose), 12, np.float32)
    for axis in range(3):
        fill_float(lanes, packet + 4 * axis * width, entries[4 * axis + 3])


@nb.njit(cache=True, nogil=True, inline="always")
def carry(lanes, packet, pose):
    """Take a packet's rays to another frame; addresses of the packet and of a rigid (3, 4) pose."""
    width = len(lanes)
    move(lanes, pose, packet, packet)
    rotate(lanes, pose, packet + 16 * width, packet + 16 * width)


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
def _moving_normal_matrix(motion, keys, instance, time):
    """(9,) normal matrix between two motion keys, which Embree interpolates linearly."""
    segments = motion[instance, 1] - 1
    position = min(max(time, np.float32(0.0)), np.float32(1.0)) * segments
    segment = min(int(position), segments - 1)
    fraction = np.float32(position - segment)
    row = motion[instance, 0] + segment
    return _normal_matrix((np.float32(1) - fraction) * keys[row] + fraction * keys[row + 1]).reshape(9)


@nb.njit(cache=True, nogil=True, inline="always")
def turn_alike(lanes, packet, ground_id, rows, motion):
    """Normals of a packet (its address), if all lanes met the same instance at rest or nothing; returns whether so.

    That is nearly always the case, and then few vector operations do. `rows` and `motion` are the tables' addresses.
    """
    width = len(lanes)
    normals = packet + 48 * width
    common = uniformity(lanes, packet + 76 * width, packet + 68 * width)
    if common == 0:
        return False
    if common == 1:
        fill_float(lanes, packet + 32 * width, np.float32(np.inf))
        for axis in range(3):
            fill_float(lanes, normals + 4 * axis * width, np.float32(0.0))
        return True
    first = carray(pointer(packet + 76 * width), 1, np.int32)[0]
    met = ground_id if first < 0 else first  # the ground is no instance to Embree
    if carray(pointer(motion + 8 * met), 2, np.int32)[1] > 1:
        return False
    unit_normals(lanes, rows + 4 * ROW * met, normals, normals)
    fill_int(lanes, packet + 76 * width, np.int32(met))
    return True


@nb.njit(cache=True, nogil=True, error_model="numpy")
def turn_mixed(lanes, packet, integers, ground_id, rows, motion, keys):
    """Normals of a packet whose lanes met different instances, moving ones or nothing, in place."""
    width = len(lanes)
    for k in range(width):
        if integers[17 * width + k] < 0:
            packet[8 * width + k] = np.inf
            for axis in range(3):
                packet[(12 + axis) * width + k] = 0.0
            continue
        if integers[19 * width + k] < 0:
            integers[19 * width + k] = ground_id
        instance = integers[19 * width + k]
        m = rows[instance, :9]
        if motion[instance, 1] > 1:
            m = _moving_normal_matrix(motion, keys, instance, packet[7 * width + k])
        a, b, c = packet[12 * width + k], packet[13 * width + k], packet[14 * width + k]
        x = m[0] * a + m[1] * b + m[2] * c
        y = m[3] * a + m[4] * b + m[5] * c
        z = m[6] * a + m[7] * b + m[8] * c
        scale = np.float32(1.0) / np.sqrt(x * x + y * y + z * z)
        packet[12 * width + k] = x * scale
        packet[13 * width + k] = y * scale
        packet[14 * width + k] = z * scale


@nb.njit(cache=True, nogil=True, inline="always")
def announce(lanes, block, order, distances, normals, faces, instances):
    """Begin to fetch where a packet's hits will be written: tracing takes long enough for that; see `write`.

    Two lanes will do, other ones each time, and of the shorter arrays half of them: neighbours share cache lines.
    """
    half = len(lanes) // 2
    for lane in (block % half, block % half + half):
        ray = np.intp(carray(pointer(order + 4 * lane), 1, np.int32)[0])
        prefetch(normals + 12 * ray)
        if ray & 4 == 0:
            prefetch(distances + 4 * ray)
            prefetch(faces + 4 * ray)
            prefetch(instances + 4 * ray)


@nb.njit(cache=True, nogil=True, inline="always")
def write(lanes, packet, order, distances, normals, faces, instances):
    """Copy the hits of one packet to the outputs; all arguments are addresses, `order` that of the packet's rays."""
    row = 4 * len(lanes)
    scatter(lanes, packet + 8 * row, order, distances)
    scatter(lanes, packet + 17 * row, order, faces)
    scatter(lanes, packet + 19 * row, order, instances)
    scatter_vectors(lanes, packet + 12 * row, order, normals)
