"""Bundles of rays in a sensor's frame, packed once so that neighbouring rays are traced together."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numba as nb
import numpy as np
import numpy.typing as npt

from simtrack.contracts import CameraIntrinsics, Float32, Int32
from simtrack.errors import InvalidValueError
from simtrack.raycast import embree as rtc
from simtrack.raycast.kernels import CHUNK, GROUP


def packet_width() -> int:
    """Rays in a packet: the CPU's native width, or 8 where the library is not reached (the fallback ignores it)."""
    return rtc.embree().packet_width if rtc.available() else 8


@dataclass(frozen=True, slots=True, eq=False)
class RayBundle:
    """Rays that leave one point, in the frame of their sensor, with the order in which packets take them."""

    directions: Float32
    """(N, 3), sensor frame, in the caller's order; need not be unit vectors."""
    order: Int32
    """(P,), ray of each packet lane, P a multiple of the packet width; the last ray of a group fills spare lanes."""
    packed: Float32
    """(P / width, 3, width), the directions in packet order."""
    pixels: Int32 | None = None
    """(N,), flat pixel index ``row * image width + column`` of each ray, None for a bundle without an image."""
    shape: tuple[int, ...] = ()
    """Shape of the pixel grid for `from_camera`, so that ``hits.distances.reshape(bundle.shape)`` is an image."""
    cones: Float32 = field(default_factory=lambda: np.empty((0, 6), np.float32))
    """(G, 6) around the rays of each `kernels.GROUP` packets: axis (unit, sensor frame), and of the half opening angle
    cosine, sine and 1 - cosine. Without them casting asks every instance."""

    def __len__(self) -> int:
        return len(self.directions)

    @staticmethod
    def from_camera(
        intrinsics: CameraIntrinsics, stride: int = 1, window: tuple[int, int, int, int] | None = None
    ) -> "RayBundle":
        """Rays through pixel centres, row by row, with z = 1: the distance along a ray is depth along the optical axis.

        Args:
            intrinsics: the camera.
            stride: every `stride`-th column and row, at pixel coordinates (u, v) that are multiples of it, so that
                windows of equal stride share pixels.
            window: half-open pixel box (u0, v0, u1, v1), clipped to the image; the whole image if None.

        Raises:
            InvalidValueError: `stride` below 1.
        """
        if stride < 1:
            raise InvalidValueError("stride", stride, ">= 1")
        return _grid(intrinsics, stride, _clip(window, intrinsics), packet_width())

    @staticmethod
    def from_pixels(intrinsics: CameraIntrinsics, pixels: npt.ArrayLike) -> "RayBundle":
        """Rays through the given pixels, in the given order, packed along a Morton curve; z = 1.

        Args:
            intrinsics: the camera.
            pixels: (N,) flat pixel indices ``row * width + column``.

        Raises:
            InvalidValueError: an index outside the image.
        """
        flat = np.ascontiguousarray(pixels, np.int32).ravel()
        count = intrinsics.width * intrinsics.height
        if flat.size and not (flat.min() >= 0 and flat.max() < count):
            raise InvalidValueError("pixels", (int(flat.min()), int(flat.max())), f"flat indices 0..{count - 1}")
        return _from_pixels(intrinsics, flat, 1, (len(flat),), packet_width())

    @staticmethod
    def from_windows(
        intrinsics: CameraIntrinsics,
        windows: Sequence[tuple[int, int, int, int]] | npt.NDArray[np.int64],
        strides: Sequence[int] | npt.NDArray[np.int64] | int = 1,
    ) -> "RayBundle":
        """Rays of the union of windows (see `from_camera`), each with its stride; every pixel once, row-major."""
        boxes = np.array(windows, np.int64).reshape(-1, 4)
        steps = np.full(len(boxes), strides, np.int64) if isinstance(strides, int) else np.array(strides, np.int64)
        if len(steps) != len(boxes) or (len(steps) and steps.min() < 1):
            raise InvalidValueError("strides", strides, f"one number >= 1, or {len(boxes)} of them")
        camera = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
        columns, rows = _camera_tables(intrinsics, 1)
        pixels, directions, order, packed, cones = _window_bundle(
            boxes, steps, intrinsics.width, intrinsics.height, columns, rows, *camera, packet_width()
        )
        return RayBundle(directions, order, packed, pixels, (len(pixels),), cones)

    @staticmethod
    def from_directions(directions: npt.ArrayLike, groups: npt.ArrayLike | None = None) -> "RayBundle":
        """Rays along given directions, packed in their order, or group by group.

        Args:
            directions: (N, 3), sensor frame; distances are measured in multiples of their length.
            groups: (N,) integers, e.g. a lidar's rings: packets hold rays of one group, in order. Packets of rays that
                are near in the caller's order are traced together: what a turning lidar sees at a time.

        Raises:
            InvalidValueError: wrong shape, or a direction that is not finite.
        """
        rays = np.ascontiguousarray(directions, np.float32)
        if rays.ndim != 2 or rays.shape[1] != 3 or not np.isfinite(rays).all():
            raise InvalidValueError("directions", rays.shape, "finite (N, 3)")
        labels = np.zeros(len(rays), np.int64) if groups is None else np.asarray(groups)
        if labels.shape != (len(rays),):
            raise InvalidValueError("groups", labels.shape, f"({len(rays)},) integers")
        width = packet_width()
        lanes: list[np.ndarray] = []
        for members in np.split(np.argsort(labels, kind="stable"), _group_starts(labels)):
            spare = -len(members) % width
            lanes.append(np.concatenate([members, np.repeat(members[-1:], spare)]))
        order = np.concatenate(lanes).astype(np.int32).reshape(-1, width)
        order = order[np.argsort(order[:, 0], kind="stable")]
        order = order[np.lexsort((labels[order[:, 0]], np.arange(len(order)) // CHUNK))].ravel()
        packed = np.ascontiguousarray(rays[order].reshape(-1, width, 3).transpose(0, 2, 1))
        return RayBundle(rays, order, packed, cones=_cones(packed))


def checked_rays(
    origins: npt.ArrayLike, directions: npt.ArrayLike, times: npt.ArrayLike | None, packing: RayBundle | None
) -> tuple[Float32, Float32, Float32, Int32]:
    """Rays of their own origin and time as kernels take them; arguments as of `simtrack.raycast.RayScene.cast_rays`.

    Returns:
        Origins and directions (N, 3), times (N,) or none, and the order (P,) in which packets take the rays.

    Raises:
        InvalidValueError: wrong shapes, or a packing of another number of rays.
    """
    starts, rays = np.require(origins, np.float32, ["C", "W"]), np.require(directions, np.float32, ["C", "W"])
    if rays.ndim != 2 or rays.shape[1] != 3 or starts.shape != rays.shape:
        raise InvalidValueError("origins, directions", (starts.shape, rays.shape), "two arrays (N, 3)")
    count = len(rays)
    moments = np.empty(0, np.float32) if times is None else np.require(times, np.float32, ["C", "W"])
    if times is not None and moments.shape != (count,):
        raise InvalidValueError("times", moments.shape, f"({count},)")
    if packing is not None:
        if len(packing) != count:
            raise InvalidValueError("packing", len(packing), f"a bundle of {count} rays")
        return starts, rays, moments, packing.order
    width = rtc.embree().packet_width if rtc.available() else 1
    order = np.minimum(np.arange(-(-count // width) * width, dtype=np.int32), np.int32(max(count - 1, 0)))
    return starts, rays, moments, order


def _group_starts(labels: np.ndarray) -> np.ndarray:
    _, counts = np.unique(labels, return_counts=True)
    return np.cumsum(counts)[:-1]


@lru_cache(maxsize=8)
def _grid(intrinsics: CameraIntrinsics, stride: int, window: tuple[int, int, int, int], width: int) -> RayBundle:
    """Rays of a window of the image in packets of `width`: a camera's are the same for every image."""
    u0, v0, u1, v1 = window
    columns = np.arange(-(-u0 // stride) * stride, u1, stride, dtype=np.int32)
    rows = np.arange(-(-v0 // stride) * stride, v1, stride, dtype=np.int32)
    pixels = (rows[:, None] * intrinsics.width + columns).ravel()
    return _from_pixels(intrinsics, pixels, stride, (len(rows), len(columns)), width)


def _clip(window: tuple[int, int, int, int] | None, intrinsics: CameraIntrinsics) -> tuple[int, int, int, int]:
    u0, v0, u1, v1 = (0, 0, intrinsics.width, intrinsics.height) if window is None else (int(x) for x in window)
    return max(u0, 0), max(v0, 0), min(u1, intrinsics.width), min(v1, intrinsics.height)


@lru_cache(maxsize=8)
def _camera_tables(intrinsics: CameraIntrinsics, stride: int) -> tuple[npt.NDArray[np.int64], ...]:
    """Morton code of each column and each row on the grid of `stride`: a pixel's code is their sum."""
    return tuple(
        _spread_bits(np.arange(n) // stride) << shift for n, shift in ((intrinsics.width, 0), (intrinsics.height, 1))
    )


def _spread_bits(value: np.ndarray) -> npt.NDArray[np.int64]:
    """Bits of a 16-bit number moved to the even places."""
    out = value.astype(np.int64)
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        out = (out | (out << shift)) & mask
    return out


def _from_pixels(
    intrinsics: CameraIntrinsics, pixels: Int32, stride: int, shape: tuple[int, ...], width: int
) -> RayBundle:
    columns, rows = _camera_tables(intrinsics, stride)
    camera = (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy)
    directions, order, packed = _pack_pixels(pixels, intrinsics.width, columns, rows, *camera, width)
    return RayBundle(directions, order, packed, pixels, shape, _pixel_cones(packed))


@nb.njit(cache=True, nogil=True)
def _union(boxes, steps, image_width):
    """Ascending flat indices of the pixels (K, 4) boxes (u0, v0, u1, v1) hold at multiples of their (K,) steps."""
    top, bottom, room = 1 << 30, 0, 0
    for k in range(boxes.shape[0]):
        top, bottom = min(top, boxes[k, 1]), max(bottom, boxes[k, 3])
        size = (boxes[k, 2] - boxes[k, 0]) * (boxes[k, 3] - boxes[k, 1])
        room += max(0, size)
    seen = np.zeros(image_width, np.bool_)
    pixels = np.empty(room, np.int32)
    count = 0
    for v in range(top, bottom):
        low, high = image_width, 0
        for k in range(boxes.shape[0]):
            if boxes[k, 1] <= v < boxes[k, 3] and v % steps[k] == 0:
                start = (boxes[k, 0] + steps[k] - 1) // steps[k] * steps[k]
                low, high = min(low, start), max(high, boxes[k, 2])
                for u in range(start, boxes[k, 2], steps[k]):
                    seen[u] = True
        for u in range(low, high):
            if seen[u]:
                pixels[count] = v * image_width + u
                count += 1
                seen[u] = False
    return pixels[:count].copy()


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _cones(packed):
    """(G, 6) float32 cones around the directions of each `GROUP` packets (see `RayBundle.cones`)."""
    packets, _, width = packed.shape
    out = np.empty(((packets + GROUP - 1) // GROUP, 6), np.float32)
    for group in range(out.shape[0]):
        first, last = group * GROUP, min((group + 1) * GROUP, packets)
        ax, ay, az = 0.0, 0.0, 0.0
        for p in range(first, last):
            for k in range(width):
                ax, ay, az = ax + packed[p, 0, k], ay + packed[p, 1, k], az + packed[p, 2, k]
        axis = ax * ax + ay * ay + az * az
        least = 1.0  # of the squared cosines, with the sign of the cosine
        for p in range(first, last):
            for k in range(width):
                x, y, z = np.float64(packed[p, 0, k]), np.float64(packed[p, 1, k]), np.float64(packed[p, 2, k])
                along = ax * x + ay * y + az * z
                least = min(least, along * abs(along) / (axis * (x * x + y * y + z * z)))
        _write_cone(out[group], ax, ay, az, least)
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _pixel_cones(packed):
    """As `_cones`, for directions with z = 1: around the rectangles that hold them, which takes less time."""
    packets, _, width = packed.shape
    out = np.empty(((packets + GROUP - 1) // GROUP, 6), np.float32)
    for group in range(out.shape[0]):
        low_x, low_y = np.float32(np.inf), np.float32(np.inf)
        high_x, high_y = -low_x, -low_y
        for p in range(group * GROUP, min((group + 1) * GROUP, packets)):
            for k in range(width):
                low_x, high_x = min(low_x, packed[p, 0, k]), max(high_x, packed[p, 0, k])
                low_y, high_y = min(low_y, packed[p, 1, k]), max(high_y, packed[p, 1, k])
        ax, ay = 0.5 * (np.float64(low_x) + high_x), 0.5 * (np.float64(low_y) + high_y)
        axis = ax * ax + ay * ay + 1.0
        least = 1.0
        for x in (np.float64(low_x), np.float64(high_x)):
            for y in (np.float64(low_y), np.float64(high_y)):
                along = ax * x + ay * y + 1.0
                least = min(least, along * abs(along) / (axis * (x * x + y * y + 1.0)))
        _write_cone(out[group], ax, ay, 1.0, least)
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _write_cone(cone, ax, ay, az, least):
    """Cone around an axis of any length, whose least cosine times its absolute value is `least`."""
    length = np.sqrt(ax * ax + ay * ay + az * az)
    cosine = np.sqrt(abs(least)) if least > 0.0 else -np.sqrt(abs(least))
    if not (length > 0.0 and cosine > -1.0):  # directions that cancel, or none
        ax, ay, az, length, cosine = 0.0, 0.0, 1.0, 1.0, -1.0
    cone[0], cone[1], cone[2] = ax / length, ay / length, az / length
    cone[3], cone[4], cone[5] = cosine, np.sqrt(1.0 - cosine * cosine), 1.0 - cosine


@nb.njit(cache=True, nogil=True)
def _pack_pixels(pixels, image_width, columns, rows, fx, fy, cx, cy, width):
    """Directions (N, 3), packet order (P,) along the Morton curve, and directions in that order (P / width, 3, width).

    Eight consecutive pixels of a filled image along the curve are a 4x2 tile, sixteen a 4x4 tile; sparse and strided
    sets stay as compact as they can be. Sorted by two stable counting passes.
    """
    n = pixels.shape[0]
    directions = np.empty((n, 3), np.float32)
    codes = np.empty(n, np.int64)
    for i in range(n):
        v = pixels[i] // image_width
        u = pixels[i] - v * image_width
        codes[i] = columns[u] + rows[v]
        directions[i, 0] = (u - cx) / fx
        directions[i, 1] = (v - cy) / fy
        directions[i, 2] = 1.0
    bits = 1
    while (columns[-1] + rows[-1]) >> (2 * bits):
        bits += 1
    packets = (n + width - 1) // width
    order = np.empty(packets * width, np.int32)
    first = np.empty(n, np.int32)
    for step in range(2):
        start = np.zeros((1 << bits) + 1, np.int64)
        mask = (1 << bits) - 1
        shift = step * bits
        for i in range(n):
            start[((codes[i] >> shift) & mask) + 1] += 1
        for b in range(1 << bits):
            start[b + 1] += start[b]
        for j in range(n):
            i = j if step == 0 else first[j]
            digit = (codes[i] >> shift) & mask
            if step == 0:
                first[start[digit]] = i
            else:
                order[start[digit]] = i
            start[digit] += 1
    for lane in range(n, packets * width):
        order[lane] = order[n - 1]
    for p in range(packets):  # ascending, so that neighbours in a row of pixels are neighbours
        for k in range(p * width + 1, (p + 1) * width):
            i = order[k]
            j = k
            while j > p * width and order[j - 1] > i:
                order[j] = order[j - 1]
                j -= 1
            order[j] = i
    packed = np.empty((packets, 3, width), np.float32)
    for p in range(packets):
        for k in range(width):
            i = order[p * width + k]
            for axis in range(3):
                packed[p, axis, k] = directions[i, axis]
    return directions, order, packed


@nb.njit(cache=True, nogil=True)
def _window_bundle(boxes, steps, image_width, image_height, columns, rows, fx, fy, cx, cy, width):
    """Pixels, directions, order, directions in that order, and cones of windows; `boxes` are clipped to the image."""
    for k in range(boxes.shape[0]):
        boxes[k, 0], boxes[k, 1] = max(boxes[k, 0], 0), max(boxes[k, 1], 0)
        boxes[k, 2], boxes[k, 3] = min(boxes[k, 2], image_width), min(boxes[k, 3], image_height)
    pixels = _union(boxes, steps, image_width)
    directions, order, packed = _pack_pixels(pixels, image_width, columns, rows, fx, fy, cx, cy, width)
    return pixels, directions, order, packed, _pixel_cones(packed)
