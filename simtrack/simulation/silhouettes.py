"""Rays over the silhouettes of objects: with them the ground truth measures how much of each is seen."""

import numpy as np
from numba import njit

from simtrack.contracts import CameraIntrinsics, Float32, Float64, Int32
from simtrack.geometry.projection import bounding_rectangle

RAYS = 900
"""About how many rays cover the box of one object's silhouette."""


def silhouette_rays(
    corners: Float64, poses: Float64, camera: CameraIntrinsics
) -> tuple[Int32, Float32, Int32, Float64]:
    """Rays over the projected boxes of the objects that may be seen in an image, on its pixel grid.

    What lies beside the image, or reaches behind the camera, has none.

    Args:
        corners: (K, 8, 3) of the objects' boxes, object frames, metres.
        poses: (K, 4, 4) T_camera_object.
        camera: intrinsics.

    Returns:
        Of each ray (R,) the object, its direction (R, 3), camera frame, z = 1, and the flat index of the pixel whose
        centre it goes through, -1 outside of the image; and the pixels (K,) that a ray of each object stands for.
    """
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    boxes = np.zeros((len(corners), 5), np.int64)
    count = _boxes(corners, poses, intrinsics, camera.width, camera.height, boxes)
    owners, rays, pixels = np.empty(count, np.int32), np.empty((count, 3), np.float32), np.empty(count, np.int32)
    _fill(boxes, intrinsics, camera.width, camera.height, owners, rays, pixels)
    return owners, rays, pixels, boxes[:, 4].astype(float) ** 2


@njit(cache=True, nogil=True)
def _boxes(corners, poses, camera, width, height, boxes):
    """Pixel boxes and strides (K, 5) u0, v0, columns, rows, stride; no columns without rays. Returns their number."""
    count = 0
    for k in range(corners.shape[0]):
        shown, u_low, v_low, u_high, v_high = bounding_rectangle(corners[k], poses[k], camera)
        beside = u_high < -0.5 or v_high < -0.5 or u_low > width - 0.5 or v_low > height - 0.5
        if not shown or beside:
            continue
        stride = max(1, int(np.sqrt((u_high - u_low) * (v_high - v_low) / RAYS)))
        boxes[k, 0], boxes[k, 1], boxes[k, 4] = int(np.floor(u_low)), int(np.floor(v_low)), stride
        boxes[k, 2] = (int(np.ceil(u_high)) - boxes[k, 0]) // stride + 1
        boxes[k, 3] = (int(np.ceil(v_high)) - boxes[k, 1]) // stride + 1
        count += boxes[k, 2] * boxes[k, 3]
    return count


@njit(cache=True, nogil=True)
def _fill(boxes, camera, width, height, owners, rays, pixels):
    found = 0
    for k in range(boxes.shape[0]):
        for row in range(boxes[k, 3]):
            v = boxes[k, 1] + row * boxes[k, 4]
            for column in range(boxes[k, 2]):
                u = boxes[k, 0] + column * boxes[k, 4]
                owners[found] = k
                rays[found, 0], rays[found, 1] = (u - camera[2]) / camera[0], (v - camera[3]) / camera[1]
                rays[found, 2] = 1.0
                pixels[found] = v * width + u if 0 <= u < width and 0 <= v < height else -1
                found += 1
