"""Laws of rigid transforms, rotation vectors and quaternions."""

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from simtrack.geometry import transforms as tf

coordinates = st.floats(-10.0, 10.0, allow_nan=False, width=32)
vectors = arrays(np.float64, 3, elements=coordinates)
rotation_vectors = arrays(np.float64, 3, elements=st.floats(-1.8, 1.8, allow_nan=False))
angles = st.floats(-np.pi, np.pi)
rotations = rotation_vectors.map(tf.exp_so3)
poses = st.builds(tf.transform, rotations, vectors)
twists = st.builds(lambda rho, phi: np.concatenate([rho, phi]), vectors, rotation_vectors)


@given(rotation_vectors)
def test_exponential_is_a_rotation(phi: np.ndarray) -> None:
    R = tf.exp_so3(phi)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)


@given(rotation_vectors)
def test_logarithm_inverts_the_exponential_below_half_a_turn(phi: np.ndarray) -> None:
    assume(np.linalg.norm(phi) < np.pi - 1e-6)
    np.testing.assert_allclose(tf.log_so3(tf.exp_so3(phi)), phi, atol=1e-9)


@given(rotations)
def test_exponential_inverts_the_logarithm(R: np.ndarray) -> None:
    phi = tf.log_so3(R)
    assert np.linalg.norm(phi) <= np.pi + 1e-12
    np.testing.assert_allclose(tf.exp_so3(phi), R, atol=1e-9)


@given(vectors, st.floats(-1e-3, 1e-3))
def test_logarithm_at_half_a_turn(axis: np.ndarray, offset: float) -> None:
    assume(np.linalg.norm(axis) > 1e-3)
    R = tf.exp_so3((np.pi + offset) * axis / np.linalg.norm(axis))
    np.testing.assert_allclose(tf.exp_so3(tf.log_so3(R)), R, atol=1e-9)


@given(st.floats(-9.0, -5.0))
def test_exponential_is_smooth_where_its_formula_changes(exponent: float) -> None:
    phi = np.array([0.6, -0.48, 0.64]) * 10.0**exponent
    np.testing.assert_allclose(
        tf.exp_so3(phi), np.eye(3) + tf.skew(phi) + 0.5 * tf.skew(phi) @ tf.skew(phi), atol=1e-15
    )


@given(vectors, vectors)
def test_skew_is_the_cross_product(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(tf.skew(a) @ b, np.cross(a, b), atol=1e-9)


@given(rotations, st.floats(0.1, 10.0))
def test_quaternion_round_trip_whatever_its_norm(R: np.ndarray, norm: float) -> None:
    wxyz = tf.quaternion_from_rotation(R)
    assert wxyz[0] >= 0.0
    np.testing.assert_allclose(np.linalg.norm(wxyz), 1.0, atol=1e-12)
    np.testing.assert_allclose(tf.rotation_from_quaternion(norm * wxyz), R, atol=1e-9)
    np.testing.assert_allclose(tf.rotation_from_quaternion(-wxyz), R, atol=1e-9)


@given(poses, poses, poses)
def test_transforms_form_a_group(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> None:
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-10)
    np.testing.assert_allclose(A @ tf.inverse(A), np.eye(4), atol=1e-10)
    np.testing.assert_allclose(tf.inverse(A) @ A, np.eye(4), atol=1e-10)
    np.testing.assert_allclose(tf.inverse(A @ B), tf.inverse(B) @ tf.inverse(A), atol=1e-10)
    assert tf.is_rigid(A @ B)


@given(poses, arrays(np.float64, (7, 3), elements=coordinates))
def test_apply_moves_points_and_keeps_distances(T: np.ndarray, points: np.ndarray) -> None:
    moved = tf.apply(T, points)
    expected = (T @ np.column_stack([points, np.ones(len(points))]).T).T[:, :3]
    np.testing.assert_allclose(moved, expected, atol=1e-9)
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(moved, axis=0), axis=1), np.linalg.norm(np.diff(points, axis=0), axis=1), atol=1e-9
    )


@given(poses, twists)
def test_difference_inverts_perturb(T: np.ndarray, xi: np.ndarray) -> None:
    assume(np.linalg.norm(xi[3:]) < np.pi - 1e-6)
    moved = tf.perturb(T, xi)
    assert tf.is_rigid(moved)
    np.testing.assert_allclose(tf.difference(moved, T), xi, atol=1e-8)


@given(poses, poses)
def test_perturb_inverts_difference(A: np.ndarray, B: np.ndarray) -> None:
    np.testing.assert_allclose(tf.perturb(A, tf.difference(B, A)), B, atol=1e-8)


