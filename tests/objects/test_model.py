"""Symmetries, keypoints and classes as such."""

import numpy as np
import pytest

from simtrack.geometry import meshes
from simtrack.geometry.transforms import exp_so3, is_rigid, transform
from simtrack.objects import (
    BOX_CORNERS,
    BOX_EDGES,
    SEMANTIC_CLASSES,
    Symmetries,
    SymmetryAxis,
    box_keypoints,
    superclasses,
)
from simtrack.objects.model import build_model, half_turns, rotational


def test_keypoints_are_the_corners_x_fastest_then_the_centre() -> None:
    points = box_keypoints(np.array([2.0, 4.0, 6.0]))
    expected = [
        [-1, -2, -3],
        [1, -2, -3],
        [-1, 2, -3],
        [1, 2, -3],
        [-1, -2, 3],
        [1, -2, 3],
        [-1, 2, 3],
        [1, 2, 3],
        [0, 0, 0],
    ]
    np.testing.assert_array_equal(points, expected)


def test_box_edges_join_corners_that_differ_in_one_axis() -> None:
    assert len(set(BOX_EDGES)) == 12
    for a, b in BOX_EDGES:
        assert np.count_nonzero(BOX_CORNERS[a] != BOX_CORNERS[b]) == 1


def test_trivial_symmetries_are_the_identity() -> None:
    none = Symmetries()
    assert none.trivial
    np.testing.assert_array_equal(none.poses(), np.eye(4)[None])


@pytest.mark.parametrize("symmetries", [half_turns("z"), half_turns("x", "y", "z"), rotational("z"), rotational("y")])
def test_symmetry_poses_form_a_group(symmetries: Symmetries) -> None:
    poses = symmetries.poses(np.pi / 6)
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-12)
    for T in poses:
        assert is_rigid(T)
        for other in poses:
            assert np.abs(poses - T @ other).max(axis=(1, 2)).min() < 1e-9


def test_continuous_axis_keeps_its_points_in_steps_of_at_most_the_given_angle() -> None:
    axis = SymmetryAxis(np.array([0.0, 0.6, 0.8]), np.array([0.1, 0.2, 0.3]))
    poses = Symmetries(axes=(axis,)).poses(np.deg2rad(7.0))
    assert len(poses) == 52
    on_axis = np.array([*(axis.offset + 0.4 * axis.axis), 1.0])
    np.testing.assert_allclose(poses @ on_axis, np.tile(on_axis, (52, 1)), atol=1e-12)
    cosine = 0.5 * (np.trace(poses[1, :3, :3]) - 1.0)
    assert np.arccos(cosine) <= np.deg2rad(7.0) + 1e-12


def test_models_are_moved_into_the_middle_of_their_box() -> None:
    T = transform(exp_so3(np.zeros(3)), (5.0, -3.0, 1.0))
    box = meshes.transformed(meshes.box_mesh((0.2, 0.1, 0.4)), T)
    model = build_model(
        name="box", semantic_class="box", mesh=box, visual=box, collision=[box], mass=2.0, friction=0.5,
        symmetries=half_turns("x", "y", "z"), trackable=True,
    )  # fmt: skip
    np.testing.assert_allclose(model.mesh.bounds, [[-0.1, -0.05, -0.2], [0.1, 0.05, 0.2]], atol=1e-12)
    np.testing.assert_allclose(model.collision[0].vertices, model.mesh.vertices)
    np.testing.assert_allclose(model.centre_of_mass, 0.0, atol=1e-12)
    np.testing.assert_allclose(model.keypoints[:8], 0.5 * BOX_CORNERS * model.extents)
    assert model.diameter == pytest.approx(np.linalg.norm([0.2, 0.1, 0.4]))


def test_classes_lead_to_one_root_without_cycles() -> None:
    for name, parents in SEMANTIC_CLASSES.items():
        assert all(parent in SEMANTIC_CLASSES for parent in parents), name
        chain = superclasses(name)
        assert chain[0] == name and len(set(chain)) == len(chain)
        assert "thing" in chain
        assert all(name not in superclasses(parent) for parent in parents)


def test_some_things_are_what_people_take_them_for() -> None:
    assert {"measuring-device", "tool", "artifact"} <= set(superclasses("multimeter"))
    assert "container" in superclasses("small-load-carrier")
    assert "tool" in superclasses("powerdrill")
    assert "container" not in superclasses("relay")
    assert superclasses("never heard of") == ("never heard of",)
