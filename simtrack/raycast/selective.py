"""Compiled loops that look for some instances of a scene only: rays that cannot meet them are not traced."""

import numba as nb
import numpy as np

from simtrack.raycast import packets
from simtrack.raycast.kernels import (
    CHUNK,
    GROUND,
    GROUND_COHERENT,
    GROUP,
    OTHERS,
    OTHERS_COHERENT,
    Bundle,
    World,
    any_meets,
    chunk_count,
    discs_of,
    product,
    to_trace,
)
from simtrack.raycast.vector import rotate


@nb.njit(cache=True, nogil=True)
def _keep(lanes, packet, integers, order, base, wanted, rays, distances, normals, faces, instances, at):
    """Append the lanes of a packet that met a wanted instance to the outputs; returns where the next one goes."""
    width = len(lanes)
    for k in range(width):
        instance = integers[19 * width + k]
        if not wanted[instance]:
            continue
        ray = order[base + k]
        if k > 0 and ray == order[base + k - 1]:  # a spare lane
            continue
        rays[at], distances[at] = ray, packet[8 * width + k]
        faces[at], instances[at] = integers[17 * width + k], instance
        for axis in range(3):
            normals[at, axis] = packet[(12 + axis) * width + k]
        at += 1
    return at


@nb.njit(cache=True, nogil=True)
def _any_wanted(lanes, integers, ground_id, wanted):
    """Whether a lane of a packet has met a wanted instance."""
    width, found = len(lanes), False
    for k in range(width):
        if integers[17 * width + k] >= 0:
            instance = integers[19 * width + k]
            found |= wanted[ground_id if instance < 0 else instance]
    return found


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _chunk(chunk, lanes, world_fields, bundle_fields, discs, wanted, near, far, together, out, counts):
    width, world, bundle = len(lanes), World(*world_fields), Bundle(*bundle_fields)
    rays, distances, normals, faces, instances = out
    packet, integers, valid = packets.new_packet(lanes, near, bundle.time)
    arguments = packets.arguments()
    others, ground, ground_id, _, _, rows, motion, keys = world_fields
    p_valid, p_packet, p_together = packets.address(valid), packets.address(packet), packets.address(arguments)
    p_alone, p_pose, p_ground = p_together + 64, packets.address(bundle.pose), packets.address(bundle.ground_pose)
    p_packed, p_discs = packets.address(bundle.packed), packets.address(discs)
    p_rows, p_motion = packets.address(rows), packets.address(motion)
    met, blocks, order = np.empty(discs.shape[0], np.int64), bundle.packed.shape[0], bundle.order
    on_ground = ground != 0 and wanted[ground_id]
    at = chunk * CHUNK * width
    for first in range(chunk * CHUNK, min((chunk + 1) * CHUNK, blocks), GROUP):
        flags, count = to_trace(world, bundle.cones, first // GROUP, discs, GROUP * width, met)
        if together >= 0:
            flags = flags & (OTHERS | GROUND) | (together * (OTHERS_COHERENT | GROUND_COHERENT))
        if not flags & (OTHERS | GROUND if on_ground else OTHERS):
            continue
        for block in range(first, min(first + GROUP, blocks)):
            directions = p_packed + 12 * block * width
            if not (on_ground or any_meets(lanes, directions, p_discs, met, count)):
                continue
            packets.reset(lanes, p_packet, far)
            if others:
                packets.stand(lanes, p_packet, p_pose)
                rotate(lanes, p_pose, directions, p_packet + 16 * width)
                packets.intersect(lanes, p_valid, others, p_packet, p_together if flags & OTHERS_COHERENT else p_alone)
            if flags & GROUND and (on_ground or _any_wanted(lanes, integers, ground_id, wanted)):
                packets.stand(lanes, p_packet, p_ground)
                rotate(lanes, p_ground, directions, p_packet + 16 * width)
                packets.intersect(lanes, p_valid, ground, p_packet, p_together if flags & GROUND_COHERENT else p_alone)
            if not _any_wanted(lanes, integers, ground_id, wanted):
                continue
            if not packets.turn_alike(lanes, p_packet, ground_id, p_rows, p_motion):
                packets.turn_mixed(lanes, packet, integers, ground_id, rows, motion, keys)
            base = block * width
            at = _keep(lanes, packet, integers, order, base, wanted, rays, distances, normals, faces, instances, at)
    counts[chunk] = at - chunk * CHUNK * width
    return valid[0] + np.int32(arguments[0, 0]) + np.int32(discs[0, 0])


@nb.njit(cache=True, nogil=True)
def _close_gaps(counts, stride, out):
    """Move what the chunks found together, in their order; returns how much that is."""
    rays, distances, normals, faces, instances = out
    total = 0
    for chunk in range(counts.shape[0]):
        for k in range(chunk * stride, chunk * stride + counts[chunk]):
            rays[total], distances[total] = rays[k], distances[k]
            faces[total], instances[total] = faces[k], instances[k]
            for axis in range(3):
                normals[total, axis] = normals[k, axis]
            total += 1
    return total


@nb.njit(cache=True, nogil=True)
def _listed(wanted, ground_id):
    """Wanted instances but the ground."""
    count = 0
    for number in range(wanted.shape[0] - 1):
        count += wanted[number] and number != ground_id
    out = np.empty(count, np.int32)
    for number in range(wanted.shape[0] - 2, -1, -1):
        if wanted[number] and number != ground_id:
            count -= 1
            out[count] = number
    return out


@nb.njit(cache=True, nogil=True)
def cast_selected(
    lanes, others, ground, ground_id, T_ground_map, listed, rows, motion, keys, wanted,
    packed, order, cones, T_map_sensor, time, near, far, together, rays, distances, normals, faces, instances,
):  # fmt: skip
    """Nearest hits of a bundle that are on `wanted` instances, on the calling thread; returns how many there are.

    `wanted` holds a flag for each instance id, and False at the end, which the number of a miss, -1, finds.
    """
    world = others, ground, ground_id, T_ground_map, _listed(wanted, ground_id), rows, motion, keys
    pose, ground_pose = T_map_sensor[:3].astype(np.float32), product(T_ground_map, T_map_sensor)
    bundle = packed, order, cones, pose, ground_pose, np.float32(time)
    out = rays, distances, normals, faces, instances
    discs, counts = discs_of(World(*world), pose), np.zeros(chunk_count(order, lanes), np.int64)
    for chunk in range(counts.shape[0]):
        _chunk(chunk, lanes, world, bundle, discs, wanted, np.float32(near), np.float32(far), together, out, counts)
    return _close_gaps(counts, CHUNK * len(lanes), out)


@nb.njit(cache=True, nogil=True, parallel=True)
def cast_selected_parallel(
    lanes, others, ground, ground_id, T_ground_map, listed, rows, motion, keys, wanted,
    packed, order, cones, T_map_sensor, time, near, far, together, rays, distances, normals, faces, instances,
):  # fmt: skip
    """`cast_selected` on numba's threads."""
    world = others, ground, ground_id, T_ground_map, _listed(wanted, ground_id), rows, motion, keys
    pose, ground_pose = T_map_sensor[:3].astype(np.float32), product(T_ground_map, T_map_sensor)
    bundle = packed, order, cones, pose, ground_pose, np.float32(time)
    out = rays, distances, normals, faces, instances
    discs, counts = discs_of(World(*world), pose), np.zeros(chunk_count(order, lanes), np.int64)
    for chunk in nb.prange(counts.shape[0]):
        _chunk(chunk, lanes, world, bundle, discs, wanted, np.float32(near), np.float32(far), together, out, counts)
    return _close_gaps(counts, CHUNK * len(lanes), out)
