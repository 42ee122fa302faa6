"""Distance and collision of two posed meshes."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numba as nb
import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.raycast.closest import closest_on_triangle
from simtrack.raycast.table import checked_pose
from simtrack.raycast.topology import corner_of, is_inside
from simtrack.raycast.triangles import between_triangles, cross, dot, minus, plus

if TYPE_CHECKING:
    from simtrack.raycast.mesh import TriangleMesh
    from simtrack.raycast.scene import RayScene

_STACK = 128
"""Pairs of nodes that wait: one for each level of either tree at most, and trees have less than 40 levels."""


@dataclass(frozen=True, slots=True, eq=False)
class MeshDistance:
    """How two meshes lie to each other."""

    distance: float
    """Metres. Positive: the least distance of the surfaces. 0: the surfaces touch or cross (if a depth was asked for,
    minus the depth). Negative without crossing: one lies wholly inside the other, which is closed, and this is minus
    the least distance of the surfaces. inf: farther apart than was asked."""
    first: Float64
    """(3,), map frame: the nearest point of the first surface, or a point where the surfaces cross; NaN if too far."""
    second: Float64
    """(3,), map frame: the nearest point of the second surface."""
    crossing: bool
    """Whether the surfaces touch or cross."""

    @property
    def colliding(self) -> bool:
        """Whether the solids have a point in common."""
        return self.distance <= 0.0


def mesh_distance(
    first: "TriangleMesh",
    T_map_first: npt.ArrayLike,
    second: "TriangleMesh",
    T_map_second: npt.ArrayLike,
    max_distance: float = np.inf,
    *,
    depth: bool = False,
) -> MeshDistance:
    """Least distance of two meshes under affine transforms, with the pair of nearest points.

    Two trees of boxes are descended together, nearest first. Objects that are far from each other for their size take
    microseconds; large surfaces that fit one another closely take milliseconds.

    Args:
        first: a mesh.
        T_map_first: (4, 4).
        second: another mesh, or the same.
        T_map_second: (4, 4).
        max_distance: metres; what is farther apart is not looked for, which takes less time.
        depth: measure how deep meshes whose surfaces cross are in one another: the greatest distance to the other's
            surface of a vertex that lies inside the other, where that is closed. The true depth of overlap is greater,
            by as much as faces are large.

    Raises:
        InvalidValueError: an invalid transform, or a negative distance.
    """
    poses = checked_pose(T_map_first, "T_map_first"), checked_pose(T_map_second, "T_map_second")
    if not max_distance >= 0.0:
        raise InvalidValueError("max_distance", max_distance, ">= 0")
    found = _nearest(first, second, poses, float(max_distance))
    if found is None and np.isfinite(max_distance) and _may_contain(first, second, poses):
        found = _nearest(first, second, poses, np.inf)
        found = found if found is not None and _contained(first, second, poses, found) else None
    if found is None:
        missing = np.full((2, 3), np.nan)
        return MeshDistance(np.inf, missing[0], missing[1], False)
    square, points, _ = found
    if square == 0.0:
        deep = _depth(first, second, poses) if depth else 0.0
        return MeshDistance(0.0 - deep, points[0], points[1], True)
    sign = -1.0 if _contained(first, second, poses, found) else 1.0
    return MeshDistance(sign * float(np.sqrt(square)), points[0], points[1], False)


def meshes_collide(
    first: "TriangleMesh", T_map_first: npt.ArrayLike, second: "TriangleMesh", T_map_second: npt.ArrayLike
) -> bool:
    """Whether two meshes touch, cross or contain one another; faster than their distance."""
    return mesh_distance(first, T_map_first, second, T_map_second, 0.0).colliding


def instance_distance(
    scene: "RayScene", first: int, second: int, max_distance: float = np.inf, *, depth: bool = False
) -> MeshDistance:
    """`mesh_distance` of two instances of a scene, at their first motion key if they move."""
    poses = scene.pose(first), scene.pose(second)
    return mesh_distance(scene.mesh(first), poses[0], scene.mesh(second), poses[1], max_distance, depth=depth)


_Poses: TypeAlias = tuple[Float64, Float64]
_Pair: TypeAlias = tuple[float, Float64, npt.NDArray[np.int64]]
"""Squared distance, (2, 3) points in the map frame, (2,) faces."""


def _nearest(first: "TriangleMesh", second: "TriangleMesh", poses: _Poses, limit: float) -> _Pair | None:
    points, faces = np.empty((2, 3)), np.empty(2, np.int64)
    square = _search(*_searched(first), poses[0], *_searched(second), poses[1], limit, points, faces)
    return (float(square), points, faces) if faces[0] >= 0 else None


def _searched(mesh: "TriangleMesh") -> tuple[Any, Any, Any, Any]:
    return mesh.vertices, mesh.faces, mesh.tree.boxes, mesh.tree.faces


def _around(mesh: "TriangleMesh") -> tuple[Any, Any, Any, Any, Any, Any]:
    t = mesh.topology
    return mesh.vertices, mesh.faces, t.corners, t.across, t.ring_start, t.ring


def _may_contain(first: "TriangleMesh", second: "TriangleMesh", poses: _Poses) -> bool:
    """Whether a closed mesh may hold the other: then its box, parallel to the map's axes, holds the other's."""
    (a, b), (c, d) = (_bounds(mesh, T) for mesh, T in zip((first, second), poses, strict=True))
    if ((a >= c) & (b <= d)).all():
        return second.topology.closed
    return bool(((c >= a) & (d <= b)).all()) and first.topology.closed


def _bounds(mesh: "TriangleMesh", T: Float64) -> tuple[Float64, Float64]:
    box = mesh.tree.boxes[1].astype(np.float64)
    centre = T[:3, :3] @ (0.5 * (box[:3] + box[3:])) + T[:3, 3]
    half = np.abs(T[:3, :3]) @ (0.5 * (box[3:] - box[:3]))
    return centre - half, centre + half


def _contained(first: "TriangleMesh", second: "TriangleMesh", poses: _Poses, found: _Pair) -> bool:
    """Whether surfaces that do not cross lie one inside the other: then so does the nearest point of the one."""
    _, points, faces = found
    for k, mesh in enumerate((first, second)):
        if mesh.topology.closed and is_inside(tuple(points[1 - k].tolist()), *_around(mesh), poses[k], int(faces[k])):
            return True
    return False


def _depth(first: "TriangleMesh", second: "TriangleMesh", poses: _Poses) -> float:
    deepest = 0.0
    for mesh, T, other, T_other in ((first, poses[0], second, poses[1]), (second, poses[1], first, poses[0])):
        if other.topology.closed:
            tree = other.tree.boxes, other.tree.faces
            deepest = max(deepest, _deepest(mesh.vertices, T, *_around(other), *tree, T_other))
    return float(deepest)


# -------------------------------------------------------------------------------------------------------------- kernels


@nb.njit(cache=True, nogil=True)
def _inverse(T):
    """Inverse of an affine (4, 4)."""
    rows = (T[0, 0], T[0, 1], T[0, 2]), (T[1, 0], T[1, 1], T[1, 2]), (T[2, 0], T[2, 1], T[2, 2])
    columns = cross(rows[1], rows[2]), cross(rows[2], rows[0]), cross(rows[0], rows[1])
    determinant = dot(rows[0], columns[0])
    out = np.eye(4)
    for i in range(3):
        for j in range(3):
            out[i, j] = columns[j][i] / determinant
    for i in range(3):
        out[i, 3] = -(out[i, 0] * T[0, 3] + out[i, 1] * T[1, 3] + out[i, 2] * T[2, 3])
    return out


@nb.njit(cache=True, nogil=True)
def _times(A, B):
    """Product of affine (4, 4)."""
    out = np.eye(4)
    for i in range(3):
        for j in range(4):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
        out[i, 3] += A[i, 3]
    return out


@nb.njit(cache=True, nogil=True)
def _keeps_lengths(T):
    for i in range(3):
        for j in range(3):
            product = T[0, i] * T[0, j] + T[1, i] * T[1, j] + T[2, i] * T[2, j]
            if abs(product - (1.0 if i == j else 0.0)) > 1e-9:
                return False
    return True


@nb.njit(cache=True, nogil=True)
def _moved(T, p):
    return (
        T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3],
        T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3],
        T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3],
    )


@nb.njit(cache=True, nogil=True)
def _box(boxes, node, T):
    """Centre and half sides of a node's box after T, parallel to the axes; half sides of -1 if it is empty."""
    if boxes[node, 0] > boxes[node, 3]:
        return (0.0, 0.0, 0.0), (-1.0, -1.0, -1.0)
    low = np.float64(boxes[node, 0]), np.float64(boxes[node, 1]), np.float64(boxes[node, 2])
    high = np.float64(boxes[node, 3]), np.float64(boxes[node, 4]), np.float64(boxes[node, 5])
    h = 0.5 * (high[0] - low[0]), 0.5 * (high[1] - low[1]), 0.5 * (high[2] - low[2])
    centre = _moved(T, (low[0] + h[0], low[1] + h[1], low[2] + h[2]))
    return centre, (
        abs(T[0, 0]) * h[0] + abs(T[0, 1]) * h[1] + abs(T[0, 2]) * h[2],
        abs(T[1, 0]) * h[0] + abs(T[1, 1]) * h[1] + abs(T[1, 2]) * h[2],
        abs(T[2, 0]) * h[0] + abs(T[2, 1]) * h[1] + abs(T[2, 2]) * h[2],
    )


