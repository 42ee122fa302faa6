"""Pre-segmentation: measurements that nothing in the believed world explains (tracking paper, III.C).

A measurement is explained if it lies on the surface of the map, of a tracked object or of the robot's own body, within
what sensor, map and pose may be wrong. What remains is clustered and handed on as regions of interest: the paper's
reduction of a scan "without losing relevant information at all".
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from simtrack.contracts import (
    Bool,
    CameraIntrinsics,
    Float32,
    Float64,
    Int32,
    LidarScan,
    Presegmentation,
    RegionOfInterest,
    RgbdFrame,
    Status,
)
from simtrack.errors import InvalidValueError
from simtrack.perception.tracking.correspondences import axial_variance, usable_depth
from simtrack.raycast import RayBundle, RayScene
from simtrack.raycast.kernels import run
from simtrack.raycast.sweep import sweep


@dataclass(frozen=True, slots=True)
class PresegmentationConfig:
    """Settings of `presegment_camera` and `presegment_lidar`."""

    stride: int = 3
    """Pixel grid on which the believed world is cast; measurements are tested at full resolution."""
    map_sigma: float = 0.006
    """Standard deviation of the map's surface and of the pose, metres."""
    tolerance: float = 0.017
    """Largest allowance for map and pose, metres; 2.5 sigma of the sensor are added."""
    focal_baseline: float = 577.0 * 0.075
    """Focal length times baseline of the depth sensor, px m (Xtion)."""
    lidar_sigma: float = 0.012
    """Standard deviation of a lidar range, metres."""
    max_range: float = 5.0
    """Depth readings further away are too coarse to tell anything, metres: they count as explained."""
    join: float = 0.025
    """Neighbouring pixels belong to one cluster if their depth differs by less than this at 1 m, metres (grows with
    the square of the distance)."""
    min_pixels: int = 60
    """Smaller camera clusters are noise."""
    growth: int = 12
    """Clusters take in doubtful pixels (explained, but not closely) up to this many pixels around them: the lower rim
    of a thing that stands on a surface."""
    lidar_join: float = 0.25
    """Lidar points nearer than this belong to one cluster, metres."""
    min_points: int = 4
    """Smaller lidar clusters are noise."""

    def __post_init__(self) -> None:
        if self.stride < 1:
            raise InvalidValueError("PresegmentationConfig.stride", self.stride, ">= 1")


def presegment_camera(
    frame: RgbdFrame,
    T_map_camera: Float64,
    scene: RayScene,
    own_body: Bool | None = None,
    config: PresegmentationConfig | None = None,
) -> Presegmentation:
    """Find what the believed world does not explain in a depth image.

    Args:
        frame: depth (H, W), metres.
        T_map_camera: (4, 4), believed.
        scene: map and tracked objects, map frame.
        own_body: (H, W), True where the robot sees itself; None if it does not.
        config: settings.

    """
    config = config or PresegmentationConfig()
    depth = usable_depth(frame.depth)
    valid = int(np.count_nonzero(depth))
    if valid == 0:
        empty = np.zeros(depth.shape, bool)
        return Presegmentation(frame.stamp, empty, 0, empty.astype(np.int32), (), "camera", Status.NO_DATA)
    K = frame.intrinsics
    bundle = RayBundle.from_camera(K, stride=config.stride)
    hits = scene.cast(bundle, T_map_camera)
    camera = np.array([K.fx, K.fy, K.cx, K.cy])
    normals = hits.normals @ T_map_camera[:3, :3].astype(np.float32)
    unknown, doubtful = np.zeros(depth.shape, bool), np.zeros(depth.shape, bool)
    run(
        depth.size, _unexplained_pixels, _unexplained_pixels_parallel,
        depth, hits.distances.reshape(bundle.shape), normals.reshape(*bundle.shape, 3), camera, config.stride,
        config.map_sigma, config.tolerance, config.focal_baseline, unknown, doubtful,
    )  # fmt: skip
    explained = depth > config.max_range
    if own_body is not None:
        explained |= own_body
    unknown[explained] = False
    doubtful[explained] = False
    labels, count = _label_pixels(unknown, depth, config.join, config.min_pixels)
    _grow(labels, doubtful, depth, config.join, config.growth)
    regions = _camera_regions(labels, count, depth, K, T_map_camera, frame.stamp)
    return Presegmentation(frame.stamp, unknown, valid, labels, regions, "camera")


