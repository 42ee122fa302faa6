"""The surface that one scan or one depth image saw, triangulated in the order of its rays.

Rays that lie side by side are taken to have met the same surface unless the triangle between them would have been seen
at a grazing angle, as those are that span the step from a thing to what is behind it. Before, neighbouring readings are
merged to their median, so that the sensor's noise does not tilt the small triangles.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from simtrack.contracts import Bool, Float64, Int32, LidarScan, RgbdFrame
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import Mesh


@dataclass(frozen=True, slots=True)
class ScanMeshConfig:
    """Settings of `mesh_of_scan` and `mesh_of_depth`."""

    azimuth_cell: float = 0.0175
    """Radians: lidar shots within it of each other, at about the same elevation, become one vertex."""
    elevation_cell: float = 0.0058
    """Radians, likewise; below the distance between two rings."""
    max_gap: float = 0.06
    """Radians, opening (half) of the widest cone between lidar shots that counts as seen."""
    columns: int = 160
    """About so many vertices stand in a row of a depth image, each of a square block of pixels."""
    min_grazing: float = 0.17
    """Radians between ray and surface below which a triangle is dropped."""
    max_edge: float = 2.0
    """Metres: triangles with longer edges are dropped."""
    min_range: float = 0.3
    """Metres: nearer readings are not used ..."""
    max_range: float = 60.0
    """... nor farther ones of a lidar ..."""
    max_depth: float = 5.0
    """... nor farther ones of a depth camera, which grow too coarse."""

    def __post_init__(self) -> None:
        for name in ("azimuth_cell", "elevation_cell", "max_gap", "max_edge", "max_range", "max_depth"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InvalidValueError(f"ScanMeshConfig.{name}", getattr(self, name), "a finite number > 0")
        if self.columns < 2:
            raise InvalidValueError("ScanMeshConfig.columns", self.columns, "2 or more")
        if not 0.0 <= self.min_grazing < np.pi / 2:
            raise InvalidValueError("ScanMeshConfig.min_grazing", self.min_grazing, "0 to pi/2 radians")


def mesh_of_scan(scan: LidarScan, config: ScanMeshConfig | None = None, keep: Bool | None = None) -> Mesh:
    """Triangulate one turn, taken as if all shots left from one place.

    The directions are triangulated on the sphere (Delaunay's triangulation there is the convex hull), so the shots need
    no order: a ring lidar's, a solid-state one's and those of a point cloud in its sensor's frame will do.

    Args:
        scan: one turn; shots without return leave holes.
        config: settings, the defaults if None.
        keep: (N,) bool, False for shots to leave out; None keeps all.

    Returns:
        Open mesh in the lidar frame, faces towards the sensor; empty if fewer than four directions are left.
    """
    config = config or ScanMeshConfig()
    directions, ranges = _merged(scan, config, keep)
    if len(ranges) < 4:
        return Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32))
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(directions)
    except QhullError:  # all directions in one plane: a single ring sees no surface
        return Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32))
    # The plane of a facet cuts an empty cone out of the sphere: large where nothing was measured between its corners,
    # as above the uppermost ring, whose neighbours would make triangles with each other.
    faces = hull.simplices[-hull.equations[:, 3] >= np.cos(config.max_gap)]
    return _seen(directions * ranges[:, None], faces, config)


def mesh_of_depth(frame: RgbdFrame, config: ScanMeshConfig | None = None, keep: Bool | None = None) -> Mesh:
    """Triangulate a depth image.

    Args:
        frame: depth (H, W), metres.
        config: settings, the defaults if None.
        keep: (H, W) bool, False for pixels to leave out; None keeps all.

    Returns:
        Open mesh in the camera frame, faces towards the camera.
    """
    config = config or ScanMeshConfig()
    depth = np.where(np.isfinite(frame.depth), frame.depth, 0.0)
    depth = np.where((depth >= config.min_range) & (depth <= config.max_depth), depth, np.nan)
    if keep is not None:
        depth[~keep] = np.nan
    camera = frame.intrinsics
    block = max(1, round(camera.width / config.columns))
    rows, columns = depth.shape[0] // block, depth.shape[1] // block
    blocks = depth[: rows * block, : columns * block].reshape(rows, block, columns, block)
    blocks = blocks.transpose(0, 2, 1, 3).reshape(rows, columns, block * block)
    valid = np.isfinite(blocks).sum(axis=2) >= (block * block + 1) // 2
    z = np.full((rows, columns), np.nan)
    if valid.any():
        z[valid] = np.nanmedian(blocks[valid], axis=1)
    u = (np.arange(columns) + 0.5) * block - 0.5
    v = (np.arange(rows) + 0.5) * block - 0.5
    x, y = (u - camera.cx) / camera.fx * z, ((v - camera.cy) / camera.fy)[:, None] * z
    points = np.stack([x, y, z], axis=2).reshape(-1, 3)
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    return _seen(points, faces[np.isfinite(points[faces]).all(axis=(1, 2))], config)


def _merged(scan: LidarScan, config: ScanMeshConfig, keep: Bool | None) -> tuple[Float64, Float64]:
    """(K, 3) unit directions and (K,) ranges in metres, one a cell: their mean and their lower median."""
    with np.errstate(invalid="ignore"):
        near = (scan.ranges >= config.min_range) & (scan.ranges <= config.max_range)
    used = np.flatnonzero(near if keep is None else near & keep)
    directions, ranges = scan.directions[used].astype(np.float64), scan.ranges[used].astype(np.float64)
    azimuth = np.floor(np.arctan2(directions[:, 1], directions[:, 0]) / config.azimuth_cell).astype(np.int64)
    elevation = np.arcsin(np.clip(directions[:, 2], -1.0, 1.0))
    cells = np.empty(len(used), np.int64)
    order = np.lexsort((elevation, azimuth))
    cells[order] = _grouped(azimuth[order], elevation[order], config.elevation_cell)
    order = np.lexsort((ranges, cells))
    directions, ranges = directions[order], ranges[order]
    starts = np.flatnonzero(np.diff(cells[order], prepend=-1))
    counts = np.diff(np.append(starts, len(order)))
    if not len(starts):
        return np.empty((0, 3)), np.empty(0)
    means = np.add.reduceat(directions, starts, axis=0)
    means /= np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-12)
    return means, ranges[starts + (counts - 1) // 2]


@njit(cache=True, nogil=True)
def _grouped(columns, elevations, span):
    """(N,) running number of the cell of each shot, of shots sorted by column and elevation.

    Cells begin at their lowest shot, so that none splits a ring, whose shots would then make two vertices that all but
    coincide, and triangles between them that point anywhere.
    """
    cells = np.empty(len(columns), np.int64)
    cell, column, lowest = -1, 0, 0.0
    for i in range(len(columns)):
        if i == 0 or columns[i] != column or elevations[i] - lowest > span:
            cell, column, lowest = cell + 1, columns[i], elevations[i]
        cells[i] = cell
    return cells


def _seen(points: Float64, faces: npt.NDArray[np.integer], config: ScanMeshConfig) -> Mesh:
    """The faces that a sensor at the origin saw steeply enough, turned towards it, over the vertices that they use."""
    corners = points[faces]
    sides = corners - np.roll(corners, 1, axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middle = corners.mean(axis=1)
    towards = -np.einsum("ij,ij->i", normals, middle)
    size = np.linalg.norm(normals, axis=1) * np.linalg.norm(middle, axis=1)
    kept = np.abs(towards) > np.sin(config.min_grazing) * size
    kept &= (np.einsum("ijk,ijk->ij", sides, sides) <= config.max_edge**2).all(axis=1)
    turned = np.where((towards < 0.0)[:, None], faces[:, ::-1], faces)[kept]
    used, renumbered = np.unique(turned, return_inverse=True)
    return Mesh(points[used], _as_faces(renumbered))


def _as_faces(indices: npt.NDArray[np.integer]) -> Int32:
    return indices.reshape(-1, 3).astype(np.int32)
