"""Rigid transforms as 4x4 float64 matrices `T_target_source`, rotation vectors and wxyz quaternions.

Perturbations are decoupled and on the left: ``t' = t + rho``, ``R' = Exp(phi) @ R`` with ``xi = (rho, phi)``.
"""

import numpy as np

from simtrack.contracts import Float64

_IDENTITY = np.eye(4)  # a copy of it costs a fraction of np.eye
_IDENTITY_3 = np.eye(3)


def skew(vector: Float64) -> Float64:
    """(3, 3) cross-product matrix of a (3,) vector: ``skew(a) @ b == cross(a, b)``."""
    x, y, z = np.asarray(vector, dtype=float).tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp_so3(rotation_vector: Float64) -> Float64:
    """(3, 3) rotation matrix of a (3,) rotation vector in radians (Rodrigues' formula)."""
    phi = np.asarray(rotation_vector, dtype=float)
    angle = float(np.sqrt(phi @ phi))
    K = skew(phi)
    if angle < 1e-8:
        return _IDENTITY_3 + K + 0.5 * K @ K
    return _IDENTITY_3 + (np.sin(angle) / angle) * K + ((1.0 - np.cos(angle)) / angle**2) * K @ K


def log_so3(rotation: Float64) -> Float64:
    """(3,) rotation vector, radians, norm in [0, pi], of a (3, 3) rotation matrix."""
    wxyz = quaternion_from_rotation(rotation)
    vector = wxyz[1:]
    norm = float(np.sqrt(vector @ vector))
    if norm < 1e-12:
        return 2.0 * vector
    return 2.0 * np.arctan2(norm, wxyz[0]) / norm * vector


def quaternion_from_rotation(rotation: Float64) -> Float64:
    """(4,) unit quaternion wxyz with w >= 0 of a (3, 3) rotation matrix (Shepperd's method)."""
    m = np.asarray(rotation, dtype=float).tolist()  # plain numbers are several times faster than elements of arrays
    trace = m[0][0] + m[1][1] + m[2][2]
    largest = max(trace, m[0][0], m[1][1], m[2][2])
    if trace == largest:
        wxyz = np.array([1.0 + trace, m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]])
    else:
        i = 0 if m[0][0] == largest else 1 if m[1][1] == largest else 2
        j, k = (i + 1) % 3, (i + 2) % 3
        wxyz = np.empty(4)
        wxyz[0] = m[k][j] - m[j][k]
        wxyz[1 + i] = 1.0 + m[i][i] - m[j][j] - m[k][k]
        wxyz[1 + j] = m[j][i] + m[i][j]
        wxyz[1 + k] = m[k][i] + m[i][k]
    wxyz /= np.sqrt(wxyz @ wxyz)
    return -wxyz if wxyz[0] < 0.0 else wxyz


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
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
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
    return np.concatenate([T_to[:3, 3] - T_from[:3, 3], log_so3(T_to[:3, :3] @ T_from[:3, :3].T)])


def orthonormal(rotation: Float64) -> Float64:
    """(3, 3) rotation nearest to a nearly orthonormal matrix, one Newton step of the polar decomposition."""
    return rotation @ (1.5 * _IDENTITY_3 - 0.5 * rotation.T @ rotation)


def angle_between(R_a: Float64, R_b: Float64) -> float:
    """Angle of the rotation from one (3, 3) rotation to the other, radians in [0, pi]."""
    vector = log_so3(R_a @ R_b.T)
    return float(np.sqrt(vector @ vector))


def interpolate(T_a: Float64, T_b: Float64, fraction: float) -> Float64:
    """Transform between two: translation linear, rotation along the geodesic; extrapolates outside [0, 1]."""
    xi = difference(T_b, T_a)
    return perturb(T_a, fraction * xi)


def with_lever(covariance: Float64, lever: Float64) -> Float64:
    """(6, 6) covariance of a left perturbation, of a body that is carried along at the end of a lever (3,), metres."""
    S = skew(lever)
    out = covariance.copy()
    out[:3] -= S @ covariance[3:]
    out[:, :3] -= out[:, 3:] @ S.T
    return out


def rotate_covariance(rotation: Float64, covariance: Float64) -> Float64:
    """(6, 6) covariance of a left perturbation, expressed in the frame reached by a (3, 3) rotation."""
    out = np.empty((6, 6))
    for i in (0, 3):
        for j in (0, 3):
            out[i : i + 3, j : j + 3] = rotation @ covariance[i : i + 3, j : j + 3] @ rotation.T
    return out


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
    return bool(
        T.shape == (4, 4)
        and np.isfinite(T).all()
        and np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < tolerance
        and np.linalg.det(T[:3, :3]) > 0
        and np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0])
    )
