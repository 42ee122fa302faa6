"""Compiled loops of the labels: hits to images, visible parts, windows and silhouettes."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def to_images(distances, normals, faces, instances, first, by_face, owners, R_camera_map, camera, far, out):
    """Images of what rays through all pixels met; `out` is (ids (H, W), depth (H, W), normals (H, W, 3))."""
    ids, depth, turned = out
    fx, fy, cx, cy = camera
    height, width = ids.shape
    R = R_camera_map.astype(np.float32)
    k = 0
    for v in range(height):
        y = np.float32((v - cy) / fy)
        for u in range(width):
            instance = instances[k]
            if instance < 0:
                ids[v, u], depth[v, u] = -1, 0.0
                turned[v, u, 0] = turned[v, u, 1] = turned[v, u, 2] = 0.0
            else:
                ids[v, u] = owners[first[instance] + (faces[k] if by_face[instance] else 0)]
                depth[v, u] = distances[k] if distances[k] <= far else 0.0
                a, b, c = normals[k, 0], normals[k, 1], normals[k, 2]
                nx = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c
                ny = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c
                nz = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c
                x = np.float32((u - cx) / fx)
                side = np.float32(-1.0) if nx * x + ny * y + nz > 0.0 else np.float32(1.0)
                turned[v, u, 0], turned[v, u, 1], turned[v, u, 2] = side * nx, side * ny, side * nz
            k += 1


@njit(cache=True, nogil=True)
def visible_parts(ids, count):
    """Pixels (N,) and boxes (N, 4) (u0, v0, u1, v1; u1 < u0 without a pixel) of the ids 0..count-1 in an image."""
    pixels = np.zeros(count, np.int64)
    boxes = np.empty((count, 4), np.int64)
    height, width = ids.shape
    for k in range(count):
        boxes[k, 0], boxes[k, 1], boxes[k, 2], boxes[k, 3] = width, height, -1, -1
    for v in range(height):
        u = 0
        while u < width:
            owner, start = ids[v, u], u
            while u < width and ids[v, u] == owner:
                u += 1
            if 0 <= owner < count:
                pixels[owner] += u - start
                boxes[owner, 0], boxes[owner, 2] = min(boxes[owner, 0], start), max(boxes[owner, 2], u - 1)
                boxes[owner, 1], boxes[owner, 3] = min(boxes[owner, 1], v), v
    return pixels, boxes


@njit(cache=True, nogil=True)
def _widen(box, u, v):
    box[0], box[1] = min(box[0], u), min(box[1], v)
    box[2], box[3] = max(box[2], u), max(box[3], v)


@njit(cache=True, nogil=True, error_model="numpy")
def projected_box(vertices, faces, T_camera_mesh, camera, near):
    """(4,) u0, v0, u1, v1 in pixels of what of a mesh lies beyond the near plane; u1 < u0 if nothing does."""
    fx, fy, cx, cy = camera
    T = T_camera_mesh
    count = vertices.shape[0]
    points = np.empty((count, 3))
    box = np.array([np.inf, np.inf, -np.inf, -np.inf])
    crosses = False
    for i in range(count):
        a, b, c = np.float64(vertices[i, 0]), np.float64(vertices[i, 1]), np.float64(vertices[i, 2])
        for k in range(3):
            points[i, k] = T[k, 0] * a + T[k, 1] * b + T[k, 2] * c + T[k, 3]
        if points[i, 2] >= near:
            _widen(box, fx * points[i, 0] / points[i, 2] + cx, fy * points[i, 1] / points[i, 2] + cy)
        else:
            crosses = True
    if crosses:
        for f in range(faces.shape[0]):
            for k in range(3):
                p, q = points[faces[f, k]], points[faces[f, (k + 1) % 3]]
                if (p[2] >= near) != (q[2] >= near):
                    s = (near - p[2]) / (q[2] - p[2])
                    x, y = p[0] + s * (q[0] - p[0]), p[1] + s * (q[1] - p[1])
                    _widen(box, fx * x / near + cx, fy * y / near + cy)
    return box


@njit(cache=True, nogil=True, error_model="numpy")
def hidden_rays(window, ids, own, R_mesh_camera, camera):
    """Where in a window (u0, v0, u1, v1, last pixel included) an instance is not seen, but may be behind something.

    Returns:
        Pixels (N, 2) and directions (N, 3) in the mesh's frame, of the length that has z = 1 in the camera's; in tiles
        of 4x4 pixels, so that neighbouring rays stay together.
    """
    fx, fy, cx, cy = camera
    height, width = ids.shape
    u0, v0, u1, v1 = window
    R = R_mesh_camera.astype(np.float32)
    room = max(0, u1 - u0 + 1) * max(0, v1 - v0 + 1)
    pixels, directions = np.empty((room, 2), np.int32), np.empty((room, 3), np.float32)
    n = 0
    for top in range(v0, v1 + 1, 4):
        for left in range(u0, u1 + 1, 4):
            for v in range(top, min(top + 4, v1 + 1)):
                for u in range(left, min(left + 4, u1 + 1)):
                    if 0 <= u < width and 0 <= v < height and ids[v, u] == own:
                        continue
                    x, y = np.float32((u - cx) / fx), np.float32((v - cy) / fy)
                    pixels[n, 0], pixels[n, 1] = u, v
                    for k in range(3):
                        directions[n, k] = R[k, 0] * x + R[k, 1] * y + R[k, 2]
                    n += 1
    return pixels[:n], directions[:n]


@njit(cache=True, nogil=True)
def fill_silhouette(visible_box, ids, own, depth, pixels, met, mask):
    """Write the silhouette's part inside the image into `mask` (H, W), which is False everywhere.

    Returns:
        Pixels of the whole silhouette, those of them inside the image with a reading in `depth`, and the box (u0, v0,
        u1, v1) of the whole.
    """
    height, width = ids.shape
    total, valid = 0, 0
    u0, v0, u1, v1 = visible_box
    for v in range(v0, v1 + 1):
        for u in range(u0, u1 + 1):
            if ids[v, u] == own:
                mask[v, u] = True
                total += 1
                valid += depth[v, u] > 0.0
    for k in range(pixels.shape[0]):
        if met[k]:
            u, v = pixels[k, 0], pixels[k, 1]
            total += 1
            u0, v0, u1, v1 = min(u0, u), min(v0, v), max(u1, u), max(v1, v)
            if 0 <= u < width and 0 <= v < height:
                mask[v, u] = True
                valid += depth[v, u] > 0.0
    return total, valid, (u0, v0, u1, v1)