def presegment_lidar(
    scan: LidarScan,
    pose_at: Callable[[int], Float64],
    scene: RayScene,
    own_body: Bool | None = None,
    config: PresegmentationConfig | None = None,
) -> Presegmentation:
    """Find what the believed world does not explain in a scan.

    Args:
        scan: one turn; each shot is cast from the sensor's pose at its own time.
        pose_at: stamp in nanoseconds -> T_map_base (4, 4), believed.
        scene: map and tracked objects, map frame.
        own_body: (N,), True where the robot sees itself; None if it does not.
        config: settings.

    """
    config = config or PresegmentationConfig()
    measured = np.isfinite(scan.ranges) & (scan.ranges > 0.0)
    valid = int(np.count_nonzero(measured))
    unknown = np.zeros(scan.ranges.shape, bool)
    if valid == 0:
        return Presegmentation(scan.stamp, unknown, 0, unknown.astype(np.int32), (), "lidar", Status.NO_DATA)
    origins, directions = shot_rays(scan, pose_at)
    index = np.flatnonzero(measured if own_body is None else measured & ~own_body)
    hits = scene.cast_rays(origins[index], directions[index])
    ranges = scan.ranges[index].astype(float)
    reach = min(3.0 * float(np.hypot(config.lidar_sigma, config.map_sigma)), 3.0 * config.lidar_sigma + 0.02)
    along = np.abs(np.einsum("ij,ij->i", hits.normals, directions[index]))
    difference = np.abs(ranges - np.where(np.isfinite(hits.distances), hits.distances, 1e9))
    explained = (difference * along < reach) & (difference < 0.5)
    open_ = index[~explained]
    points = origins[open_] + scan.ranges[open_, None] * directions[open_]
    nearest = scene.closest_points(points, reach)
    stray = ~np.isfinite(nearest.distances)
    unknown[open_[stray]] = True
    labels = np.zeros(len(unknown), np.int32)
    clusters, count = _cluster_points(points[stray], config.lidar_join, config.min_points)
    labels[open_[stray]] = clusters
    members = [points[stray][clusters == k] for k in range(1, count + 1)]
    regions = tuple(
        _region(scan.stamp, cluster.min(axis=0), cluster.max(axis=0), np.zeros(4), len(cluster), "lidar")
        for cluster in members
    )
    return Presegmentation(scan.stamp, unknown, valid, labels, regions, "lidar")


def shot_rays(scan: LidarScan, pose_at: Callable[[int], Float64]) -> tuple[Float32, Float32]:
    """Origins and unit directions (N, 3) of a scan's shots in the map, each from the sensor's pose at its own time."""
    knots = _knots(scan)
    poses = np.stack([pose_at(stamp) @ scan.T_base_lidar for stamp in shot_stamps(scan)])
    return sweep(scan.directions, scan.times, knots[1], poses)


def shot_stamps(scan: LidarScan) -> list[int]:
    """Nanoseconds at which `shot_rays` asks for the pose of the base."""
    return [scan.stamp + int(t * 1e9) for t in _knots(scan)]


def _knots(scan: LidarScan) -> Float64:
    """Seconds after the scan's stamp between which its motion is taken to be even."""
    last = float(scan.times.max()) if len(scan.times) else 0.0
    return np.linspace(0.0, max(last, 1e-6), 5)


@njit(cache=True, nogil=True, error_model="numpy")
def _distances(x, y, d, z, ray_x, ray_y, normal):
    """How far a point is from the tangent plane of a model point at depth z on a ray, and from that point, squared."""
    ex, ey, ez = x - z * ray_x, y - z * ray_y, d - z
    return abs(ex * normal[0] + ey * normal[1] + ez * normal[2]), ex * ex + ey * ey + ez * ez


