"""Compiled loops of the localizer around the casts: de-skewing, aiming rays, judging what they met, the map's normals.

All run on the calling thread in one fixed order, so results do not depend on threads.
"""

from typing import NamedTuple

import numba as nb
import numpy as np

from simtrack.contracts import Float64

BLOCK = 4
"""Neighbouring shots that are thinned together: rays of a packet are traced fast if they are close to each other."""
_BEND = 2e-3
"""rad: within a turn of this a moving sensor's pose is interpolated linearly, which bends rays by less than 1e-6."""
_STEP = np.float32(1e-3)
"""m behind a surface at which a ray that passes through it goes on."""


@nb.njit(cache=True, nogil=True)
def deskew_shots(
    directions: np.ndarray,
    times: np.ndarray,
    ranges: np.ndarray,
    rings: np.ndarray,
    masked: np.ndarray,
    min_range: float,
    max_range: float,
    T_base_lidar: Float64,
    knot_times: Float64,
    knots: Float64,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The valid shots of a turn in the base frame at the last knot, ring by ring.

    Between two knots T_end_base(t) moves on a straight line and turns about a fixed axis.

    Args:
        directions: (N, 3) float32, lidar frame.
        times: (N,) float32, seconds.
        ranges: (N,) float32, metres.
        rings: (N,) uint8.
        masked: (N,) bool, shots to leave out, or empty.
        min_range: metres, shorter ranges are left out.
        max_range: metres, longer ones too.
        T_base_lidar: (4, 4).
        knot_times: (K,), seconds.
        knots: (K, 4, 4), T_end_base at the knots.

    Returns:
        origins (M, 3), directions (M, 3) and ranges (M,), float32, and (M,) int32, which of the N each shot is.
    """
    clocks, poses = _sensor_track(T_base_lidar, knot_times, knots)
    count = ranges.shape[0]
    valid = np.empty(count, np.bool_)
    slots = np.zeros(257, np.int64)
    for i in range(count):
        finite = np.isfinite(directions[i, 0] + directions[i, 1] + directions[i, 2] + times[i] + ranges[i])
        valid[i] = finite and min_range <= ranges[i] <= max_range and not (masked.shape[0] > 0 and masked[i])
        slots[rings[i] + 1] += valid[i]
    for ring in range(256):
        slots[ring + 1] += slots[ring]
    kept = slots[256]
    origins, turned = np.empty((kept, 3), np.float32), np.empty((kept, 3), np.float32)
    lengths, shots = np.empty(kept, np.float32), np.empty(kept, np.int32)
    last, k = clocks.shape[0] - 2, 0
    for i in range(count):
        if not valid[i]:
            continue
        row = slots[rings[i]]
        slots[rings[i]] = row + 1
        time = times[i]
        if time < clocks[k]:
            k = 0
        while k < last and time >= clocks[k + 1]:
            k += 1
        share = np.float32((time - clocks[k]) / (clocks[k + 1] - clocks[k]))
        rest = np.float32(1.0) - share
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        for a in range(3):
            rx = rest * poses[k, a, 0] + share * poses[k + 1, a, 0]
            ry = rest * poses[k, a, 1] + share * poses[k + 1, a, 1]
            rz = rest * poses[k, a, 2] + share * poses[k + 1, a, 2]
            turned[row, a] = rx * x + ry * y + rz * z
            origins[row, a] = rest * poses[k, a, 3] + share * poses[k + 1, a, 3]
        lengths[row], shots[row] = ranges[i], i
    return origins, turned, lengths, shots


@nb.njit(cache=True, nogil=True)
def _sensor_track(T_base_lidar: Float64, knot_times: Float64, knots: Float64) -> tuple[Float64, np.ndarray]:
    """Times (L,) and T_end_lidar (L, 3, 4) float32, L >= 2, so close that between them linear interpolation does."""
    spans = knot_times.shape[0] - 1
    turns, pieces = np.empty((spans, 3)), np.ones(spans + 1, np.int64)
    for k in range(spans):
        phi = rotation_vector(knots[k + 1], knots[k])
        turns[k], pieces[k] = phi, int(np.sqrt(phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2) / _BEND) + 1
    count = max(pieces.sum(), 2)
    clocks, poses, T, row = np.empty(count), np.empty((count, 3, 4), np.float32), np.empty((3, 4)), 0
    for k in range(spans + 1):
        ahead = min(k + 1, spans)
        for piece in range(pieces[k]):
            share = piece / pieces[k]
            T[:] = knots[k, :3]
            if k < spans:
                turn(share * turns[k, 0], share * turns[k, 1], share * turns[k, 2], knots[k], T)
            for a in range(3):
                T[a, 3] += share * (knots[ahead, a, 3] - knots[k, a, 3])
                for b in range(4):
                    value = T[a, 3] if b == 3 else 0.0
                    for c in range(3):
                        value += T[a, c] * T_base_lidar[c, b]
                    poses[row, a, b] = value
            clocks[row] = knot_times[k] + share * (knot_times[ahead] - knot_times[k])
            row += 1
    if spans < 1:  # no time passes
        clocks[1], poses[1] = clocks[0] + 1.0, poses[0]
    return clocks, poses


@nb.njit(cache=True, nogil=True)
def rotation_vector(T_to: Float64, T_from: Float64) -> Float64:
    """(3,) rotation vector, left perturbation, from one rotation (the first 3x3) to another; less than half a turn."""
    trace, v = 0.0, np.zeros(3)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for c in range(3):
            trace += T_to[i, c] * T_from[i, c]
            v[i] += 0.5 * (T_to[k, c] * T_from[j, c] - T_to[j, c] * T_from[k, c])
    sine = np.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    return v if sine < 1e-9 else v * (np.arctan2(sine, 0.5 * (trace - 1.0)) / sine)


@nb.njit(cache=True, nogil=True)
def turn(x: float, y: float, z: float, matrix: Float64, out: Float64) -> None:
    """First three columns of out = Exp((x, y, z)) @ matrix, by Rodrigues' formula applied to each of them."""
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-16:
        a, b = 1.0, 0.5
    else:
        angle = np.sqrt(angle2)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    for j in range(3):
        v0, v1, v2 = matrix[0, j], matrix[1, j], matrix[2, j]
        c0, c1, c2 = y * v2 - z * v1, z * v0 - x * v2, x * v1 - y * v0
        out[0, j] = v0 + a * c0 + b * (y * c2 - z * c1)
        out[1, j] = v1 + a * c1 + b * (z * c0 - x * c2)
        out[2, j] = v2 + a * c2 + b * (x * c1 - y * c0)


@nb.njit(cache=True, nogil=True)
def thinned_count(count: int, stride: int) -> int:
    """How many of `count` shots `aim` takes."""
    blocks = (count + BLOCK - 1) // BLOCK
    last = (blocks + stride - 1) // stride - 1
    return last * BLOCK + min(BLOCK, count - last * stride * BLOCK) if count > 0 else 0


@nb.njit(cache=True, nogil=True)
def aim(
    T: Float64,
    origins: np.ndarray,
    directions: np.ndarray,
    ranges: np.ndarray,
    sigmas: np.ndarray,
    stride: int,
    out: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Move every `stride`-th block of shots (N, ...) by T (4, 4) into origins, directions, ranges and sigmas of `out`.

    Rows of `out` that are left over become rays without direction, which meet nothing.
    """
    to_origins, to_directions, to_ranges, to_sigmas = out
    m, t = T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32)
    m00, m01, m02, m10, m11, m12 = m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2]
    m20, m21, m22, t0, t1, t2 = m[2, 0], m[2, 1], m[2, 2], t[0], t[1], t[2]
    count = thinned_count(ranges.shape[0], stride)
    for first in range(0, count, BLOCK):
        ahead = first * (stride - 1)
        for j in range(first, min(first + BLOCK, count)):
            i = j + ahead
            x, y, z = origins[i, 0], origins[i, 1], origins[i, 2]
            to_origins[j, 0] = m00 * x + m01 * y + m02 * z + t0
            to_origins[j, 1] = m10 * x + m11 * y + m12 * z + t1
            to_origins[j, 2] = m20 * x + m21 * y + m22 * z + t2
            x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
            to_directions[j, 0] = m00 * x + m01 * y + m02 * z
            to_directions[j, 1] = m10 * x + m11 * y + m12 * z
            to_directions[j, 2] = m20 * x + m21 * y + m22 * z
            to_ranges[j], to_sigmas[j] = ranges[i], sigmas[i]
    to_origins[count:], to_directions[count:] = 0.0, 0.0


class Follow(NamedTuple):
    """Rays that go on behind what they met first; rows of them are used, one a ray."""

    rows: np.ndarray
    """(N,) int32, which ray of the view."""
    starts: np.ndarray
    """(N,) float32, metres from the sensor at which it goes on."""
    seeks: np.ndarray
    """(N,) int8: 0 the first surface that faces the sensor, 1 the next one behind that."""
    casts: np.ndarray
    """(N,) int8, how often it may still be cast."""


@nb.njit(cache=True, nogil=True)
def unsettled(count, directions, ranges, distances, normals, reach, backs, follow, passed):
    """Find the rays of a view that go on behind what they met: a surface from behind, or one that the shot passed.

    Args:
        count: rays of the view.
        directions: of the view ...
        ranges: ... likewise ...
        distances: ... likewise ...
        normals: ... likewise.
        reach: metres by which a shot must have gone farther than its ray.
        backs: surfaces that a ray may pass from behind.
        follow: is filled.
        passed: (N,) bool, is cleared.

    Returns:
        How many rows of `follow` are in use.
    """
    used = 0
    for i in range(count):
        passed[i] = False
        facing = normals[i, 0] * directions[i, 0] + normals[i, 1] * directions[i, 1] + normals[i, 2] * directions[i, 2]
        behind = facing > 0.0
        if behind or ranges[i] > distances[i] + reach:
            follow.rows[used] = i
            follow.starts[used] = distances[i] + _STEP
            follow.seeks[used] = 0 if behind else 1
            follow.casts[used] = backs if behind else backs + 1
            used += 1
    return used


@nb.njit(cache=True, nogil=True)
def aim_onward(used, follow, origins, directions, to_origins, to_directions):
    """Origins and directions, (N, 3) float32 of which `used` rows are filled, of the rays that go on."""
    for s in range(used):
        i, start = follow.rows[s], follow.starts[s]
        for a in range(3):
            to_origins[s, a] = origins[i, a] + start * directions[i, a]
            to_directions[s, a] = directions[i, a]


@nb.njit(cache=True, nogil=True)
def advance(used, directions, ranges, hits, onward, reach, ends, backs, follow, passed):
    """Take what the rays that went on have met.

    Args:
        used: rows of `follow` in use.
        directions: of the view ...
        ranges: ... likewise.
        hits: distances, normals, faces and instances of the view; is changed.
        onward: likewise, of the `used` rays that went on.
        reach: see `unsettled`.
        ends: metres; a shot that passed a surface belongs to the next one if it ends so close to that.
        backs: see `unsettled`.
        follow: is changed.
        passed: (N,) bool, is set where a shot belongs to the second surface.

    Returns:
        How many rows of `follow` are still in use.
    """
    distances, normals, faces, instances = hits
    kept = 0
    for s in range(used):
        i = follow.rows[s]
        found = follow.starts[s] + onward[0][s]
        facing = np.float32(0.0)
        for a in range(3):
            facing += onward[1][s, a] * directions[i, a]
        casts, seeks, again = follow.casts[s] - 1, follow.seeks[s], False
        if facing > 0.0 and casts > 0:
            again = True
        elif seeks == 0 or abs(ranges[i] - found) < ends:
            distances[i], faces[i], instances[i] = found, onward[2][s], onward[3][s]
            for a in range(3):
                normals[i, a] = onward[1][s, a]
            passed[i] = seeks == 1
            if seeks == 0 and ranges[i] > found + reach:
                seeks, casts, again = 1, backs + 1, True
        if again:
            follow.rows[kept], follow.starts[kept] = i, found + _STEP
            follow.seeks[kept], follow.casts[kept] = seeks, casts
            kept += 1
    return kept


@nb.njit(cache=True, nogil=True)
def explain(count, ranges, sigmas, directions, distances, normals, passed, tolerance):
    """What the map says about each shot of a view (see `simtrack.perception.localization.assessment.Assessment`).

    A shot is explained if it ends within `tolerance` metres, and three standard deviations, of a surface that faces the
    sensor, by a level surface (floor, ceiling) or by structure. Else it ends in front of the map (something that the
    map does not have), reaches through its surface, or the map has nothing there.

    Returns:
        (count,) int8 verdicts, and four counts: explained shots, explained structure (twice; once what lies behind a
        surface that was passed over), shots that reach through, and shots that no level surface explains.
    """
    verdicts = np.empty(count, np.int8)
    explained, structure, through, rest = 0, 0, 0, 0
    for i in range(count):
        cosine = normals[i, 0] * directions[i, 0] + normals[i, 1] * directions[i, 1] + normals[i, 2] * directions[i, 2]
        slip = ranges[i] - distances[i]
        limit = tolerance + 3.0 * sigmas[i]
        verdict, level = 0, False
        if cosine < 0.0 and abs(slip * cosine) <= limit and abs(slip) <= 8.0 * limit:
            verdict, level = (1 if passed[i] else 2), abs(normals[i, 2]) > 0.8
        elif slip >= 0.0:
            verdict = -1
        verdicts[i] = verdict
        explained += verdict == 2
        through += verdict == -1
        rest += not level
        structure += 0 if level else max(verdict, 0)
    return verdicts, explained, structure, through, rest


@nb.njit(cache=True, nogil=True)
def average_normals(normals: Float64, areas: Float64, faces: np.ndarray, vertex_count: int, crease: float) -> Float64:
    """One round of bilateral averaging of face normals (F, 3) over the faces that share a vertex."""
    start = np.zeros(vertex_count + 1, np.int64)
    for f in range(faces.shape[0]):
        for k in range(3):
            start[faces[f, k] + 1] += 1
    for v in range(vertex_count):
        start[v + 1] += start[v]
    fill, around = start[:-1].copy(), np.empty(faces.size, np.int64)
    for f in range(faces.shape[0]):
        for k in range(3):
            v = faces[f, k]
            around[fill[v]] = f
            fill[v] += 1
    out = np.empty_like(normals)
    for f in range(faces.shape[0]):
        n0, n1, n2 = normals[f, 0], normals[f, 1], normals[f, 2]
        s0, s1, s2 = areas[f] * n0, areas[f] * n1, areas[f] * n2
        for k in range(3):
            v = faces[f, k]
            for j in range(start[v], start[v + 1]):
                g = around[j]
                alike = n0 * normals[g, 0] + n1 * normals[g, 1] + n2 * normals[g, 2]
                if alike > crease:
                    w = areas[g] * (alike - crease)
                    s0 += w * normals[g, 0]
                    s1 += w * normals[g, 1]
                    s2 += w * normals[g, 2]
        length = np.sqrt(s0 * s0 + s1 * s1 + s2 * s2)
        if length > 1e-15:
            out[f, 0], out[f, 1], out[f, 2] = s0 / length, s1 / length, s2 / length
        else:
            out[f, 0], out[f, 1], out[f, 2] = n0, n1, n2
    return out
