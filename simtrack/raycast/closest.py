"""Nearest surface points of posed instances, by Embree's point queries with a compiled callback."""

from typing import Any

import numba as nb
import numpy as np
from numba import types

from simtrack.raycast.vector import carray, pointer

_CHUNK = 256
"""Points a thread takes at a time."""

_rtcPointQuery = types.ExternalFunction(
    "rtcPointQuery", types.boolean(types.intp, types.intp, types.intp, types.intp, types.intp)
)


@nb.njit(cache=True, nogil=True, inline="always")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@nb.njit(cache=True, nogil=True, inline="always")
def _minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def closest_on_triangle(p, a, b, c):
    """(s, t) so that ``a + s (b - a) + t (c - a)`` is the point of a triangle nearest to p, all tuples of three.

    Ericson, Real-Time Collision Detection, 5.1.5; degenerate triangles are points and segments.
    """
    ab, ac, ap = _minus(b, a), _minus(c, a), _minus(p, a)
    d1, d2 = _dot(ab, ap), _dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return 0.0, 0.0
    bp = _minus(p, b)
    d3, d4 = _dot(ab, bp), _dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return 1.0, 0.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0 and d1 > d3:
        return d1 / (d1 - d3), 0.0
    cp = _minus(p, c)
    d5, d6 = _dot(ab, cp), _dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 1.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0 and d2 > d6:
        return 0.0, d2 / (d2 - d6)
    va = d3 * d6 - d5 * d4
    along = (d4 - d3) + (d5 - d6)
    if va <= 0.0 and d4 >= d3 and d5 >= d6 and along > 0.0:
        t = (d4 - d3) / along
        return 1.0 - t, t
    area = va + vb + vc
    if not area > 0.0:
        return 0.0, 0.0
    return vb / area, vc / area


@nb.njit(cache=True, nogil=True)
def _corner(vertices, index, pose):
    """Vertex under a (16,) pose, as a tuple."""
    x, y, z = vertices[3 * index], vertices[3 * index + 1], vertices[3 * index + 2]
    return (
        pose[0] * x + pose[1] * y + pose[2] * z + pose[3],
        pose[4] * x + pose[5] * y + pose[6] * z + pose[7],
        pose[8] * x + pose[9] * y + pose[10] * z + pose[11],
    )


@nb.njit(cache=True, nogil=True, error_model="numpy")
def search(points, corners, instance, out):
    """Exhaustive search for (N, 3) float64 points among triangles (F, 3, 3), map frame; keeps what `out` has nearer."""
    found_points, distances, instances, faces = out
    for f in range(corners.shape[0]):
        a = corners[f, 0, 0], corners[f, 0, 1], corners[f, 0, 2]
        b = corners[f, 1, 0], corners[f, 1, 1], corners[f, 1, 2]
        c = corners[f, 2, 0], corners[f, 2, 1], corners[f, 2, 2]
        ab, ac = _minus(b, a), _minus(c, a)
        reach = np.sqrt(max(_dot(ab, ab), _dot(ac, ac)))
        for i in range(points.shape[0]):
            p = points[i, 0], points[i, 1], points[i, 2]
            ap = _minus(p, a)
            bound = distances[i] + reach
            if _dot(ap, ap) > bound * bound:
                continue
            s, t = closest_on_triangle(p, a, b, c)
            x, y, z = a[0] + s * ab[0] + t * ac[0], a[1] + s * ab[1] + t * ac[1], a[2] + s * ab[2] + t * ac[2]
            distance = np.sqrt((x - p[0]) ** 2 + (y - p[1]) ** 2 + (z - p[2]) ** 2)
            if distance < distances[i]:
                distances[i], instances[i], faces[i] = distance, instance, f
                found_points[i, 0], found_points[i, 1], found_points[i, 2] = x, y, z


def _nearer(arguments: Any) -> Any:
    """RTCPointQueryFunction: measure one triangle in the map frame and shrink the query if it is the nearest so far.

    The map frame serves rigid, scaled, sheared and mirrored instances alike. `userPtr` leads to seven int64: instance
    and face found, addresses of the buffers' table, of the poses, and of four float64 (squared distance, point), then
    the instance of a mesh that is queried by itself, in its own frame, and the address of an identity pose.
    """
    words = carray(pointer(arguments), 5, np.int64)  # query, userPtr, primitive | geometry, context, scale
    state = carray(pointer(words[1]), 7, np.int64)
    best = carray(pointer(state[4]), 4, np.float64)
    query = carray(pointer(words[0]), 5, np.float32)
    met = np.int64(carray(pointer(words[3]), 36, np.int32)[32])
    instance = met if met >= 0 else state[5]
    face = words[2] & 0xFFFFFFFF
    buffers = carray(pointer(state[2] + 16 * instance), 2, np.int64)
    pose = carray(pointer(state[3] + 128 * met if met >= 0 else state[6]), 16, np.float64)
    corners = carray(pointer(buffers[1] + 12 * face), 3, np.uint32)
    vertices = carray(pointer(buffers[0]), 1 << 40, np.float32)  # the true length is not needed
    a = _corner(vertices, np.int64(corners[0]), pose)
    b = _corner(vertices, np.int64(corners[1]), pose)
    c = _corner(vertices, np.int64(corners[2]), pose)
    p = (np.float64(query[0]), np.float64(query[1]), np.float64(query[2]))
    s, t = closest_on_triangle(p, a, b, c)
    x = a[0] + s * (b[0] - a[0]) + t * (c[0] - a[0])
    y = a[1] + s * (b[1] - a[1]) + t * (c[1] - a[1])
    z = a[2] + s * (b[2] - a[2]) + t * (c[2] - a[2])
    squared = (x - p[0]) ** 2 + (y - p[1]) ** 2 + (z - p[2]) ** 2
    if squared >= best[0]:
        return 0
    best[0], best[1], best[2], best[3] = squared, x, y, z
    state[0], state[1] = instance, face
    query[4] = np.float32(np.sqrt(squared))
    return 1


