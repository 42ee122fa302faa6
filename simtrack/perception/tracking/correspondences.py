"""Correspondences between a depth image and ray-traced models.

Tracking paper, III.B: with the exact sensor model, each measured point ``D_i(P)`` is paired with the model point that
its own viewing ray hits, ``D_i(P) -> M_i(P, N, O)``: position, normal and instance. All instances stand in one scene,
so occlusion between objects is handled by construction. Beyond the paper, silhouette pixels add the offset between the
model's edge and the depth discontinuity, which constrains what the visible faces leave free.

Everything here is in the camera frame; see `simtrack.perception.tracking.normal_equations` for the residuals.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from simtrack.contracts import Float32, Float64, Int32, Uint8
from simtrack.geometry.projection import bounding_rectangle

MISS, SUPPORTED, OCCLUDED, MISSING, INVALID = 0, 1, 2, 3, 4
"""What a ray that hits a model says: nothing hit; measured there; something in front; seen through; no reading."""

UNKNOWN_PIXEL = -2
"""In an instance image: no ray was cast here. -1 is a miss."""

FIELDS = 5
"""Number of ray verdicts counted for each instance (columns of the counts)."""


class Points(NamedTuple):
    """Pairs of measured and model points, camera frame; room for as many as there are rays."""

    measured: Float64
    """(M, 3), metres."""
    model: Float64
    """(M, 3), metres."""
    normal: Float64
    """(M, 3), unit vectors."""
    weight: Float64
    """(M,), inverse variance along the normal, 1/m^2."""
    owner: Int32
    """(M,), row of the instance."""

    @classmethod
    def room(cls, count: int) -> "Points":
        """Empty buffers for `count` pairs."""
        measured, model, normal = (np.empty((count, 3)) for _ in range(3))
        return cls(measured, model, normal, np.empty(count), np.empty(count, np.int32))


class Edges(NamedTuple):
    """Silhouette pixels with the depth discontinuities that they belong to; room for as many as there are rays."""

    point: Float64
    """(M, 3) model point, camera frame, metres."""
    direction: Float64
    """(M, 2) outward direction in the image, unit vectors."""
    offset: Float64
    """(M,) pixels that the silhouette has to move along it."""
    weight: Float64
    """(M,), 1/px^2."""
    owner: Int32
    """(M,), row of the instance."""

    @classmethod
    def room(cls, count: int) -> "Edges":
        """Empty buffers for `count` pairs."""
        return cls(
            np.empty((count, 3)), np.empty((count, 2)), np.empty(count), np.empty(count), np.empty(count, np.int32)
        )


class ModelImages(NamedTuple):
    """What the rays of a cast met, as images; untouched pixels hold `UNKNOWN_PIXEL`."""

    depth: Float32
    """(H, W), metres, 0 = miss."""
    instance: Int32
    """(H, W), row, -1 = miss."""

    @classmethod
    def empty(cls, height: int, width: int) -> "ModelImages":
        """Images without any ray."""
        return cls(np.zeros((height, width), np.float32), np.full((height, width), UNKNOWN_PIXEL, np.int32))


@njit(cache=True, nogil=True)
def _only_readings(depth, out):
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            d = np.float32(depth[v, u])
            out[v, u] = d if np.float32(0.0) < d < np.inf else np.float32(0.0)


def usable_depth(depth: Float32) -> Float32:
    """(H, W) copy of a depth image in which whatever is no finite, positive reading is 0."""
    out = np.empty(depth.shape, np.float32)
    _only_readings(depth, out)
    return out


@njit(cache=True, nogil=True)
def axial_variance(z: float, cosine: float, pixel_noise: float) -> float:
    """Variance of a structured-light depth reading, m^2.

    Nguyen et al. 2012 with the incidence angle clamped at 80 degrees, plus quantisation to 1/8 px of disparity for
    ``f b = pixel_noise`` px m.
    """
    sigma = 0.0012 + 0.0019 * (z - 0.4) ** 2
    if cosine < 0.5:  # theta > pi / 3
        theta = np.arccos(max(cosine, 0.17364817766693033))
        sigma += 0.0001 / np.sqrt(z) * theta * theta / (np.pi / 2 - theta) ** 2
    step = z * z / pixel_noise / 8.0
    return sigma * sigma + step * step / 12.0


@njit(cache=True, nogil=True)
def image_windows(corners, poses, camera, size, margin, windows):
    """Pixel boxes of the projected bounding boxes.

    `corners` (K, 8, 3), object frames; `poses` (K, 4, 4) T_camera_object; `size` (width, height). Output: `windows`
    (K, 4), half-open (u0, v0, u1, v1) with a `margin` of pixels, empty where an instance is out of view or reaches
    behind the camera.
    """
    for k in range(poses.shape[0]):
        windows[k] = 0
        shown, u_low, v_low, u_high, v_high = bounding_rectangle(corners[k], poses[k], camera)
        if not shown:
            continue
        u0, v0 = max(0.0, np.trunc(u_low) - margin), max(0.0, np.trunc(v_low) - margin)
        u1 = min(float(size[0]), np.trunc(u_high) + margin + 2)
        v1 = min(float(size[1]), np.trunc(v_high) + margin + 2)
        if u0 < u1 and v0 < v1:
            windows[k, 0], windows[k, 1], windows[k, 2], windows[k, 3] = int(u0), int(v0), int(u1), int(v1)


@njit(cache=True, nogil=True)
def box_share_in_image(corners, pose, camera, size):
    """Share of the bounding rectangle of a box's projected `corners` (8, 3) that lies inside the image, 0 to 1.

    `pose` (4, 4) T_camera_object, `size` (width, height). 0 where the box reaches behind the camera.
    """
    shown, u_low, v_low, u_high, v_high = bounding_rectangle(corners, pose, camera)
    if not shown:
        return 0.0
    inside_u = max(0.0, min(u_high, size[0] - 0.5) - max(u_low, -0.5))
    inside_v = max(0.0, min(v_high, size[1] - 0.5) - max(v_low, -0.5))
    return inside_u * inside_v / max((u_high - u_low) * (v_high - v_low), 1e-9)


@njit(cache=True, nogil=True)
def rows_of(instances, row, rows):
    """Rows (N,) of the instances that rays hit, by the table `row`; -1 = miss."""
    for i in range(instances.shape[0]):
        rows[i] = row[instances[i]] if instances[i] >= 0 else -1


@njit(cache=True, nogil=True)
def draw(pixels, distances, rows, images):
    """Write cast rays into images."""
    depth, instance = images.depth.reshape(-1), images.instance.reshape(-1)
    for i in range(pixels.shape[0]):
        instance[pixels[i]] = rows[i]
        depth[pixels[i]] = distances[i] if rows[i] >= 0 else 0.0


@njit(cache=True, nogil=True)
def erase(pixels, images):
    """Make images untouched again."""
    instance = images.instance.reshape(-1)
    for i in range(pixels.shape[0]):
        instance[pixels[i]] = UNKNOWN_PIXEL


CELL = 4, 2
"""Pixels that are marked together: columns and rows."""


def no_marks(height: int, width: int) -> Uint8:
    """Marks of an image for `mark_around`: a cell holds a bit for each pixel grid (1, 2 or 4) that is wanted in it."""
    return np.zeros((-(-height // CELL[1]), -(-width // CELL[0])), np.uint8)


@njit(cache=True, nogil=True)
def mark_around(pixels, rows, width, strides, fine, marks):
    """Mark the cells that a finer cast may hit, and their neighbours, by what a coarser one hit.

    `rows` (N,) as for `point_correspondences`; `width` of the image; `strides` and `fine` (K,), the pixel grids of each
    instance in this cast and in the finer one. In and out: `marks`, see `no_marks`.
    """
    across, down = CELL
    for i in range(pixels.shape[0]):
        k = rows[i]
        if k < 0 or k >= strides.shape[0]:
            continue
        v, u, f = pixels[i] // width, pixels[i] % width, fine[k]
        reach = strides[k] + 2 * f + 2  # up to the next ray that missed, the silhouette's surroundings, a motion
        for y in range(max(v - reach, 0) // down, min((v + reach) // down + 1, marks.shape[0])):
            for x in range(max(u - reach, 0) // across, min((u + reach) // across + 1, marks.shape[1])):
                marks[y, x] |= f


@njit(cache=True, nogil=True)
def take_marked(marks, height, width):
    """Flat indices of the pixels of an image that are marked, ascending; nothing is marked afterwards."""
    across, down = CELL
    count = 0
    for y in range(marks.shape[0]):
        for x in range(marks.shape[1]):
            count += marks[y, x] != 0
    pixels = np.empty(count * across * down, np.int32)
    found = 0
    for v in range(height):
        row = marks[v // down]
        for x in range(row.shape[0]):
            if row[x] == 0:
                continue
            grid = 1 if row[x] & 1 else (2 if row[x] & 2 else 4)
            if v % grid == 0:
                for u in range(x * across, min((x + 1) * across, width), grid):
                    pixels[found] = v * width + u
                    found += 1
            if v % down == down - 1 or v == height - 1:
                row[x] = 0
    return pixels[:found].copy()


@njit(cache=True, nogil=True)
def point_correspondences(
    pixels, directions, distances, normals, rows, readings, width, strides, gate, front, sigma, model_sigma,
    pixel_noise, lateral, origin, points, start, counts,
):  # fmt: skip
    """Pair measured points with model points along the viewing rays; returns the number of pairs, earlier ones too.

    Camera or lidar: a ray's point is its distance times its direction from the sensor's origin.

    Args:
        pixels: (N,) index of each ray's reading.
        directions: (N, 3); z = 1 for a camera, unit vectors for a lidar.
        distances: (N,) of the models, in multiples of the directions, inf = miss.
        normals: (N, 3) unit normals of the models, sensor frame.
        rows: (N,) row of the model hit; anything outside of 0..K-1 does not take part.
        readings: (P,) measured, in multiples of the directions, 0 = no reading.
        width: of the image, pixels.
        strides: (K,) pixel grid that each instance is sampled on.
        gate: largest distance along the normal, metres; 3 sigma of the sensor are added.
        front: share of this distance within which readings before the model count.
        sigma: standard deviation of the readings, metres; 0: that of a depth camera, see `axial_variance`.
        model_sigma: surface error of the models, metres.
        pixel_noise: focal length times baseline of a depth camera, px m.
        lateral: standard deviation across the ray in multiples of the distance.
        origin: (3,) of the rays, in the frame of `directions` and `normals`.
        points: output.
        start: row of `points` to fill first.
        counts: (K, FIELDS) output, rays by verdict, added to.

    """
    measured, model, normal, weight, owner = points
    ox, oy, oz = origin[0], origin[1], origin[2]
    found = start
    for i in range(pixels.shape[0]):
        k = rows[i]
        if k < 0 or k >= strides.shape[0]:
            continue
        v = pixels[i] // width
        u = pixels[i] - v * width
        if u % strides[k] != 0 or v % strides[k] != 0:
            continue
        x, y, w = float(directions[i, 0]), float(directions[i, 1]), float(directions[i, 2])
        z = float(distances[i])
        d = float(readings[pixels[i]])
        if d <= 0.0:
            counts[k, INVALID] += 1
            continue
        nx, ny, nz = float(normals[i, 0]), float(normals[i, 1]), float(normals[i, 2])
        along = nx * x + ny * y + nz * w
        cosine = abs(along) / np.sqrt(x * x + y * y + w * w)
        delta = d - z
        variance = sigma * sigma if sigma > 0.0 else axial_variance(z, cosine, pixel_noise)
        slack = 3.0 * np.sqrt(variance)
        widest = gate + slack * cosine
        if delta < 0.0:
            widest *= front
        if abs(delta * along) > widest or abs(delta) > 3.0 * widest + slack:
            counts[k, OCCLUDED if delta < 0.0 else MISSING] += 1
            continue
        counts[k, SUPPORTED] += 1
        if cosine < 0.17:
            continue
        across = lateral * z
        noise = variance * along * along + across * across * (1.0 - cosine * cosine) + model_sigma * model_sigma
        measured[found, 0], measured[found, 1], measured[found, 2] = ox + d * x, oy + d * y, oz + d * w
        model[found, 0], model[found, 1], model[found, 2] = ox + z * x, oy + z * y, oz + z * w
        normal[found, 0], normal[found, 1], normal[found, 2] = nx, ny, nz
        weight[found], owner[found] = 1.0 / noise, k
        found += 1
    return found


@njit(cache=True, nogil=True)
def _edge_offset(depth, model_depth, model_instance, k, u, v, du, dv, z, reach, step_depth, tolerance):
    """Offset in pixels along (du, dv) from pixel (u, v) to the nearest depth discontinuity; NaN if there is none."""
    height, width = depth.shape
    best = np.nan
    last_on, run = -1000, 0
    for j in range(-reach, reach + 1):
        x, y = int(np.floor(u + j * du + 0.5)), int(np.floor(v + j * dv + 0.5))
        if x < 0 or y < 0 or x >= width or y >= height:
            break
        d = depth[y, x]
        if d <= 0.0:
            continue  # the projector's shadow lies on the background beside the edge
        reference = model_depth[y, x] if model_instance[y, x] == k and model_depth[y, x] > 0.0 else z
        if abs(d - reference) < tolerance:
            last_on, run = j, run + 1
        elif d > max(reference, z) + step_depth:
            if run >= 2 and j - last_on <= 12:
                offset = last_on + 0.5
                if not abs(offset) >= abs(best):  # also true while best is NaN
                    best = offset
            run = 0
        else:
            run = 0  # something in front, or a surface that runs on: no silhouette here
    return best


@njit(cache=True, nogil=True)
def edge_correspondences(pixels, rows, depth, images, camera, strides, reach, step_depth, focal_baseline, edges, seen):
    """Pair the models' silhouettes with depth discontinuities; returns the number of pairs.

    For a silhouette pixel with outward image direction d the measured discontinuity is sought along d, up to `reach`
    pixels away. `images` are those of this cast, `rows` (N,) as for `point_correspondences`. Output: `edges`, and
    `seen` (K,), pairs of each instance, added to.
    """
    point, direction, offset, weight, owner = edges
    model_depth, model_instance = images
    height, width = depth.shape
    found = 0
    for i in range(pixels.shape[0]):
        k = rows[i]
        if k < 0 or k >= strides.shape[0]:
            continue
        v, u = pixels[i] // width, pixels[i] % width
        s = strides[k]
        if u % s != 0 or v % s != 0:
            continue
        z = model_depth[v, u]
        edge = False
        for side in range(4):
            x = u + s * ((side == 0) - (side == 1))
            y = v + s * ((side == 2) - (side == 3))
            if x < 0 or y < 0 or x >= width or y >= height:
                continue
            other = model_instance[y, x]
            if other == -1 or (other >= 0 and other != k and model_depth[y, x] > z + step_depth):
                edge = True
        if not edge:
            continue
        gu, gv, inside = 0.0, 0.0, 0
        for b in range(-2, 3):
            for a in range(-2, 3):
                x, y = u + a * s, v + b * s
                if 0 <= x < width and 0 <= y < height and model_instance[y, x] == k:
                    gu -= a
                    gv -= b
                    inside += 1
        norm = np.sqrt(gu * gu + gv * gv)
        if norm < 4.0 or inside < 6:
            continue  # thin parts and corners have no clear direction
        du, dv = gu / norm, gv / norm
        tolerance = 0.012 + 3.0 * np.sqrt(axial_variance(z, 0.7, focal_baseline))
        shift = _edge_offset(depth, model_depth, model_instance, k, u, v, du, dv, z, reach, step_depth, tolerance)
        if np.isnan(shift):
            continue
        point[found, 0], point[found, 1] = z * (u - camera[2]) / camera[0], z * (v - camera[3]) / camera[1]
        point[found, 2] = z
        direction[found, 0], direction[found, 1] = du, dv
        offset[found] = shift - 0.5 * s
        weight[found] = 1.0 / (0.64 + 0.1 * s * s)
        owner[found] = k
        seen[k] += 1
        found += 1
    return found


@njit(cache=True, nogil=True)
def ray_differences(pixels, distances, instances, depth, row, reach, out):
    """Measured minus model depth on rays that hit instance `row`, where within `reach` metres; returns how many."""
    width = depth.shape[1]
    found = 0
    for i in range(pixels.shape[0]):
        if instances[i] == row:
            d = depth[pixels[i] // width, pixels[i] % width]
            if d > 0.0 and abs(d - distances[i]) < reach:
                out[found] = d - distances[i]
                found += 1
    return found