@nb.njit(cache=True, nogil=True)
def _gap(a, half_a, b, half_b):
    """Squared distance of two boxes, inf if one is empty, and that of their centres."""
    d = minus(a, b)
    if half_a[0] < 0.0 or half_b[0] < 0.0:
        return np.inf, np.inf
    square = 0.0
    for k in range(3):
        apart = max(0.0, abs(d[k]) - half_a[k] - half_b[k])
        square += apart * apart
    return square, dot(d, d)


@nb.njit(cache=True, nogil=True)
def _triangle(vertices, faces, face, T):
    return (
        corner_of(vertices, faces, face, 0, T),
        corner_of(vertices, faces, face, 1, T),
        corner_of(vertices, faces, face, 2, T),
    )


@nb.njit(cache=True, nogil=True)
def _nearest_face(p, vertices, faces, boxes, members, T):
    """Squared distance of a point to a surface, the nearest face and the point on it."""
    leaves, best, found, point = members.shape[0], np.inf, -1, p
    nodes, bounds = np.empty(_STACK, np.int64), np.empty(_STACK)
    nodes[0], bounds[0] = 1, 0.0
    waiting, nothing = 1, (0.0, 0.0, 0.0)
    while waiting:
        waiting -= 1
        node = nodes[waiting]
        if bounds[waiting] >= best:
            continue
        if node >= leaves:
            face = members[node - leaves]
            a, b, c = _triangle(vertices, faces, face, T)
            s, t = closest_on_triangle(p, a, b, c)
            x = plus(plus(a, s, minus(b, a)), t, minus(c, a))
            away = minus(p, x)
            square = dot(away, away)
            if square < best:
                best, found, point = square, face, x
            continue
        left, half_left = _box(boxes, 2 * node, T)
        right, half_right = _box(boxes, 2 * node + 1, T)
        near, far = _gap(left, half_left, p, nothing)[0], _gap(right, half_right, p, nothing)[0]
        for k in range(2):
            other = (k == 0) != (near > far)
            bound = far if other else near
            if bound < best:
                nodes[waiting], bounds[waiting] = 2 * node + other, bound
                waiting += 1
    return best, found, point


