"""Compiled parts of the pose search: how well keypoints and a box agree with orientations, and depth with casts."""

import numpy as np
from numba import njit

BINS = 64
"""Depths that a cast is slid to, over the whole reach."""


@njit(cache=True, nogil=True)
def robust(squared: float) -> float:
    """Cost of a squared deviation in standard deviations; grows like a logarithm, as errors have long tails."""
    return np.log1p(0.5 * squared)


@njit(cache=True, nogil=True)
def expected_cost(rotation, shift, keypoints, pixels, sigma, outline, box, box_sigma, size, camera):
    """Cost of a pose's distances from detected keypoints and box, see `place_and_judge`; inf behind the camera."""
    cost = 0.0
    for i in range(keypoints.shape[0]):
        x, y, z = shift[0], shift[1], shift[2]
        for c in range(3):
            x += rotation[0, c] * keypoints[i, c]
            y += rotation[1, c] * keypoints[i, c]
            z += rotation[2, c] * keypoints[i, c]
        if z < 0.05:
            return np.inf
        du = camera[0] * x / z + camera[2] - pixels[i, 0]
        dv = camera[1] * y / z + camera[3] - pixels[i, 1]
        cost += robust((du * du + dv * dv) / (sigma[i] * sigma[i]))
    u_low, v_low, u_high, v_high = np.inf, np.inf, -np.inf, -np.inf
    for i in range(outline.shape[0]):
        x, y, z = shift[0], shift[1], shift[2]
        for c in range(3):
            x += rotation[0, c] * outline[i, c]
            y += rotation[1, c] * outline[i, c]
            z += rotation[2, c] * outline[i, c]
        if z < 0.05:
            return np.inf
        u, v = camera[0] * x / z + camera[2], camera[1] * y / z + camera[3]
        u_low, v_low, u_high, v_high = min(u_low, u), min(v_low, v), max(u_high, u), max(v_high, v)
    # A detected box ends with the image.
    right, bottom = size[0] - 1.0, size[1] - 1.0
    for low, high, first, last, limit in (
        (u_low, u_high, box[0], box[2], right),
        (v_low, v_high, box[1], box[3], bottom),
    ):
        low, high = min(max(low, 0.0), limit), min(max(high, 0.0), limit)
        cost += robust(((low - first) / box_sigma) ** 2) + robust(((high - last) / box_sigma) ** 2)
    return cost


@njit(cache=True, nogil=True)
def place_and_judge(
    rotations, keypoints, pixels, sigma, rays, solve, distance, outline, box, box_sigma, size, camera, shifts, costs
):  # fmt: skip
    """Give each orientation the position that suits the detection best, and tell how well both suit it then.

    With the orientation given, the position is a linear function of the object points' offsets along the rays.

    Args:
        rotations: (G, 3, 3), R_camera_object.
        keypoints: (K, 3), object frame, metres.
        pixels: (K, 2), where they were detected.
        sigma: (K,), their standard deviations, pixels.
        rays: (K + 1, 2), directions (z = 1) of the keypoints and of the box's centre.
        solve: (3, 2 K + 3), weighted pseudo-inverse: from the offsets of each keypoint in x and y, then the origin's,
            and its distance, to a position.
        distance: that the origin is expected at, metres of depth.
        outline: (P, 3) points of the model whose projections have its silhouette's box.
        box: (4,), detected, pixels.
        box_sigma: standard deviation of its sides, pixels.
        size: (2,), width and height of the image.
        camera: (4,), fx, fy, cx, cy.
        shifts: (G, 3) output, positions.
        costs: (G,) output.

    """
    count = keypoints.shape[0]
    b = np.empty(2 * count + 3)
    for g in range(rotations.shape[0]):
        R = rotations[g]
        for i in range(count):
            x, y, z = 0.0, 0.0, 0.0
            for c in range(3):
                x += R[0, c] * keypoints[i, c]
                y += R[1, c] * keypoints[i, c]
                z += R[2, c] * keypoints[i, c]
            b[2 * i], b[2 * i + 1] = rays[i, 0] * z - x, rays[i, 1] * z - y
        b[2 * count], b[2 * count + 1], b[2 * count + 2] = 0.0, 0.0, distance
        for a in range(3):
            total = 0.0
            for j in range(2 * count + 3):
                total += solve[a, j] * b[j]
            shifts[g, a] = total
        costs[g] = expected_cost(R, shifts[g], keypoints, pixels, sigma, outline, box, box_sigma, size, camera)


