"""Settling: what stands stays exactly, what leans or hovers comes to rest, what would topple is held and reported."""

from dataclasses import replace

import numpy as np
import pytest

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.perception.reconstruction.body_tree import Body, BodyJoint, BodyTree, Shape
from simtrack.perception.reconstruction.settling import SettlingConfig, settle

SIDE = 0.1
CUBE = (SIDE, SIDE, SIDE)


def floor() -> list[Body]:
    slab = Shape("box", (4.0, 4.0, 0.1), T_body_shape=transform(None, (0.0, 0.0, -0.05)))
    wall = Shape("box", (4.0, 0.1, 1.0), T_body_shape=transform(None, (0.0, 1.05, 0.5)))
    return [Body("floor", collision=(slab, wall), friction=0.6)]


def thing(name: str, size: tuple[float, float, float], T: Float64, support: str = "floor") -> Body:
    inertia = np.diag([size[1] ** 2 + size[2] ** 2, size[0] ** 2 + size[2] ** 2, size[0] ** 2 + size[1] ** 2]) / 12.0
    joint = BodyJoint(f"{name}/floating", "floating", support, T)
    return Body(name, joint, collision=(Shape("box", size),), mass=1.0, inertia=inertia, friction=0.5)


def tree(*things: Body) -> BodyTree:
    return BodyTree("scene", (*floor(), *things))


def test_what_stands_stays_exactly_where_it_is() -> None:
    scene = tree(
        thing("lower", CUBE, transform(None, (0.3, 0.2, SIDE / 2))),
        thing("upper", CUBE, transform(exp_so3(np.array([0.0, 0.0, 0.4])), (0.0, 0.0, SIDE)), "lower"),
    )
    settled = settle(scene)
    start = scene.forward()
    assert settled.held == {}
    for name in ("lower", "upper"):
        np.testing.assert_array_equal(settled.poses[name], start[name])


def test_what_hovers_comes_down_and_what_is_in_another_comes_out() -> None:
    scene = tree(
        thing("hovering", CUBE, transform(None, (-0.5, 0.0, SIDE / 2 + 0.01))),
        thing("first", CUBE, transform(None, (0.0, 0.0, SIDE / 2))),
        thing("second", CUBE, transform(None, (SIDE - 0.012, 0.0, SIDE / 2))),
    )
    poses = settle(scene).poses
    assert poses["hovering"][2, 3] == pytest.approx(SIDE / 2, abs=5e-4)
    assert poses["second"][0, 3] - poses["first"][0, 3] > SIDE - 5e-4


def test_what_leans_steeply_comes_to_rest_against_the_wall() -> None:
    height, thick, lean = 0.25, 0.03, np.radians(12.0)
    R = exp_so3(np.array([-lean, 0.0, 0.0]))  # its top towards the wall at y = 1
    reach = R @ [0.0, thick / 2, height / 2]
    gap = 0.01
    down = -(R @ [0.0, thick / 2, -height / 2])[2]
    book = thing("book", (0.18, thick, height), transform(R, (0.0, 1.0 - gap - reach[1], down)))
    settled = settle(tree(book), SettlingConfig(shift=0.05))
    assert settled.held == {}
    corners = book.collision[0].corners() @ settled.poses["book"][:3, :3].T + settled.poses["book"][:3, 3]
    assert corners[:, 2].min() == pytest.approx(0.0, abs=1e-3)
    assert corners[:, 1].max() == pytest.approx(1.0, abs=1e-3)
    again = settle(BodyTree("scene", (*floor(), thing("book", (0.18, thick, height), settled.poses["book"]))))
    np.testing.assert_array_equal(again.poses["book"], settled.poses["book"])


def test_what_would_topple_is_held_and_reported_and_carries_what_stands_on_it() -> None:
    R = exp_so3(np.array([0.0, np.radians(30.0), 0.0]))
    pole = thing("pole", (0.04, 0.04, 0.4), transform(R, (0.0, 0.0, 0.2)))
    box = thing("box", CUBE, transform(None, (0.6, 0.0, SIDE / 2 + 0.005)))
    settled = settle(tree(pole, box))
    assert set(settled.held) == {"pole"}
    assert settled.held["pole"].turn > np.radians(20.0)
    np.testing.assert_array_equal(settled.poses["pole"], transform(R, (0.0, 0.0, 0.2)))
    assert settled.poses["box"][2, 3] == pytest.approx(SIDE / 2, abs=5e-4)


def test_what_stands_on_a_narrow_edge_is_wobbly_and_stays_where_it_rests() -> None:
    """A plate falls at a tilt of atan(thickness / height): 1.4 deg for the thin one, 5.7 deg for the other."""
    thin, thick = (
        thing(name, (0.2, width, 0.4), transform(None, (x, 0.0, 0.2)))
        for name, width, x in (("thin", 0.01, 0.0), ("thick", 0.04, 0.5))
    )
    settled = settle(tree(thin, thick))
    assert settled.held == settled.stuck == {}
    assert set(settled.wobbly) == set(settled.restless) == {"thin"}
    assert settled.wobbly["thin"] > SettlingConfig().wobble
    assert "tilted" in settled.trouble("thin")
    for name, body in (("thin", thin), ("thick", thick)):
        assert body.joint is not None
        np.testing.assert_array_equal(settled.poses[name], body.joint.T_parent_body)
    assert settle(tree(thin, thick), SettlingConfig(tilt=0.0)).wobbly == {}


def test_joints_keep_their_position() -> None:
    """A lid that stands open upright on a box that drops does not close."""
    box = thing("box", CUBE, transform(None, (0.0, 0.0, SIDE / 2 + 0.01)))
    hinge = BodyJoint("lid", "revolute", "box", transform(None, (SIDE / 2, 0.0, SIDE / 2)), np.array([0.0, 1.0, 0.0]),
                      lower=-0.5, upper=0.5)  # fmt: skip
    shape = Shape("box", (0.004, SIDE, SIDE), T_body_shape=transform(None, (0.01, 0.0, SIDE / 2)))
    lid = replace(thing("lid", (0.004, SIDE, SIDE), np.eye(4)), joint=hinge, collision=(shape,), mass=0.05)
    settled = settle(tree(box, lid))
    assert set(settled.poses) == {"box"}
    np.testing.assert_allclose(settled.poses["box"], transform(None, (0.0, 0.0, SIDE / 2)), atol=5e-4)


@pytest.mark.parametrize(
    "field", [{"shift": 0.0}, {"turn": float("nan")}, {"friction": 1.5}, {"rounds": -1}, {"tilt": 1.0}]
)
def test_settings_out_of_range_are_refused(field: dict) -> None:
    with pytest.raises(InvalidValueError, match=next(iter(field))):
        SettlingConfig(**field)