@njit(cache=True, nogil=True, error_model="numpy")
def _unexplained_in_row(
    v, depth, model_depth, normals, camera, stride, map_sigma, tolerance, focal_baseline, unknown, doubtful
):  # fmt: skip
    width, row = depth.shape[1], v // stride
    rows, columns = model_depth.shape
    ray_y, row_y = (v - camera[3]) / camera[1], (row * stride - camera[3]) / camera[1]
    # What is this near to its own ray's plane is explained at any distance: the sensor is best at 0.4 m.
    least = axial_variance(0.4, 0.9, 1e9)
    surely = min(3.0 * np.sqrt(least + map_sigma * map_sigma), np.sqrt(least) + 0.5 * tolerance)
    for column in range(columns):
        own = model_depth[row, column]
        own_x = (column * stride - camera[2]) / camera[0]
        for u in range(column * stride, min((column + 1) * stride, width)):
            d = float(depth[v, u])
            if d <= 0.0:
                continue
            x, y = d * (u - camera[2]) / camera[0], d * ray_y
            off, square, beside = 1e9, 0.0, 2.0 * stride * d / camera[0]
            if own < 1e6:
                off, square = _distances(x, y, d, own, own_x, row_y, normals[row, column])
                if off < surely and square < beside * beside + 25.0 * off * off:
                    continue
            variance = axial_variance(d, 0.9, focal_baseline)
            sigma = np.sqrt(variance)
            limit = min(3.0 * np.sqrt(variance + map_sigma * map_sigma), 2.5 * sigma + tolerance)
            lateral = beside + 0.5 * limit
            doubt = min(limit, sigma + 0.5 * tolerance)
            nearest = 1e9
            if off < limit and square < lateral * lateral + 25.0 * off * off:
                nearest = off
                if off < doubt:
                    continue
            for ring in range(1, 3):
                for i in range(max(row - ring, 0), min(row + ring + 1, rows)):
                    for j in range(max(column - ring, 0), min(column + ring + 1, columns)):
                        if nearest < doubt or max(abs(i - row), abs(j - column)) != ring:
                            continue
                        z = model_depth[i, j]
                        if not z < 1e6:
                            continue
                        other_x, other_y = (j * stride - camera[2]) / camera[0], (i * stride - camera[3]) / camera[1]
                        off, square = _distances(x, y, d, z, other_x, other_y, normals[i, j])
                        if off < limit and square < lateral * lateral + 25.0 * off * off:
                            nearest = min(nearest, off)
                if nearest < doubt:
                    break
            unknown[v, u] = nearest >= limit
            doubtful[v, u] = nearest >= doubt


@njit(cache=True, nogil=True)
def _unexplained_pixels(
    depth, model_depth, normals, camera, stride, map_sigma, tolerance, focal_baseline, unknown, doubtful
):  # fmt: skip
    """Mark (H, W) readings further from the tangent planes of nearby model points than sensor, map and pose allow.

    `doubtful` are those that are explained, but not closely, and the unknown ones.
    """
    for v in range(depth.shape[0]):
        _unexplained_in_row(
            v, depth, model_depth, normals, camera, stride, map_sigma, tolerance, focal_baseline, unknown, doubtful
        )


@njit(cache=True, nogil=True, parallel=True)
def _unexplained_pixels_parallel(
    depth, model_depth, normals, camera, stride, map_sigma, tolerance, focal_baseline, unknown, doubtful
):  # fmt: skip
    """`_unexplained_pixels` on numba's threads."""
    for v in prange(depth.shape[0]):
        _unexplained_in_row(
            v, depth, model_depth, normals, camera, stride, map_sigma, tolerance, focal_baseline, unknown, doubtful
        )


@njit(cache=True, nogil=True)
def _label_pixels(unknown, depth, join, min_pixels):
    """Connected regions of unknown pixels without depth steps; returns labels (H, W) from 1 and their number."""
    height, width = depth.shape
    labels = np.zeros((height, width), np.int32)
    stack = np.empty(height * width, np.int32)
    count = 0
    pixels, owners = unknown.reshape(-1), labels.reshape(-1)
    for start in range(height * width):
        if not pixels[start] or owners[start] != 0:
            continue
        count += 1
        size, top, seen = 1, 1, 0
        stack[0] = start
        owners[start] = count
        # The stack doubles as the list of members: it is never overwritten before `seen`.
        while seen < top:
            pixel = stack[seen]
            seen += 1
            v, u = pixel // width, pixel % width
            d = depth[v, u]
            for b in range(-2, 3):
                for a in range(-2, 3):
                    y, x = v + b, u + a
                    if y < 0 or x < 0 or y >= height or x >= width or labels[y, x] != 0 or not unknown[y, x]:
                        continue
                    if abs(depth[y, x] - d) < join * max(d * d, 1.0):
                        labels[y, x] = count
                        stack[top] = y * width + x
                        top += 1
                        size += 1
        if size < min_pixels:
            for i in range(top):
                owners[stack[i]] = -1
            count -= 1
    for i in range(height * width):
        owners[i] = max(owners[i], 0)
    return labels, count


