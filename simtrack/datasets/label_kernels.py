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


@njit(cache=True, nogil=True, error_model="numpy")
def silhouette(vertices, faces, closed, T_camera_mesh, camera, near, seen_box, ids, own, depth, mask):
    """Every pixel whose centre lies in the projection of a face: what rays meet of a mesh that stands alone.

    Of a closed mesh the faces on one side are enough: what looks in through one of them looks out through another.

    Pixels that show the instance `own` in `ids` (H, W), which lie in `seen_box` (u0, v0, u1, v1), belong to it whatever
    rounding says. The part inside the image is written into `mask` (H, W), which is False everywhere.

    Returns:
        Pixels of the whole on the canvas of three images by three, those inside the image with a reading in `depth`
        (H, W), and the box (u0, v0, u1, v1) of the whole; u1 < u0 without a pixel.
    """
    height, width = ids.shape
    points, bounds, crosses = _project(vertices, faces, T_camera_mesh, camera, near)
    u0, v0 = int(max(np.ceil(bounds[0]), -width)), int(max(np.ceil(bounds[1]), -height))
    u1, v1 = int(min(np.floor(bounds[2]), 2 * width - 1)), int(min(np.floor(bounds[3]), 2 * height - 1))
    if seen_box[2] >= seen_box[0]:
        u0, v0, u1, v1 = min(u0, seen_box[0]), min(v0, seen_box[1]), max(u1, seen_box[2]), max(v1, seen_box[3])
    canvas = np.zeros((max(v1 - v0 + 1, 0), max(u1 - u0 + 1, 0)), np.bool_)
    if canvas.size:
        _cover(points, faces, camera, near, crosses, closed and not crosses, u0, v0, canvas)
    total, valid, left, right, top, bottom = 0, 0, u1 + 1, u0 - 1, v1 + 1, v0 - 1
    for v in range(v0, v0 + canvas.shape[0]):
        inside = 0 <= v < height
        for u in range(u0, u0 + canvas.shape[1]):
            here = inside and 0 <= u < width
            if canvas[v - v0, u - u0] or (here and ids[v, u] == own):
                total += 1
                left, right, top, bottom = min(left, u), max(right, u), min(top, v), v
                if here:
                    mask[v, u] = True
                    valid += depth[v, u] > 0.0
    return total, valid, (left, top, right, bottom)


@njit(cache=True, nogil=True, error_model="numpy")
def _project(vertices, faces, T, camera, near):
    """Of a mesh's vertices, (V, 3): pixels u, v and depth, or x, y and depth short of the near plane, with bounds.

    Bounds (4,) are u0, v0, u1, v1 of what lies beyond the near plane; the last result is whether it cuts the mesh.
    """
    fx, fy, cx, cy = camera
    points, bounds = np.empty((vertices.shape[0], 3)), np.array([np.inf, np.inf, -np.inf, -np.inf])
    some, all_ = False, True
    for i in range(vertices.shape[0]):
        a, b, c = np.float64(vertices[i, 0]), np.float64(vertices[i, 1]), np.float64(vertices[i, 2])
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        if z >= near:
            x, y = fx * x / z + cx, fy * y / z + cy
            bounds[0], bounds[2] = min(bounds[0], x), max(bounds[2], x)
            bounds[1], bounds[3] = min(bounds[1], y), max(bounds[3], y)
            some = True
        else:
            all_ = False
        points[i, 0], points[i, 1], points[i, 2] = x, y, z
    crosses = some and not all_
    if crosses:
        corner = np.empty((4, 2))
        for f in range(faces.shape[0]):
            for k in range(_clip(points, faces[f], camera, near, corner)):
                bounds[0], bounds[2] = min(bounds[0], corner[k, 0]), max(bounds[2], corner[k, 0])
                bounds[1], bounds[3] = min(bounds[1], corner[k, 1]), max(bounds[3], corner[k, 1])
    if not some:
        bounds[:] = np.array([0.0, 0.0, -1.0, -1.0])
    return points, bounds, crosses


