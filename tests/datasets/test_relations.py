"""True relations, against what is built on purpose and the scene graph's own margins."""

import numpy as np

from simtrack.contracts import MapEntity, Relation
from simtrack.datasets.relations import Relations
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.perception.scene_graph import RELATIONS, Body, RelationConfig, relation_margins
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


def test_yaw_turns_directions() -> None:
    at = standing(CAN, 0.3, 0.0)
    for yaw, name in ((0.0, "in-front-of"), (-np.pi / 2, "left-of"), (np.pi, "behind")):
        T = transform(exp_so3(np.array([0.0, 0.0, yaw])), (0.0, 0.0, 0.04))
        found = told(Relations().of((placed(1, BOX, T), placed(2, CAN, at)), (), ()))
        assert ("thing-2", name, "thing-1") in found
