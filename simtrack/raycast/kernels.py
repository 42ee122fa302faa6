"""Compiled loops over ray packets (see `simtrack.raycast.packets`), without the interpreter or its lock.

Every output element is written from one packet only, so the results do not depend on the number of threads.

A scene is two hierarchies (see `World`): the ground, traced in its own frame, and the other instances. Groups of
packets whose cone meets no other instance's sphere trace the ground alone, and packets keep together only where that
pays: rays that meet a triangle each are traced faster one by one.

What Python calls takes plain arrays and numbers, because numba takes named tuples apart slowly, and hands them to the
chunks as plain tuples, because parallel loops do not know the names.
"""

from threading import Lock
from typing import Any, NamedTuple

import numba as nb
import numpy as np

from simtrack.raycast import packets
from simtrack.raycast.box_cone import box_cosine, nearest_in_box
from simtrack.raycast.vector import allow, any_within, carray, gather, gather_vectors, pointer, rotate

GROUP = 8
"""Packets of a bundle that share a cone."""
CHUNK = 8 * GROUP
"""Packets a thread takes at a time."""
_FACES_PER_RAY = 0.3
"""Rays are traced one by one where an instance has more faces than this for each ray that its bounding sphere takes.

Measured: packets and single rays are equally fast with 0.4 visible triangles a ray, packets twice as slow with 2.
"""
SMALL = 4096
"""So few rays are faster cast by the calling thread alone."""
_POOL_LOCK = Lock()

OTHERS, GROUND, OTHERS_COHERENT, GROUND_COHERENT = 1, 2, 4, 8
"""Flags of `to_trace`."""


class World(NamedTuple):
    """What kernels must know of a scene; see `simtrack.raycast.table.InstanceTable` for the arrays."""

    others: int
    """Address of the RTCScene of all instances but the ground, 0 if there are none."""
    ground: int
    """Address of the ground's own RTCScene, 0 without a ground."""
    ground_id: int
    """Instance id of the ground, -1 without one."""
    T_ground_map: np.ndarray
    """(4, 4) float64, rigid."""
    listed: np.ndarray
    """(L,) int32, ids of the other instances, or empty: there may be any number, anywhere."""
    rows: np.ndarray
    """(M, 23) float32, by instance id: normal matrix, bounding sphere, faces, half axes of the box."""
    motion: np.ndarray
    """(M, 2) int32, by instance id: first row in `keys`, number of keys (1 at rest)."""
    keys: np.ndarray
    """(K, 3, 3) float32, linear parts of the motion keys."""


class Bundle(NamedTuple):
    """Rays from one origin; see `simtrack.raycast.bundle.RayBundle`."""

    packed: np.ndarray
    """(B, 3, W) float32, sensor frame."""
    order: np.ndarray
    """(B * W,) int32."""
    cones: np.ndarray
    """(B / GROUP, 6) float32, sensor frame: axis, and of the half opening angle cosine, sine and 1 - cosine."""
    pose: np.ndarray
    """(3, 4) float32, map from sensor."""
    ground_pose: np.ndarray
    """(3, 4) float32, ground's mesh from sensor."""
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


def run(count: int, serial: Any, parallel: Any, *arguments: Any) -> Any:
    """Call a kernel for `count` rays with `numba.get_num_threads()` threads, which one caller at a time may use."""
    if count <= SMALL or nb.get_num_threads() == 1:
        return serial(*arguments)
    with _POOL_LOCK:
        return parallel(*arguments)


# ----------------------------------------------------------------------------------------------- rays from one origin


