"""The CAD catalogue: canonical, closed, complete, articulated without self-collision, equal from the cache."""

import numpy as np
import pytest

from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.meshes import is_closed, volume
from simtrack.geometry.transforms import inverse
from simtrack.objects.cad import CAD_CLASSES, CadModel, cad_model, cad_models
from simtrack.objects.cad.library import build_class
from simtrack.objects.cad.store import packed, unpacked
from simtrack.objects.semantics import SEMANTIC_CLASSES

NAMES = {
    "bed", "table", "chair", "monitor", "sofa", "bag", "cabinet", "fridge", "cup", "bottle", "bowl", "book", "keyboard",
    "microwave", "plant", "box",
}  # fmt: skip


def test_every_class_has_eight_variants_of_different_construction() -> None:
    assert set(CAD_CLASSES) == NAMES
    for semantic_class in CAD_CLASSES:
        assert semantic_class in SEMANTIC_CLASSES
        models = cad_models(semantic_class)
        assert len({model.name for model in models}) == len(models) >= 8
        built = {(len(m.parts), sum(len(p.convex) for p in m.parts), len(m.planes), len(m.supports)) for m in models}
        shapes = {
            (
                *np.round(m.extents / m.extents[2], 2),
                round(volume(m.mesh()) / np.prod(m.extents), 3),
                len(m.mesh().faces),
            )
            for m in models
        }
        assert len(built) >= 4, "variants differ in parts and construction"
        assert len(shapes) == len(models), "no variant is another one scaled"


@pytest.mark.parametrize("semantic_class", CAD_CLASSES)
def test_models_are_canonical_and_closed(semantic_class: str) -> None:
    for model in cad_models(semantic_class):
        bounds = model.mesh().bounds
        assert np.allclose(bounds.sum(axis=0), 0.0, atol=1e-6), model.name
        assert np.allclose(np.ptp(bounds, axis=0), model.extents, atol=1e-6)
        assert model.extents.min() > 0.005 and model.extents.max() < 2.5
        assert model.yaw_symmetries[0] == 0.0
        for part in model.parts:
            assert is_closed(part.mesh), (model.name, part.name)
            assert part.mass > 0.0 and (np.linalg.eigvalsh(part.inertia) > 0.0).all()
            assert all(is_closed(convex) and volume(convex) > 0.0 for convex in part.convex) and part.convex
            low, high = part.mesh.bounds
            assert (part.centre_of_mass > low).all() and (part.centre_of_mass < high).all()


@pytest.mark.parametrize("semantic_class", CAD_CLASSES)
def test_planes_and_faces_to_stand_on_lie_on_the_surface(semantic_class: str) -> None:
    for model in cad_models(semantic_class):
        for plane in model.planes:
            vertices = model.part(plane.part).mesh.vertices
            assert np.isclose(np.linalg.norm(plane.normal), 1.0)
            assert np.count_nonzero(np.abs(vertices @ plane.normal + plane.offset) < 2e-3) >= 3
            assert abs(plane.normal @ plane.centre + plane.offset) < 1e-9
        for support in model.supports:
            heights = model.part(support.part).mesh.vertices[:, 2]
            assert np.abs(heights - support.centre[2]).min() < 1e-6, (model.name, support)
        for box in model.hollows:
            assert (np.abs(box.centre) + box.extents / 2 <= model.extents / 2 + 0.01).all(), model.name


def test_what_opens_has_joints_with_handles_and_what_is_small_can_be_gripped() -> None:
    for semantic_class in ("fridge", "microwave", "cabinet"):
        for model in cad_models(semantic_class):
            assert "openable" in model.affordances and "contains" in model.affordances
            assert {joint.child for joint in model.joints} <= {handle.part for handle in model.handles}
            for joint in model.joints:
                assert joint.lower == 0.0 < joint.upper and joint.friction > 0.0
    for semantic_class in ("cup", "bottle", "bowl", "book"):
        assert all("graspable" in model.affordances for model in cad_models(semantic_class))


def test_a_positive_position_moves_every_handle_to_the_front_of_its_part() -> None:
    for semantic_class in ("fridge", "microwave", "cabinet", "bed", "table"):
        for model in cad_models(semantic_class):
            for joint in model.joints:
                poses = model.part_poses({joint.name: 0.3 * joint.upper})
                for handle in (h for h in model.handles if h.part == joint.child):
                    moved = poses[joint.child][:3, :3] @ handle.centre + poses[joint.child][:3, 3]
                    assert moved[1] < handle.centre[1] - 0.01, (model.name, joint.name)


def test_joint_motions_form_a_group() -> None:
    model = cad_model("fridge-freezer_below")
    for joint in model.joints:
        assert np.allclose(joint.motion(0.3) @ joint.motion(0.4), joint.motion(0.7))
        assert np.allclose(inverse(joint.motion(0.3)), joint.motion(-0.3))


def test_models_survive_the_cache_and_are_built_alike() -> None:
    built = build_class("microwave")
    for model, again in zip(built, unpacked(packed(built)), strict=True):
        _assert_equal(model, again)
    for model, again in zip(built, build_class("microwave"), strict=True):
        _assert_equal(model, again)


def _assert_equal(a: CadModel, b: CadModel) -> None:
    first, second = packed((a,)), packed((b,))
    assert sorted(first) == sorted(second)
    for name, array in first.items():
        assert np.array_equal(array, second[name]), (a.name, name)


def test_misuse_says_what_there_is() -> None:
    with pytest.raises(UnknownNameError, match="fridge"):
        cad_models("spaceship")
    with pytest.raises(UnknownNameError, match="fridge-mini_bar"):
        cad_model("fridge-nuclear")
    model = cad_model("microwave-compact")
    with pytest.raises(UnknownNameError, match="door-joint"):
        model.mesh({"lid": 0.3})
    with pytest.raises(InvalidValueError, match="joint each"):
        CadModel(
            "x",
            "box",
            (*model.parts, *model.parts[:1])[:2],
            (),
            model.extents,
            (),
            (),
            (),
            (),
            frozenset(),
            np.zeros(1),
        )
