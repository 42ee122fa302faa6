"""Rooms: the same from the same seed, at rest, every thing supported, families apart from the catalogue's."""

from functools import cache

import numpy as np
import pytest

from simtrack.geometry.transforms import apply, inverse
from simtrack.objects.cad import cad_classes, cad_models
from simtrack.simulation.building.rooms.evaluation import evaluation_rooms
from simtrack.simulation.building.rooms.families import FAMILIES
from simtrack.simulation.building.rooms.furnisher import NEAR
from simtrack.simulation.building.rooms.physics import FLOOR, WALLS, SettledRoom, compiled, settled_room
from simtrack.simulation.building.rooms.plan import PAIRED, RoomKind, plan_room
from simtrack.simulation.building.rooms.walk import WalkConfig, partial_entities


@cache
def room() -> SettledRoom:
    return settled_room(1)


def test_a_seed_gives_one_room() -> None:
    a, b, other = plan_room(4), plan_room(4), plan_room(5)
    assert [thing.name for thing in a.placed] == [thing.name for thing in b.placed]
    for first, second in zip(a.placed, b.placed, strict=True):
        assert np.array_equal(first.T_map_model, second.T_map_model)
        assert first.positions == second.positions
        assert np.array_equal(first.model.mesh().vertices, second.model.mesh().vertices)
    assert len(other.placed) != len(a.placed) or not np.array_equal(
        a.placed[0].T_map_model, other.placed[0].T_map_model
    )


def test_every_thing_stands_on_something_and_the_support_leads_to_the_building() -> None:
    carriers: dict[str, set[str]] = {}
    for carried, carrier in room().supports:
        carriers.setdefault(carried, set()).add(carrier)
    things = [entity.name for entity in room().entities if entity.placed is not None]
    assert len(things) >= 25
    for name in things:
        seen, front = set(), {name}
        while front:
            seen |= front
            front = set().union(*(carriers.get(each, set()) for each in front)) - seen
        assert FLOOR in seen or seen & set(WALLS), name


def test_a_settled_room_stays_at_rest() -> None:
    import mujoco

    model, data = compiled(room().plan)
    mujoco.mj_step(model, data, nstep=500)
    for thing in room().plan.placed:
        body = data.body(thing.name)
        assert np.linalg.norm(body.xpos - thing.T_map_model[:3, 3]) < 0.01, thing.name
        assert body.xmat.reshape(3, 3)[:, 2] @ thing.T_map_model[:3, 2] > np.cos(0.02), thing.name


def test_some_things_hang_lean_lie_across_two_others_and_stand_inside() -> None:
    carriers: dict[str, set[str]] = {}
    for carried, carrier in room().supports:
        carriers.setdefault(carried, set()).add(carrier)
    hung = {cleat.thing: cleat.wall for cleat in room().plan.cleats}
    assert len(hung) >= 2
    for name, wall in hung.items():
        assert carriers[name] == {wall}, "only the cleat holds it"
        assert room().entity(name).mesh.bounds[0, 2] > 1.0
    tilted = {thing.name for thing in room().plan.placed if 0.1 < abs(thing.T_map_model[2, 2]) < np.cos(0.1)}
    tilted |= {thing.name for thing in room().plan.placed if 0.1 < abs(thing.T_map_model[2, 1]) < 0.9}
    leaning = {name for pair in room().touches for name in pair} & tilted
    assert {"board", "book"} == {name.rstrip("0123456789") for name in leaning}
    assert any(len(carriers.get(name, ())) == 2 for name in carriers if name.startswith("book"))
    inside = 0
    for container in (thing for thing in room().plan.placed if thing.model.hollows and thing.model.joints):
        poses = container.model.part_poses(container.positions)
        for hollow in container.model.hollows:
            T = inverse(container.T_map_model @ poses[hollow.part])
            for thing in room().plan.placed:
                off = np.abs(apply(T, thing.T_map_model[None, :3, 3])[0] - hollow.centre)
                inside += bool((off < hollow.extents / 2).all())
    assert inside >= 1