@nb.njit(cache=True, nogil=True)
def _reach(boxes, node, T, n):
    """How far a node's box after T reaches from its centre along the direction n."""
    out = 0.0
    for k in range(3):
        half = 0.5 * (np.float64(boxes[node, 3 + k]) - boxes[node, k])
        out += abs(n[0] * T[0, k] + n[1] * T[1, k] + n[2] * T[2, k]) * half
    return out


@nb.njit(cache=True, nogil=True)
def _bound(boxes_a, a, A, boxes_b, b, B, direction, planes, best):
    """Lower bound of the squared distance of what two nodes hold, and the squared distance of their centres.

    That of their boxes, and if it is below `best`, the gaps along the direction of the nearest pair so far and along
    the normals of the faces (`planes`, two) of nodes that are leaves, which tell more where surfaces fit closely.
    """
    centre_a, half_a = _box(boxes_a, a, A)
    centre_b, half_b = _box(boxes_b, b, B)
    bound, apart = _gap(centre_a, half_a, centre_b, half_b)
    d = minus(centre_a, centre_b)
    for n in (direction, planes[0], planes[1]):
        if bound >= best:
            break
        gap = abs(dot(n, d)) - _reach(boxes_a, a, A, n) - _reach(boxes_b, b, B, n)
        if gap > 0.0:
            bound = max(bound, gap * gap)
    return bound, apart


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _direction(a):
    """Unit vector, or zero."""
    length = np.sqrt(dot(a, a))
    if not length > 0.0:
        return 0.0, 0.0, 0.0
    return a[0] / length, a[1] / length, a[2] / length


@nb.njit(cache=True, nogil=True)
def _plane(vertices, faces, members, node, T):
    """Unit normal of the face of a leaf, zero of another node."""
    leaves = members.shape[0]
    if node < leaves:
        return 0.0, 0.0, 0.0
    a, b, c = _triangle(vertices, faces, members[node - leaves], T)
    return _direction(cross(minus(b, a), minus(c, a)))


