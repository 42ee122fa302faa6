"""True relations and support, against what is built on purpose."""

import mujoco
import numpy as np

from simtrack.contracts import MapEntity, Relation
from simtrack.datasets.relations import Relations
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.perception.scene_graph import RELATIONS, Body, RelationConfig, relation_margins
from simtrack.simulation.contacts import contact_pairs, support_tree
from tests.datasets.tabletop import BOX, BRACKET, CAN, placed, standing

TABLE = MapEntity("table", "table", transform(None, (0.0, 0.0, -0.4)), np.array([1.0, 1.0, 0.8]))


def told(relations: tuple[Relation, ...]) -> set[tuple[str, str, str]]:
    return {(relation.subject, relation.name, relation.reference) for relation in relations}


def test_relations_are_the_scene_graphs_and_on_is_what_physics_says() -> None:
    on_top = transform(None, (0.0, 0.0, 0.08 + 0.08))
    things = (placed(1, BOX, standing(BOX, 0.0, 0.0)), placed(2, CAN, on_top), placed(3, CAN, standing(CAN, 0.2, 0.0)))
    support = (("thing-1", "table"), ("thing-2", "thing-1"))
    found = Relations().of(things, (TABLE,), support)
    assert {("thing-1", "on", "table"), ("thing-2", "on", "thing-1")} <= told(found)
    assert ("thing-3", "on", "table") not in told(found)  # it stands there, but physics does not say so
    assert {("thing-2", "above", "thing-1"), ("thing-1", "below", "thing-2")} <= told(found)
    assert ("thing-3", "in-front-of", "thing-1") in told(found)  # along the box's own x axis
    assert {("thing-1", "near", "thing-3"), ("thing-3", "near", "thing-1")} <= told(found)
    assert not {(a, name, a) for a, name, b in told(found) if a == b}
    assert found == tuple(sorted(found, key=lambda r: (r.subject, r.name, r.reference)))
    assert Relations().of(things[::-1], (TABLE,), support[::-1]) == found


def test_they_are_the_scene_graphs_margins_that_are_not_negative() -> None:
    rng, config = np.random.default_rng(5), RelationConfig()
    for _ in range(10):
        things = tuple(
            placed(k, mesh, transform(exp_so3(rng.uniform(-2, 2, 3)), rng.uniform(-0.3, 0.3, 3)), scale=scale)
            for k, (mesh, scale) in enumerate(((BOX, 1.0), (CAN, 1.0), (BOX, 1.4), (BRACKET, 0.7)), start=1)
        )
        statics = (TABLE, MapEntity("wall", "wall", transform(None, (0.5, 0.0, 0.0)), np.array([0.1, 3.0, 3.0])))
        relations = Relations(config)
        bodies = [Body(relations._shape(thing)[1], thing.T_map_object) for thing in things]
        bodies += [Body(relations._static(entity)[1], entity.T_map_entity) for entity in statics]
        names = [thing.name for thing in things] + [entity.name for entity in statics]
        margins = relation_margins(bodies, config)
        expected = {
            (names[i], RELATIONS[k], names[j])
            for i, j, k in np.argwhere(margins >= 0.0)
            if RELATIONS[k] != "on" and min(i, j) < len(things)
        }
        assert told(relations.of(things, statics, ())) == expected and len(expected) > 5


def test_nothing_is_said_of_furniture_alone_and_scale_counts() -> None:
    other = MapEntity("bench", "table", transform(None, (0.9, 0.0, -0.4)), np.array([0.5, 1.0, 0.8]))
    relations = Relations(RelationConfig(near_range=0.1))
    assert relations.of((), (TABLE, other), ()) == ()
    apart = 0.25
    small = (placed(1, BOX, standing(BOX, 0.0, 0.0)), placed(2, BOX, standing(BOX, 0.0, apart)))
    assert ("thing-1", "near", "thing-2") not in told(relations.of(small, (), ()))
    large = tuple(placed(k, BOX, standing(BOX, 0.0, (k - 1) * apart, 0.0, 1.6), None, 1.6) for k in (1, 2))
    assert ("thing-1", "near", "thing-2") in told(relations.of(large, (), ()))


STACK = """<mujoco><option gravity='-11 0 -9.81'/><worldbody>
  <geom name='floor' type='plane' size='2 2 .1'/>
  <geom name='wall' type='box' size='.05 1 1' pos='-.25 0 1'/>
  <body pos='0 0 .1'><freejoint/><geom name='low' type='box' size='.2 .1 .1' density='800'/></body>
  <body pos='.05 0 .25'><freejoint/><geom name='high' type='box' size='.05 .05 .05'/></body>
  <body pos='1 0 .5'><freejoint/><geom name='falling' type='sphere' size='.05'/></body>
</worldbody></mujoco>"""


def test_support_follows_contacts_from_above() -> None:
    model = mujoco.MjModel.from_xml_string(STACK)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=40)
    names = ["floor", "wall", "low", "high", "falling"]
    owners = np.array([names.index(model.geom(k).name) for k in range(model.ngeom)], np.int32)
    movable = np.array([False, False, True, True, True])
    assert support_tree(data, owners, movable, names) == (("low", "floor"), ("high", "low"))
    _, touching = contact_pairs(data, owners, movable)
    assert touching.tolist() == [[0, 2], [1, 2], [2, 3]]  # the wall is leant on, and carries nothing
    owners[0] = -1
    assert support_tree(data, owners, movable, names) == (("high", "low"),)
    assert support_tree(mujoco.MjData(model), owners, movable, names) == ()


def test_support_does_not_depend_on_which_geom_comes_first() -> None:
    turned = STACK.replace("<geom name='floor' type='plane' size='2 2 .1'/>", "").replace(
        "</worldbody>", "<geom name='floor' type='box' size='2 2 .05' pos='0 0 -.05'/></worldbody>"
    )
    model = mujoco.MjModel.from_xml_string(turned)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=40)
    names = sorted(model.geom(k).name for k in range(model.ngeom))
    owners = np.array([names.index(model.geom(k).name) for k in range(model.ngeom)], np.int32)
    movable = np.array([name in ("low", "high", "falling") for name in names])
    assert set(support_tree(data, owners, movable, names)) == {("low", "floor"), ("high", "low")}


def test_yaw_turns_directions() -> None:
    at = standing(CAN, 0.3, 0.0)
    for yaw, name in ((0.0, "in-front-of"), (-np.pi / 2, "left-of"), (np.pi, "behind")):
        T = transform(exp_so3(np.array([0.0, 0.0, yaw])), (0.0, 0.0, 0.04))
        found = told(Relations().of((placed(1, BOX, T), placed(2, CAN, at)), (), ()))
        assert ("thing-2", name, "thing-1") in found