_callback: Any = nb.cfunc(types.uint8(types.intp), cache=True)(_nearer)
CALLBACK: int = _callback.address
"""Address of the compiled callback, which lives as long as the module."""


@nb.njit(cache=True, nogil=True)
def _moved(T, x, y, z):
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@nb.njit(cache=True, nogil=True)
def _chunk(chunk, scenes, callback, points, limit, buffers, poses, out):
    others, ground, ground_id, T_ground_map = scenes
    found_points, distances, instances, faces = out
    # RTCPointQuery, RTCPointQueryContext (two 4x4 matrices, instance id, instance primitive, stack size), our state.
    raw = np.zeros(128, np.float32)
    aligned = raw[(-raw.ctypes.data % 64) // 4 :]
    query, context = aligned[:16], aligned[16:64]
    context_words = context.view(np.uint32)
    state, best, identity = np.zeros(7, np.int64), np.zeros(4, np.float64), np.eye(4)
    state[2], state[3], state[4], state[5] = buffers.ctypes.data, poses.ctypes.data, best.ctypes.data, ground_id
    state[6] = identity.ctypes.data
    for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, points.shape[0])):
        best[0] = np.float64(limit) * np.float64(limit)
        state[0], state[1] = -1, -1
        context_words[32], context_words[33], context_words[34] = 0xFFFFFFFF, 0, 0
        if np.isfinite(points[i, 0] + points[i, 1] + points[i, 2]):
            if others:
                query[0], query[1], query[2], query[3], query[4] = points[i, 0], points[i, 1], points[i, 2], 0.0, limit
                _rtcPointQuery(others, query.ctypes.data, context.ctypes.data, callback, state.ctypes.data)
            if ground:
                query[0], query[1], query[2] = _moved(T_ground_map, points[i, 0], points[i, 1], points[i, 2])
                query[3], query[4] = 0.0, np.sqrt(best[0])
                _rtcPointQuery(ground, query.ctypes.data, context.ctypes.data, callback, state.ctypes.data)
                if state[0] == ground_id:
                    best[1], best[2], best[3] = _moved(poses[ground_id], best[1], best[2], best[3])
        instances[i], faces[i] = state[0], state[1]
        distances[i] = np.sqrt(best[0]) if state[0] >= 0 else np.inf
        for axis in range(3):
            found_points[i, axis] = best[1 + axis] if state[0] >= 0 else points[i, axis]
    return identity[0, 0]


@nb.njit(cache=True, nogil=True)
def closest(
    others, ground, ground_id, T_ground_map, callback, points, limit, buffers, poses,
    found_points, distances, instances, faces,
):  # fmt: skip
    """Nearest points of (N, 3) float32 `points` within `limit`, on the calling thread; see `kernels.World`.

    Args:
        others: address of the scene of instances, or 0.
        ground: address of the scene of the mesh that is queried by itself, or 0.
        ground_id: its instance id.
        T_ground_map: (4, 4) inverse of its pose, which keeps lengths.
        callback: `CALLBACK`.
        points: the queries.
        limit: metres.
        buffers: (M, 2) int64 by instance id, addresses of the float32 vertices and of the uint32 faces.
        poses: (M, 4, 4) by instance id, T_map_mesh.
        found_points: as the following, the arrays of `ClosestPoints`.
        distances: see there.
        instances: see there.
        faces: see there.
    """
    out = found_points, distances, instances, faces
    for chunk in range((points.shape[0] + _CHUNK - 1) // _CHUNK):
        _chunk(
            chunk, (others, ground, ground_id, T_ground_map), callback, points, np.float32(limit), buffers, poses, out
        )


@nb.njit(cache=True, nogil=True, parallel=True)
def closest_parallel(
    others, ground, ground_id, T_ground_map, callback, points, limit, buffers, poses,
    found_points, distances, instances, faces,
):  # fmt: skip
    """`closest` on numba's threads."""
    out = found_points, distances, instances, faces
    for chunk in nb.prange((points.shape[0] + _CHUNK - 1) // _CHUNK):
        _chunk(
            chunk, (others, ground, ground_id, T_ground_map), callback, points, np.float32(limit), buffers, poses, out
        )