@nb.njit(cache=True, nogil=True, error_model="numpy")
def discs_of(world, pose):
    """(L + 1, 6) float32, sensor frame: the listed instances, then the ground, as the sensor sees them.

    A direction, cosine and sine of the angle that sphere or box takes around it, whichever is smaller, and faces of the
    sphere by 1 - cosine. No faces where the sphere holds the sensor (packets keep together among walls), and cosine -1
    where the box does, too, or where the pose is no rigid motion.
    """
    count = world.listed.shape[0]
    out, ahead = np.zeros((count + 1, 6), np.float32), np.empty(3, np.float32)
    out[:, 3] = -1.0
    for a in range(3):
        for b in range(3):
            product = pose[0, a] * pose[0, b] + pose[1, a] * pose[1, b] + pose[2, a] * pose[2, b]
            if abs(product - (1.0 if a == b else 0.0)) > 1e-5:
                return out
    for j in range(count + 1):
        if j == count and world.ground == 0:
            break
        row = world.rows[world.listed[j] if j < count else world.ground_id]
        offset = row[9:12] - pose[:, 3]
        square = offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2]
        rounding = np.abs(row[9:12]).sum() + np.abs(pose[:, 3]).sum() + row[12]
        radius = row[12] + np.float32(2e-6) * rounding
        distance, margin = np.sqrt(square), np.float32(2e-6) * rounding
        if square > radius * radius:
            sine = radius / distance
            cosine = np.sqrt(np.float32(1.0) - sine * sine)
            out[j, 5] = row[13] * (np.float32(1.0) + cosine) / (sine * sine)
            cosine = max(cosine, box_cosine(offset, row[14:23], offset, distance, margin))
        else:
            distance = nearest_in_box(offset, row[14:23], ahead)
            cosine = box_cosine(offset, row[14:23], ahead, distance, margin)
            offset = ahead
        if not cosine > 0.0:
            continue
        for axis in range(3):
            turned = pose[0, axis] * offset[0] + pose[1, axis] * offset[1] + pose[2, axis] * offset[2]
            out[j, axis] = turned / distance
        out[j, 3], out[j, 4] = cosine, np.sqrt(np.float32(1.0) - cosine * cosine)
    return out


@nb.njit(cache=True, nogil=True)
def _meets(cone, disc):
    """Whether a cone of rays may meet a sphere; margins cover the rounding."""
    if cone[3] <= -disc[3] + np.float32(2e-6):
        return True
    cosine = cone[0] * disc[0] + cone[1] * disc[1] + cone[2] * disc[2]
    return cosine >= cone[3] * disc[3] - cone[4] * disc[4] - np.float32(2e-6)


@nb.njit(cache=True, nogil=True)
def to_trace(world, cones, group, discs, rays, met):
    """Which hierarchies the packets of a group may have to be traced in, and how: flags; and how many discs are `met`.

    `rays` is their number. With others to trace and none met, there is no telling which they are.
    """
    flags, count = 0, 0
    last = discs.shape[0] - 1
    if cones.shape[0] == 0:
        flags = OTHERS_COHERENT | GROUND_COHERENT
        return flags | (OTHERS if world.others else 0) | (GROUND if world.ground else 0), 0
    cone = cones[group]
    limit = np.float32(_FACES_PER_RAY) * np.float32(rays)
    if world.others and last == 0:
        flags = OTHERS | OTHERS_COHERENT
    for j in range(last):
        if _meets(cone, discs[j]):
            met[count] = j
            count += 1
            flags |= OTHERS
            if discs[j, 5] * cone[5] <= limit:
                flags |= OTHERS_COHERENT
    if world.ground and _meets(cone, discs[last]):
        flags |= GROUND
        if discs[last, 5] * cone[5] <= limit:
            flags |= GROUND_COHERENT
    return flags, count


@nb.njit(cache=True, nogil=True)
def any_meets(lanes, directions, discs, met, count):
    """Whether a ray of a packet (addresses of the directions and discs) may meet one of the first `count` of `met`."""
    for k in range(count):
        disc = discs + 24 * met[k]
        cosine = carray(pointer(disc), 4, np.float32)[3] - np.float32(2e-6)
        if cosine < np.float32(0.01) or any_within(lanes, directions, disc, cosine):
            return True
    return count == 0


@nb.njit(cache=True, nogil=True)
def _met_before(lanes, rays, instances, changed):
    """Whether a ray of a packet met a changed instance; addresses of the packet's rays, and of what each ray met."""
    order, found = carray(pointer(rays), len(lanes), np.int32), False
    for k in range(len(lanes)):
        found |= changed[carray(pointer(instances + 4 * np.intp(order[k])), 1, np.int32)[0]]
    return found