def test_entities_stay_inside_and_above_the_floor() -> None:
    low, high = room().plan.room.polygon.min(axis=0), room().plan.room.polygon.max(axis=0)
    for entity in room().entities:
        if entity.placed is not None:
            bounds = entity.mesh.bounds
            assert bounds[0, 2] > -0.005, entity.name
            assert (bounds[0, :2] > low - 0.01).all() and (bounds[1, :2] < high + 0.01).all(), entity.name
    assert {FLOOR, *WALLS} <= {entity.name for entity in room().entities}


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_families_are_apart_from_the_catalogue(family: str) -> None:
    model = FAMILIES[family](np.random.default_rng(7)).finish(family)
    known = model.semantic_class in cad_classes()
    assert known == (family not in ("board", "picture", "shelf"))
    for other in cad_models(model.semantic_class) if known else ():
        alike = np.allclose(model.extents, other.extents, rtol=0.02)
        same_build = [len(p.convex) for p in model.parts] == [len(p.convex) for p in other.parts]
        assert not (alike and same_build), other.name


def test_a_walk_sees_parts_of_the_surface_near_where_it_is() -> None:
    config = WalkConfig(frames=8, edge=0.08)
    seen = partial_entities(room(), np.random.default_rng(0), config)
    assert [entity.name for entity in seen] == [entity.name for entity in room().entities]
    shares = np.array([entity.seen for entity in seen])
    assert (shares >= 0.0).all() and (shares <= 1.0 + 1e-9).all()
    assert (shares > 0.1).sum() >= 10
    assert (shares[5:] < 0.95).all(), "undersides are never seen"
    for whole, part in zip(room().entities, seen, strict=True):
        if len(part.mesh.faces):
            assert (part.mesh.bounds[0] > whole.mesh.bounds[0] - 0.15).all()
            assert (part.mesh.bounds[1] < whole.mesh.bounds[1] + 0.15).all()
    again = partial_entities(room(), np.random.default_rng(0), config)
    assert all(np.array_equal(a.mesh.vertices, b.mesh.vertices) for a, b in zip(seen, again, strict=True))


def test_evaluation_rooms_are_twenty_seeds() -> None:
    rooms = evaluation_rooms()
    assert len(rooms) == len(set(rooms)) == 20


@pytest.mark.parametrize("seed", [3, 12])
def test_in_an_open_kitchen_fridge_and_microwave_are_closed_with_clear_floor_before_them(seed: int) -> None:
    things = {thing.name: thing for thing in plan_room(seed, "open-kitchen").placed}
    microwave = things["microwave1"]
    assert "fridge1" in things and not things["fridge1"].positions and not microwave.positions
    bearer = min(
        (thing for name, thing in things.items() if name.startswith("cabinet")),
        key=lambda thing: np.linalg.norm(thing.T_map_model[:2, 3] - microwave.T_map_model[:2, 3]),
    )
    assert 0.6 < microwave.T_map_model[2, 3] < 1.2
    for front in (things["fridge1"], bearer):
        half = front.model.extents / 2
        for name, thing in things.items():
            if name not in (front.name, "microwave1"):
                vertices = thing.model.mesh(thing.positions).vertices
                ahead = apply(inverse(front.T_map_model) @ thing.T_map_model, vertices)
                standing = apply(thing.T_map_model, vertices)[:, 2] < 1.3
                near = (
                    (np.abs(ahead[:, 0]) < half[0]) & (ahead[:, 1] < -half[1] - 0.05) & (ahead[:, 1] > -half[1] - 1.2)
                )
                assert not (near & standing).any(), name


@pytest.mark.parametrize("kind", PAIRED)
@pytest.mark.parametrize("seed", [0, 8])
def test_one_of_a_pair_stands_close_before_the_middle_of_the_other_at_a_wall(kind: RoomKind, seed: int) -> None:
    plan = plan_room(seed, kind)
    things = {thing.name: thing for thing in plan.placed}
    rear, front = (things[f"{name}1"] for name in PAIRED[kind])
    low, high = plan.room.polygon.min(axis=0), plan.room.polygon.max(axis=0)
    back = apply(rear.T_map_model, np.array([[0.0, rear.model.extents[1] / 2, 0.0]]))[0, :2]
    assert np.minimum(back - low, high - back).min() < 0.1
    T_rear_front = inverse(rear.T_map_model) @ front.T_map_model
    gap = -T_rear_front[1, 3] - (rear.model.extents[1] + front.model.extents[1]) / 2
    assert gap == pytest.approx(NEAR) and T_rear_front[0, 3] == pytest.approx(0.0, abs=1e-9)
    assert T_rear_front[1, 1] == pytest.approx(-1.0), "turned to each other"
