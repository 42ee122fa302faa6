"""Rigid transforms as 4x4 float64 matrices `T_target_source`, rotation vectors and wxyz quaternions.

Perturbations are decoupled and on the left: ``t' = t + rho``, ``R' = Exp(phi) @ R`` with ``xi = (rho, phi)``.
"""

from math import atan2, cos, isfinite, sin, sqrt

import numpy as np

from simtrack.contracts import Float64

_IDENTITY = np.eye(4)  # a copy of it costs a fraction of np.eye
_IDENTITY_3 = np.eye(3)
_IDENTITY_6 = np.eye(6)


def skew(vector: Float64) -> Float64:
    """(3, 3) cross-product matrix of a (3,) vector: ``skew(a) @ b == cross(a, b)``."""
    x, y, z = np.asarray(vector, dtype=float).tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp_so3(rotation_vector: Float64) -> Float64:
    """(3, 3) rotation matrix of a (3,) rotation vector in radians (Rodrigues' formula)."""
    x, y, z = np.asarray(rotation_vector, dtype=float).tolist()  # plain numbers: several times faster than small arrays
    square = x * x + y * y + z * z
    angle = sqrt(square)
    if angle < 1e-8:
        a, b = 1.0, 0.5
    else:
        a, b = sin(angle) / angle, (1.0 - cos(angle)) / square
    xx, yy, zz, xy, xz, yz = b * x * x, b * y * y, b * z * z, b * x * y, b * x * z, b * y * z
    x, y, z = a * x, a * y, a * z
    return np.array([[1.0 - yy - zz, xy - z, xz + y], [xy + z, 1.0 - xx - zz, yz - x], [xz - y, yz + x, 1.0 - xx - yy]])


def log_so3(rotation: Float64) -> Float64:
    """(3,) rotation vector, radians, norm in [0, pi], of a (3, 3) rotation matrix."""
    return np.array(_rotation_vector(np.asarray(rotation, dtype=float).tolist()))


def _rotation_vector(m: list[list[float]]) -> tuple[float, float, float]:
    w, x, y, z = _quaternion(m)
    norm = sqrt(x * x + y * y + z * z)
    scale = 2.0 if norm < 1e-12 else 2.0 * atan2(norm, w) / norm
    return scale * x, scale * y, scale * z


def quaternion_from_rotation(rotation: Float64) -> Float64:
    """(4,) unit quaternion wxyz with w >= 0 of a (3, 3) rotation matrix (Shepperd's method)."""
    return np.array(_quaternion(np.asarray(rotation, dtype=float).tolist()))


def _quaternion(m: list[list[float]]) -> tuple[float, float, float, float]:
    (a, b, c), (d, e, f), (g, h, i) = m
    trace = a + e + i
    largest = max(trace, a, e, i)
    if trace == largest:
        w, x, y, z = 1.0 + trace, h - f, c - g, d - b
    elif a == largest:
        w, x, y, z = h - f, 1.0 + a - e - i, d + b, g + c
    elif e == largest:
        w, x, y, z = c - g, d + b, 1.0 + e - i - a, h + f
    else:
        w, x, y, z = d - b, g + c, h + f, 1.0 + i - a - e
    norm = sqrt(w * w + x * x + y * y + z * z)
    if w < 0.0:
        norm = -norm
    return w / norm, x / norm, y / norm, z / norm


def rotation_from_quaternion(wxyz: Float64) -> Float64:
    """(3, 3) rotation matrix of a (4,) quaternion wxyz, which need not be normalised."""
    w, x, y, z = np.asarray(wxyz, dtype=float) / np.sqrt(np.dot(wxyz, wxyz))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> Float64:
    """(3, 3) ``Rz(yaw) @ Ry(pitch) @ Rx(roll)``, angles in radians (the convention of URDF)."""
    return exp_so3(np.array([0, 0, yaw])) @ exp_so3(np.array([0, pitch, 0])) @ exp_so3(np.array([roll, 0, 0]))


def rpy_from_rotation(rotation: Float64) -> tuple[float, float, float]:
    """Roll, pitch, yaw in radians of a (3, 3) rotation (see `rotation_from_rpy`); roll is 0 at 90 deg of pitch."""
    cosine = float(np.hypot(rotation[0, 0], rotation[1, 0]))
    pitch = float(np.arctan2(-rotation[2, 0], cosine))
    if cosine < 1e-9:
        return 0.0, pitch, float(np.arctan2(-rotation[0, 1], rotation[1, 1]))
    roll = float(np.arctan2(rotation[2, 1], rotation[2, 2]))
    return roll, pitch, float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def transform(rotation: Float64 | None = None, translation: Float64 | tuple[float, ...] | None = None) -> Float64:
    """(4, 4) transform from a (3, 3) rotation (identity if None) and a (3,) translation (zero if None)."""
    T = _IDENTITY.copy()
    if rotation is not None:
        T[:3, :3] = rotation
    if translation is not None:
        T[:3, 3] = translation
    return T