@njit(cache=True, nogil=True)
def rays_of(rotations, shifts, directions, origins, turned):
    """Camera rays (N, 3) in the frames of posed objects: (H, 3, 3) and (H, 3) to (H * N, 3) origins and directions."""
    count = directions.shape[0]
    for h in range(rotations.shape[0]):
        R, t = rotations[h], shifts[h]
        for a in range(3):
            origin = -(R[0, a] * t[0] + R[1, a] * t[1] + R[2, a] * t[2])
            for i in range(count):
                origins[h * count + i, a] = origin
                turned[h * count + i, a] = (
                    R[0, a] * directions[i, 0] + R[1, a] * directions[i, 1] + R[2, a] * directions[i, 2]
                )


@njit(cache=True, nogil=True)
def slide(distances, readings, reach, tolerance, front, depths, sigma, shifts, scores):
    """Slide casts along their rays to where they agree best with what was measured.

    A ray agrees within the tolerance; one that was measured further away contradicts the model, which it should have
    met; one that was measured nearer counts against it by `front`, since something may stand before the object.

    Args:
        distances: (H, N), metres of depth, inf = the model is not met.
        readings: (N,), measured, 0 = no reading.
        reach: furthest, metres.
        tolerance: metres.
        front: 0 to 1.
        depths: (H,), of the objects, metres.
        sigma: standard deviation of these, as a share.
        shifts: (H,) output, metres.
        scores: (H,) output, agreeing less contradicting rays.

    """
    step = 2.0 * reach / BINS
    half = int(np.ceil(tolerance / step - 0.5))
    total = np.empty(BINS + 1)
    for h in range(distances.shape[0]):
        total[:] = 0.0
        before, behind = 0.0, 0.0
        for i in range(readings.shape[0]):
            if readings[i] <= 0.0 or not distances[h, i] < np.inf:
                continue
            place = int(np.floor((readings[i] - distances[h, i] + reach) / step))
            if place < 0:
                before += 1.0
            elif place >= BINS:
                behind += 1.0
            else:
                total[place + 1] += 1.0
        for j in range(BINS):
            total[j + 1] += total[j]
        best, at = -np.inf, 0
        for j in range(BINS):
            low, high = max(j - half, 0), min(j + half + 1, BINS)
            near = total[high] - total[low]
            value = near - (behind + total[BINS] - total[high]) - front * (before + total[low])
            moved = ((j + 0.5) * step - reach) / (sigma * depths[h])
            value -= 0.02 * readings.shape[0] * moved * moved
            if value > best:
                best, at = value, j
        shifts[h], scores[h] = (at + 0.5) * step - reach, best


@njit(cache=True, nogil=True)
def normals_of(rotations, normals, out):
    """Normals (H * N, 3) of posed objects, from their frames to the camera's."""
    count = normals.shape[0] // rotations.shape[0]
    for i in range(normals.shape[0]):
        R = rotations[i // count]
        for a in range(3):
            out[i, a] = R[a, 0] * normals[i, 0] + R[a, 1] * normals[i, 1] + R[a, 2] * normals[i, 2]


@njit(cache=True, nogil=True)
def borders(distances, readings, columns, step, out):
    """How a cast's silhouettes compare with the image: (H, 2) pairs of rays, a depth step there, and none.

    Each ray that meets the model beside one that does not, on a grid of so many columns, should see what is
    behind the object beside it.
    """
    count = readings.shape[0]
    for h in range(distances.shape[0]):
        out[h, 0], out[h, 1] = 0, 0
        for i in range(count):
            d = distances[h, i]
            if not d < np.inf:
                continue
            for side in range(4):
                if side == 0:
                    j = i - 1 if i % columns > 0 else -1
                elif side == 1:
                    j = i + 1 if i % columns < columns - 1 else -1
                elif side == 2:
                    j = i - columns
                else:
                    j = i + columns
                if j < 0 or j >= count or distances[h, j] < np.inf or readings[j] <= 0.0:
                    continue
                if readings[j] > d + step:
                    out[h, 0] += 1
                else:
                    out[h, 1] += 1