@njit(cache=True, nogil=True, error_model="numpy")
def _clip(points, face, camera, near, corner):
    """Write the pixels of the part of a face beyond the near plane, 0, 3 or 4 corners, and return their number."""
    fx, fy, cx, cy = camera
    count = 0
    for k in range(3):
        p, q = points[face[k]], points[face[(k + 1) % 3]]
        if p[2] >= near:
            corner[count, 0], corner[count, 1] = p[0], p[1]
            count += 1
        if (p[2] >= near) != (q[2] >= near):
            # Vertices beyond the plane are kept in pixels, those before it in metres.
            px, py = (p[0], p[1]) if p[2] < near else ((p[0] - cx) / fx * p[2], (p[1] - cy) / fy * p[2])
            qx, qy = (q[0], q[1]) if q[2] < near else ((q[0] - cx) / fx * q[2], (q[1] - cy) / fy * q[2])
            share = (near - p[2]) / (q[2] - p[2])
            corner[count, 0] = fx * (px + share * (qx - px)) / near + cx
            corner[count, 1] = fy * (py + share * (qy - py)) / near + cy
            count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _cover(points, faces, camera, near, crosses, one_side, u0, v0, canvas):
    """Set the pixels of the canvas, whose first one is (u0, v0), that the faces cover."""
    corner = np.empty((4, 2))
    for f in range(faces.shape[0]):
        if crosses:
            for k in range(2, _clip(points, faces[f], camera, near, corner)):
                _cover_triangle(
                    corner[0, 0] - u0, corner[0, 1] - v0, corner[k - 1, 0] - u0, corner[k - 1, 1] - v0,
                    corner[k, 0] - u0, corner[k, 1] - v0, canvas,
                )  # fmt: skip
            continue
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        if one_side:
            ax, ay, bx, by = points[i, 0], points[i, 1], points[j, 0], points[j, 1]
            if (bx - ax) * (points[k, 1] - ay) - (by - ay) * (points[k, 0] - ax) < 0.0:
                continue
        _cover_triangle(
            points[i, 0] - u0, points[i, 1] - v0, points[j, 0] - u0, points[j, 1] - v0,
            points[k, 0] - u0, points[k, 1] - v0, canvas,
        )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _cover_triangle(ax, ay, bx, by, cx, cy, canvas):
    """Set the pixels whose centres lie in a triangle or on its border, row by row; the canvas begins at (0, 0).

    Triangles that share an edge compute the same crossing of it with a row, so nothing is left out between them.
    """
    left, right = min(min(ax, bx), cx), max(max(ax, bx), cx)
    top, bottom = min(min(ay, by), cy), max(max(ay, by), cy)
    first, last = int(max(np.ceil(left), 0.0)), int(min(right, canvas.shape[1] - 1.0))
    if right < first or last < first:
        return
    upper, lower = int(max(np.ceil(top), 0.0)), int(min(bottom, canvas.shape[0] - 1.0))
    if bottom < upper:
        return
    turns = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax) >= 0.0
    # Of each edge: where it is highest up, how far it goes sideways a row, and whether it bounds rows to the right.
    x0, y0, slope0 = (ax, ay, (bx - ax) / (by - ay)) if ay <= by else (bx, by, (ax - bx) / (ay - by))
    x1, y1, slope1 = (bx, by, (cx - bx) / (cy - by)) if by <= cy else (cx, cy, (bx - cx) / (by - cy))
    x2, y2, slope2 = (cx, cy, (ax - cx) / (ay - cy)) if cy <= ay else (ax, ay, (cx - ax) / (cy - ay))
    ends0, ends1, ends2 = (by > ay) == turns, (cy > by) == turns, (ay > cy) == turns
    for row in range(upper, lower + 1):
        low, high = float(first), float(last)
        if ay != by:
            x = x0 + slope0 * (row - y0)
            low, high = (low, min(high, x)) if ends0 else (max(low, x), high)
        if by != cy:
            x = x1 + slope1 * (row - y1)
            low, high = (low, min(high, x)) if ends1 else (max(low, x), high)
        if cy != ay:
            x = x2 + slope2 * (row - y2)
            low, high = (low, min(high, x)) if ends2 else (max(low, x), high)
        if low <= high:
            for column in range(int(np.ceil(low)), int(high) + 1):
                canvas[row, column] = True