def transform_xyz_rpy(xyz: tuple[float, float, float], rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Float64:
    """(4, 4) transform from a translation in metres and roll, pitch, yaw in radians."""
    return transform(rotation_from_rpy(*rpy), xyz)


def transform_planar(x: float, y: float, yaw: float) -> Float64:
    """(4, 4) transform of a pose on the floor."""
    return transform(exp_so3(np.array([0.0, 0.0, yaw])), (x, y, 0.0))


def wrapped(angle: float) -> float:
    """The same angle between -pi and pi, radians."""
    return float(np.arctan2(np.sin(angle), np.cos(angle)))


def yaw_of(T: Float64) -> float:
    """Heading of the x axis about z, radians."""
    return float(np.arctan2(T[1, 0], T[0, 0]))


def inverse(T: Float64) -> Float64:
    """(4, 4) inverse of a rigid transform."""
    out = _IDENTITY.copy()
    R_inverse = T[:3, :3].T
    out[:3, :3] = R_inverse
    out[:3, 3] = -(R_inverse @ T[:3, 3])
    return out


def apply(T: Float64, points: np.ndarray) -> Float64:
    """(N, 3) points moved by a (4, 4) transform."""
    return np.asarray(points) @ T[:3, :3].T + T[:3, 3]


def perturb(T: Float64, xi: Float64) -> Float64:
    """Apply a (6,) left perturbation (translation metres, rotation vector radians), decoupled."""
    out = _IDENTITY.copy()
    out[:3, :3] = orthonormal(exp_so3(xi[3:]) @ T[:3, :3])
    out[:3, 3] = T[:3, 3] + xi[:3]
    return out


def difference(T_to: Float64, T_from: Float64) -> Float64:
    """(6,) perturbation that leads from one transform to the other: ``perturb(T_from, xi) == T_to``."""
    (a, b, c), (d, e, f) = T_to[:3, 3].tolist(), T_from[:3, 3].tolist()
    return np.array([a - d, b - e, c - f, *_rotation_vector((T_to[:3, :3] @ T_from[:3, :3].T).tolist())])


def orthonormal(rotation: Float64) -> Float64:
    """(3, 3) rotation nearest to a nearly orthonormal matrix, one Newton step of the polar decomposition."""
    return rotation @ (1.5 * _IDENTITY_3 - 0.5 * rotation.T @ rotation)


def angle_between(R_a: Float64, R_b: Float64) -> float:
    """Angle of the rotation from one (3, 3) rotation to the other, radians in [0, pi]."""
    w, x, y, z = _quaternion((R_a @ R_b.T).tolist())
    return 2.0 * atan2(sqrt(x * x + y * y + z * z), w)


def interpolate(T_a: Float64, T_b: Float64, fraction: float) -> Float64:
    """Transform between two: translation linear, rotation along the geodesic; extrapolates outside [0, 1]."""
    xi = difference(T_b, T_a)
    return perturb(T_a, fraction * xi)


def with_lever(covariance: Float64, lever: Float64) -> Float64:
    """(6, 6) covariance of a left perturbation, of a body that is carried along at the end of a lever (3,), metres."""
    x, y, z = lever.tolist()
    J = _IDENTITY_6.copy()
    J[0, 4], J[0, 5], J[1, 3], J[1, 5], J[2, 3], J[2, 4] = z, -y, -z, x, y, -x
    return J @ covariance @ J.T


def rotate_covariance(rotation: Float64, covariance: Float64) -> Float64:
    """(6, 6) covariance of a left perturbation, expressed in the frame reached by a (3, 3) rotation."""
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = rotation
    return turn @ covariance @ turn.T


def look_at(eye: Float64, target: Float64, up: Float64 | None = None) -> Float64:
    """(4, 4) T_map_camera of an optical camera (x right, y down, z forward) at `eye` that looks at `target`."""
    up = np.array([0.0, 0.0, 1.0]) if up is None else up
    z = np.asarray(target, dtype=float) - np.asarray(eye, dtype=float)
    z /= np.linalg.norm(z)
    x = np.cross(z, up)
    norm = float(np.linalg.norm(x))
    x = np.array([0.0, -1.0, 0.0]) if norm < 1e-9 else x / norm
    return transform(np.stack([x, np.cross(z, x), z], axis=1), eye)


def is_rigid(T: np.ndarray, tolerance: float = 1e-6) -> bool:
    """Whether a (4, 4) matrix is a finite proper rigid transform."""
    if T.shape != (4, 4):
        return False
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last = np.asarray(T, dtype=float).tolist()
    errors = (
        a * a + b * b + c * c - 1.0, d * d + e * e + f * f - 1.0, g * g + h * h + i * i - 1.0,
        a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i,
    )  # fmt: skip
    proper = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0.0
    orthogonal = all(abs(error) < tolerance for error in errors)  # False where one is NaN
    return orthogonal and proper and isfinite(x + y + z) and last == [0.0, 0.0, 0.0, 1.0]