@nb.njit(cache=True, nogil=True)
def _near_pair(vertices_a, faces_a, boxes_a, members_a, A, vertices_b, faces_b, boxes_b, members_b, B):
    """Faces of two surfaces that are near each other: to a point of one the nearest of the other, and so on."""
    p, f, g = _box(boxes_a, 1, A)[0], -1, -1
    for _ in range(3):
        _, g, p = _nearest_face(p, vertices_b, faces_b, boxes_b, members_b, B)
        _, f, p = _nearest_face(p, vertices_a, faces_a, boxes_a, members_a, A)
    return f, g


@nb.njit(cache=True, nogil=True)
def _search(
    vertices_a, faces_a, boxes_a, members_a, T_a, vertices_b, faces_b, boxes_b, members_b, T_b, limit, points, faces
):
    """Squared distance of two surfaces within `limit`; writes the (2, 3) nearest points and their (2,) faces, or -1.

    The trees are compared in the frame of the second mesh if its pose keeps lengths, where its boxes fit best.
    """
    rigid = _keeps_lengths(T_b)
    A, B = (_times(_inverse(T_b), T_a), np.eye(4)) if rigid else (T_a, T_b)
    leaves_a, leaves_b = members_a.shape[0], members_b.shape[0]
    best = np.nextafter(limit * limit, np.inf)
    faces[0], faces[1] = -1, -1
    p, q = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if limit > 0.0:
        f, g = _near_pair(vertices_a, faces_a, boxes_a, members_a, A, vertices_b, faces_b, boxes_b, members_b, B)
        square, x, y = between_triangles(_triangle(vertices_a, faces_a, f, A), _triangle(vertices_b, faces_b, g, B))
        if square < best:
            best, p, q, faces[0], faces[1] = square, x, y, f, g
    direction = _direction(minus(p, q))
    nodes, bounds = np.empty((_STACK, 2), np.int64), np.empty(_STACK)
    nodes[0, 0], nodes[0, 1], bounds[0] = 1, 1, 0.0
    waiting = 1
    while waiting:
        waiting -= 1
        if bounds[waiting] >= best:
            continue
        a, b = nodes[waiting, 0], nodes[waiting, 1]
        if a >= leaves_a and b >= leaves_b:
            f, g = members_a[a - leaves_a], members_b[b - leaves_b]
            square, x, y = between_triangles(_triangle(vertices_a, faces_a, f, A), _triangle(vertices_b, faces_b, g, B))
            if square < best:
                best, p, q, faces[0], faces[1] = square, x, y, f, g
                direction = _direction(minus(p, q))
            continue
        half_a, half_b = _box(boxes_a, a, A)[1], _box(boxes_b, b, B)[1]
        split_a = b >= leaves_b or (a < leaves_a and dot(half_a, half_a) >= dot(half_b, half_b))
        a0, a1, b0, b1 = (2 * a, 2 * a + 1, b, b) if split_a else (a, a, 2 * b, 2 * b + 1)
        planes = (
            _plane(vertices_a, faces_a, members_a, a, A),
            _plane(vertices_b, faces_b, members_b, b, B),
        )
        near, towards = _bound(boxes_a, a0, A, boxes_b, b0, B, direction, planes, best)
        far, away = _bound(boxes_a, a1, A, boxes_b, b1, B, direction, planes, best)
        swap = near > far or (near == far and towards > away)
        for k in range(2):  # the nearer one last, so that it comes first
            other = (k == 0) != swap
            bound = far if other else near
            if bound < best:
                nodes[waiting, 0], nodes[waiting, 1] = (a1, b1) if other else (a0, b0)
                bounds[waiting] = bound
                waiting += 1
    if rigid:
        p, q = _moved(T_b, p), _moved(T_b, q)
    for k in range(3):
        points[0, k], points[1, k] = p[k], q[k]
    return best


@nb.njit(cache=True, nogil=True)
def _deepest(points, T, vertices, faces, corners, across, ring_start, ring, boxes, members, T_other):
    """Greatest distance to a closed surface of the (N, 3) points after T that lie inside of it; 0 if none does."""
    centre, half = _box(boxes, 1, T_other)
    deepest = 0.0
    for i in range(points.shape[0]):
        p = _moved(T, (np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])))
        d = minus(p, centre)
        if abs(d[0]) > half[0] or abs(d[1]) > half[1] or abs(d[2]) > half[2]:
            continue
        square, face, _ = _nearest_face(p, vertices, faces, boxes, members, T_other)
        deeper = square > deepest * deepest
        if deeper and is_inside(p, vertices, faces, corners, across, ring_start, ring, T_other, face):
            deepest = np.sqrt(square)
    return deepest