@nb.njit(cache=True, nogil=True)
def _only_changed(listed, met, count, changed):
    """Move those of the first `count` of `met` to the front whose instances have changed; returns their number."""
    kept = 0
    for k in range(count):
        if changed[listed[met[k]]]:
            met[k], met[kept] = met[kept], met[k]
            kept += 1
    return kept


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _bundle_chunk(chunk, lanes, world_fields, bundle_fields, discs, near, far, together, changed, out):
    width, world, bundle = len(lanes), World(*world_fields), Bundle(*bundle_fields)
    packet, integers, valid = packets.new_packet(lanes, near, bundle.time)
    arguments = packets.arguments()
    others, ground, ground_id, _, _, rows, motion, keys = world_fields
    # Addresses as numbers; the arrays live until the end of the function because it returns something of them.
    p_valid, p_packet, p_together = packets.address(valid), packets.address(packet), packets.address(arguments)
    p_alone, p_pose = p_together + 64, packets.address(bundle.pose)
    p_ground_pose, apart = packets.address(bundle.ground_pose), (bundle.ground_pose != bundle.pose).any()
    p_packed, p_order = packets.address(bundle.packed), packets.address(bundle.order)
    p_rows, p_motion = packets.address(rows), packets.address(motion)
    p_distances, p_normals, p_faces, p_instances = out
    pdiscs_of, met = packets.address(discs), np.empty(discs.shape[0], np.int64)
    blocks, cones = bundle.packed.shape[0], bundle.cones
    # Where the discs do not tell where the others stand, and where the ground has changed, all is new.
    anew = changed.shape[0] == 0 or cones.shape[0] == 0 or discs.shape[0] == 1 or changed[ground_id]
    packets.stand(lanes, p_packet, p_pose)
    for first in range(chunk * CHUNK, min((chunk + 1) * CHUNK, blocks), GROUP):
        flags, count = to_trace(world, cones, first // GROUP, discs, GROUP * width, met)
        if together >= 0:
            flags = flags & (OTHERS | GROUND) | (together * (OTHERS_COHERENT | GROUND_COHERENT))
        moved = 0 if anew else _only_changed(world.listed, met, count, changed)
        for block in range(first, min(first + GROUP, blocks)):
            rays = p_order + 4 * block * width
            directions = p_packed + 12 * block * width
            touched = anew or _met_before(lanes, rays, p_instances, changed)
            if not (touched or (moved and any_meets(lanes, directions, pdiscs_of, met, moved))):
                continue
            packets.announce(lanes, block, rays, p_distances, p_normals, p_faces, p_instances)
            packets.reset(lanes, p_packet, far)
            aimed = flags & OTHERS and any_meets(lanes, directions, pdiscs_of, met, count)
            if aimed:
                if apart:
                    packets.stand(lanes, p_packet, p_pose)
                rotate(lanes, p_pose, directions, p_packet + 16 * width)
                packets.intersect(lanes, p_valid, others, p_packet, p_together if flags & OTHERS_COHERENT else p_alone)
            if flags & GROUND:
                if apart:
                    packets.stand(lanes, p_packet, p_ground_pose)
                if apart or not aimed:
                    rotate(lanes, p_ground_pose, directions, p_packet + 16 * width)
                packets.intersect(lanes, p_valid, ground, p_packet, p_together if flags & GROUND_COHERENT else p_alone)
            if not packets.turn_alike(lanes, p_packet, ground_id, p_rows, p_motion):
                packets.turn_mixed(lanes, packet, integers, ground_id, rows, motion, keys)
            packets.write(lanes, p_packet, rays, p_distances, p_normals, p_faces, p_instances)
    return valid[0] + np.int32(arguments[0, 0]) + np.int32(discs[0, 0])


@nb.njit(cache=True, nogil=True)
def product(A, B):
    """(3, 4) float32, the upper rows of the product of two affine (4, 4)."""
    out = np.empty((3, 4), np.float32)
    for i in range(3):
        for j in range(4):
            value = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
            out[i, j] = value + (A[i, 3] if j == 3 else 0.0)
    return out


@nb.njit(cache=True, nogil=True)
def _addresses(distances, normals, faces, instances):
    """Addresses of the output arrays, which the caller's caller holds."""
    return packets.address(distances), packets.address(normals), packets.address(faces), packets.address(instances)


@nb.njit(cache=True, nogil=True)
def chunk_count(order, lanes):
    """Number of chunks of packets."""
    return (order.shape[0] // len(lanes) + CHUNK - 1) // CHUNK


@nb.njit(cache=True, nogil=True)
def cast_bundle(
    lanes, others, ground, ground_id, T_ground_map, listed, rows, motion, keys,
    packed, order, cones, T_map_sensor, time, near, far, together, changed, distances, normals, faces, instances,
):  # fmt: skip
    """Nearest hits of a bundle, on the calling thread.

    `together` is 1 or 0 for `coherent`, -1 to decide by group. `changed` is empty, or holds a flag for each instance
    id, and False at the end, which the number of a miss, -1, finds: then the outputs are those of an earlier call, and
    only packets are traced for which such an instance makes a difference.
    """
    world = others, ground, ground_id, T_ground_map, listed, rows, motion, keys
    pose, ground_pose = T_map_sensor[:3].astype(np.float32), product(T_ground_map, T_map_sensor)
    bundle = packed, order, cones, pose, ground_pose, np.float32(time)
    out = _addresses(distances, normals, faces, instances)
    discs = discs_of(World(*world), pose)
    for chunk in range(chunk_count(order, lanes)):
        _bundle_chunk(chunk, lanes, world, bundle, discs, np.float32(near), np.float32(far), together, changed, out)


@nb.njit(cache=True, nogil=True, parallel=True)
def cast_bundle_parallel(
    lanes, others, ground, ground_id, T_ground_map, listed, rows, motion, keys,
    packed, order, cones, T_map_sensor, time, near, far, together, changed, distances, normals, faces, instances,
):  # fmt: skip
    """`cast_bundle` on numba's threads."""
    world = others, ground, ground_id, T_ground_map, listed, rows, motion, keys
    pose, ground_pose = T_map_sensor[:3].astype(np.float32), product(T_ground_map, T_map_sensor)
    bundle = packed, order, cones, pose, ground_pose, np.float32(time)
    out = _addresses(distances, normals, faces, instances)
    discs = discs_of(World(*world), pose)
    for chunk in nb.prange(chunk_count(order, lanes)):
        _bundle_chunk(chunk, lanes, world, bundle, discs, np.float32(near), np.float32(far), together, changed, out)


# --------------------------------------------------------------------------------------------- rays of their own origin


@nb.njit(cache=True, nogil=True, inline="always")
def _load(lanes, packet, valid, order, origins, directions, times):
    """Fill one packet with rays of their own origin and time; a ray that is not finite or has no direction is off.

    All but `lanes` are addresses, `order` that of the packet's rays; `times` is 0 if there are none.
    """
    row = 4 * len(lanes)
    gather_vectors(lanes, origins, order, packet)
    gather_vectors(lanes, directions, order, packet + 4 * row)
    if times:
        gather(lanes, times, order, packet + 7 * row)
    allow(lanes, packet, valid)


@nb.njit(cache=True, nogil=True)
def _addresses_of_rays(rays):
    """Addresses of origins, directions and, if there are any, times, which the caller holds."""
    times = packets.address(rays.times) if rays.times.shape[0] > 0 else np.intp(0)
    return packets.address(rays.origins), packets.address(rays.directions), times


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _rays_chunk(chunk, lanes, world, ray_fields, near, far, coherent, out):
    width, rays = len(lanes), Rays(*ray_fields)
    packet, integers, valid = packets.new_packet(lanes, near, np.float32(0.0))
    arguments = packets.arguments()
    p_valid, p_packet, p_arguments = (
        packets.address(valid),
        packets.address(packet),
        packets.address(arguments) + (0 if coherent else 64),
    )
    others, ground, ground_id, T_ground_map, _, rows, motion, keys = world
    p_rows, p_motion, p_order = packets.address(rows), packets.address(motion), packets.address(rays.order)
    pose = T_ground_map[:3].astype(np.float32)
    p_pose = packets.address(pose)
    p_origins, p_directions, p_times = _addresses_of_rays(rays)
    p_distances, p_normals, p_faces, p_instances = out
    for block in range(chunk * CHUNK, min((chunk + 1) * CHUNK, rays.order.shape[0] // width)):
        base = block * width
        packets.reset(lanes, p_packet, far)
        _load(lanes, p_packet, p_valid, p_order + 4 * base, p_origins, p_directions, p_times)
        if others:
            packets.intersect(lanes, p_valid, others, p_packet, p_arguments)
        if ground:
            packets.carry(lanes, p_packet, p_pose)
            packets.intersect(lanes, p_valid, ground, p_packet, p_arguments)
        if not packets.turn_alike(lanes, p_packet, ground_id, p_rows, p_motion):
            packets.turn_mixed(lanes, packet, integers, ground_id, rows, motion, keys)
        packets.write(lanes, p_packet, p_order + 4 * base, p_distances, p_normals, p_faces, p_instances)
    return valid[0] + np.int32(arguments[0, 0]) + np.int32(pose[0, 0])


@nb.njit(cache=True, nogil=True)
def cast_rays(
    lanes, others, ground, ground_id, T_ground_map, listed, rows, motion, keys,
    origins, directions, times, order, near, far, coherent, distances, normals, faces, instances,
):  # fmt: skip
    """Nearest hits of single rays, on the calling thread."""
    world = others, ground, ground_id, T_ground_map, listed, rows, motion, keys
    rays, out = (origins, directions, times, order), _addresses(distances, normals, faces, instances)
    for chunk in range(chunk_count(order, lanes)):
        _rays_chunk(chunk, lanes, world, rays, np.float32(near), np.float32(far), coherent, out)


@nb.njit(cache=True, nogil=True, parallel=True)
def cast_rays_parallel(
    lanes, others, ground, ground_id, T_ground_map, listed, rows, motion, keys,
    origins, directions, times, order, near, far, coherent, distances, normals, faces, instances,
):  # fmt: skip
    """`cast_rays` on numba's threads."""
    world = others, ground, ground_id, T_ground_map, listed, rows, motion, keys
    rays, out = (origins, directions, times, order), _addresses(distances, normals, faces, instances)
    for chunk in nb.prange(chunk_count(order, lanes)):
        _rays_chunk(chunk, lanes, world, rays, np.float32(near), np.float32(far), coherent, out)


@nb.njit(cache=True, nogil=True)
def _occluded_chunk(chunk, lanes, others, ground, T_ground_map, ray_fields, near, limits, blocked):
    rays = Rays(*ray_fields)
    packet, _, valid = packets.new_packet(lanes, near, np.float32(0.0))
    arguments = packets.arguments()
    p_valid, p_packet, p_arguments = packets.address(valid), packets.address(packet), packets.address(arguments) + 64
    pose = T_ground_map[:3].astype(np.float32)
    p_pose, p_order = packets.address(pose), packets.address(rays.order)
    p_origins, p_directions, p_times = _addresses_of_rays(rays)
    for block in range(chunk * CHUNK, min((chunk + 1) * CHUNK, rays.order.shape[0] // len(lanes))):
        base = block * len(lanes)
        _load(lanes, p_packet, p_valid, p_order + 4 * base, p_origins, p_directions, p_times)
        for k in range(len(lanes)):
            limit = limits[rays.order[base + k]]
            packet[8 * len(lanes) + k] = limit
            if not limit > near:
                valid[k] = 0
        if others:
            packets.occlude(lanes, p_valid, others, p_packet, p_arguments)
        if ground:
            packets.carry(lanes, p_packet, p_pose)
            packets.occlude(lanes, p_valid, ground, p_packet, p_arguments)
        for k in range(len(lanes)):
            blocked[rays.order[base + k]] = valid[k] != 0 and packet[8 * len(lanes) + k] < 0.0
    return valid[0] + np.int32(arguments[0, 0]) + np.int32(pose[0, 0])


@nb.njit(cache=True, nogil=True)
def occluded(lanes, others, ground, T_ground_map, origins, directions, times, order, near, limits, blocked):
    """Whether anything is nearer than `limits`, on the calling thread."""
    rays = origins, directions, times, order
    for chunk in range(chunk_count(order, lanes)):
        _occluded_chunk(chunk, lanes, others, ground, T_ground_map, rays, np.float32(near), limits, blocked)


@nb.njit(cache=True, nogil=True, parallel=True)
def occluded_parallel(lanes, others, ground, T_ground_map, origins, directions, times, order, near, limits, blocked):
    """`occluded` on numba's threads."""
    rays = origins, directions, times, order
    for chunk in nb.prange(chunk_count(order, lanes)):
        _occluded_chunk(chunk, lanes, others, ground, T_ground_map, rays, np.float32(near), limits, blocked)