@given(poses, twists)
def test_perturbation_is_decoupled(T: np.ndarray, xi: np.ndarray) -> None:
    moved = tf.perturb(T, xi)
    np.testing.assert_allclose(moved[:3, 3], T[:3, 3] + xi[:3], atol=1e-12)
    np.testing.assert_allclose(moved[:3, :3], tf.exp_so3(xi[3:]) @ T[:3, :3], atol=1e-9)


@given(rotations, arrays(np.float64, (3, 3), elements=st.floats(-1.0, 1.0)))
def test_orthonormal_removes_small_errors_to_second_order(R: np.ndarray, noise: np.ndarray) -> None:
    repaired = tf.orthonormal(R + 1e-5 * noise)
    np.testing.assert_allclose(repaired @ repaired.T, np.eye(3), atol=1e-8)
    np.testing.assert_allclose(repaired, R, atol=1e-4)


@given(poses, poses)
def test_interpolation_meets_both_ends_and_halves_the_angle(A: np.ndarray, B: np.ndarray) -> None:
    angle = tf.angle_between(A[:3, :3], B[:3, :3])
    assume(angle < np.pi - 1e-3)
    np.testing.assert_allclose(tf.interpolate(A, B, 0.0), A, atol=1e-9)
    np.testing.assert_allclose(tf.interpolate(A, B, 1.0), B, atol=1e-8)
    middle = tf.interpolate(A, B, 0.5)
    np.testing.assert_allclose(tf.angle_between(A[:3, :3], middle[:3, :3]), 0.5 * angle, atol=1e-7)
    np.testing.assert_allclose(middle[:3, 3], 0.5 * (A[:3, 3] + B[:3, 3]), atol=1e-9)


@given(rotations, rotations, rotations)
def test_angle_is_a_bi_invariant_metric(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> None:
    np.testing.assert_allclose(tf.angle_between(A, B), tf.angle_between(B, A), atol=1e-7)
    np.testing.assert_allclose(tf.angle_between(C @ A, C @ B), tf.angle_between(A, B), atol=1e-7)
    np.testing.assert_allclose(tf.angle_between(A @ C, B @ C), tf.angle_between(A, B), atol=1e-7)
    assert tf.angle_between(A, C) <= tf.angle_between(A, B) + tf.angle_between(B, C) + 1e-7


@given(rotations, rotations, arrays(np.float64, (6, 6), elements=st.floats(-1.0, 1.0)))
def test_covariances_rotate_as_their_perturbations_do(A: np.ndarray, B: np.ndarray, root: np.ndarray) -> None:
    covariance = root @ root.T
    adjoint = np.kron(np.eye(2), A)
    np.testing.assert_allclose(tf.rotate_covariance(A, covariance), adjoint @ covariance @ adjoint.T, atol=1e-10)
    twice = tf.rotate_covariance(A, tf.rotate_covariance(B, covariance))
    np.testing.assert_allclose(twice, tf.rotate_covariance(A @ B, covariance), atol=1e-10)


@given(vectors, vectors)
def test_look_at_puts_the_target_on_the_optical_axis_and_up_above(eye: np.ndarray, target: np.ndarray) -> None:
    distance = float(np.linalg.norm(target - eye))
    assume(distance > 1e-2)
    T = tf.look_at(eye, target)
    assert tf.is_rigid(T)
    np.testing.assert_allclose(tf.apply(tf.inverse(T), target[None])[0], [0.0, 0.0, distance], atol=1e-6)
    assert T[2, 1] <= 1e-9  # the image's y axis points down


@given(angles, angles, angles)
def test_roll_pitch_yaw_are_turns_about_fixed_axes(roll: float, pitch: float, yaw: float) -> None:
    expected = (
        tf.exp_so3(np.array([0, 0, yaw])) @ tf.exp_so3(np.array([0, pitch, 0])) @ tf.exp_so3(np.array([roll, 0, 0]))
    )
    np.testing.assert_allclose(tf.rotation_from_rpy(roll, pitch, yaw), expected, atol=1e-12)
    np.testing.assert_allclose(tf.transform_xyz_rpy((1, 2, 3), (roll, pitch, yaw)), tf.transform(expected, (1, 2, 3)))


@given(coordinates, coordinates, st.floats(-3.1, 3.1))
def test_planar_poses_keep_their_heading(x: float, y: float, yaw: float) -> None:
    T = tf.transform_planar(x, y, yaw)
    np.testing.assert_allclose(tf.yaw_of(T), yaw, atol=1e-9)
    np.testing.assert_allclose(T[:3, 3], [x, y, 0.0])


def test_is_rigid_refuses_what_is_not() -> None:
    assert tf.is_rigid(np.eye(4))
    for broken in (np.diag([1.0, 1.0, -1.0, 1.0]), 2.0 * np.eye(4), np.full((4, 4), np.nan), np.eye(3)):
        assert not tf.is_rigid(broken)