@njit(cache=True, nogil=True)
def _grow(labels, doubtful, depth, join, steps):
    """Let clusters take in doubtful pixels that touch them without a depth step, pixel ring by pixel ring."""
    height, width = labels.shape
    front = np.empty(height * width, np.int32)
    count = 0
    for v in range(height):
        for u in range(width):
            if labels[v, u] > 0:
                front[count] = v * width + u
                count += 1
    start = 0
    for _ in range(steps):
        end = count
        for k in range(start, end):
            v, u = front[k] // width, front[k] % width
            d = depth[v, u]
            for b in range(-1, 2):
                for a in range(-1, 2):
                    y, x = v + b, u + a
                    if y < 0 or x < 0 or y >= height or x >= width or labels[y, x] != 0 or not doubtful[y, x]:
                        continue
                    if depth[y, x] > 0.0 and abs(depth[y, x] - d) < join * max(d * d, 1.0):
                        labels[y, x] = labels[v, u]
                        front[count] = y * width + x
                        count += 1
        start = end


def _camera_regions(
    labels: Int32, count: int, depth: Float32, K: CameraIntrinsics, T_map_camera: Float64, stamp: int
) -> tuple[RegionOfInterest, ...]:
    boxes, bounds, sizes = np.zeros((count, 4)), np.empty((count, 2, 3)), np.zeros(count, np.int64)
    _bound(labels, depth, np.array([K.fx, K.fy, K.cx, K.cy]), T_map_camera, boxes, bounds, sizes)
    return tuple(
        _region(stamp, low, high, box, size, "camera")
        for (low, high), box, size in zip(bounds, boxes, sizes.tolist(), strict=True)
    )


@njit(cache=True, nogil=True)
def _bound(labels, depth, camera, T_map_camera, boxes, bounds, sizes):
    """Pixel boxes (K, 4), bounds (K, 2, 3) in the map, metres, and sizes (K,) in pixels of clusters 1 to K."""
    boxes[:, :2], boxes[:, 2:], bounds[:, 0], bounds[:, 1] = np.inf, 0.0, np.inf, -np.inf
    for v in range(labels.shape[0]):
        for u in range(labels.shape[1]):
            k = labels[v, u] - 1
            if k < 0:
                continue
            sizes[k] += 1
            box = boxes[k]
            box[0], box[1], box[2], box[3] = min(box[0], u), min(box[1], v), max(box[2], u + 1), max(box[3], v + 1)
            d = float(depth[v, u])
            x, y = d * (u - camera[2]) / camera[0], d * (v - camera[3]) / camera[1]
            for i in range(3):
                T = T_map_camera[i]
                at = T[0] * x + T[1] * y + T[2] * d + T[3]
                bounds[k, 0, i], bounds[k, 1, i] = min(bounds[k, 0, i], at), max(bounds[k, 1, i], at)


def _cluster_points(points: Float64, distance: float, min_points: int) -> tuple[Int32, int]:
    """Euclidean clusters of (N, 3) points: labels from 1 (0 = in no cluster of `min_points`) and their number."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    labels = np.zeros(len(points), np.int32)
    if len(points) < min_points:
        return labels, 0
    pairs = KDTree(points).query_pairs(distance, output_type="ndarray")
    ones = np.ones(len(pairs), bool)
    graph = coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    _, component = connected_components(graph, directed=False)
    sizes = np.bincount(component)
    kept = np.flatnonzero(sizes >= min_points)
    number = np.zeros(len(sizes), np.int32)
    number[kept] = np.arange(1, len(kept) + 1)
    return number[component], len(kept)


def _region(stamp: int, low: Float64, high: Float64, box: Float64, size: int, sensor: str) -> RegionOfInterest:
    return RegionOfInterest(stamp, box, 0.5 * (low + high), high - low, size, sensor)
