import numpy as np
import pytest

from simtrack.contracts import (
    NANOSECONDS,
    Belief,
    JointState,
    Localization,
    Presegmentation,
    RegionOfInterest,
    StaticMap,
    Status,
)
from simtrack.geometry.transforms import transform_planar
from simtrack.simulation.agents.floor_plan import FloorPlan, FloorPlanConfig
from simtrack.simulation.agents.route import RouteAgent
from simtrack.simulation.building.office_floor import OfficeFloorConfig, office_floor
from simtrack.simulation.building.parts import StaticPart, StaticWorld
from simtrack.simulation.survey import SurveyConfig, survey

FAITHFUL = SurveyConfig(noise=0.0, edge=1.0, moved=0.0, brought=0.0, removed=0.0)
SMALL = OfficeFloorConfig(triangles=80_000, area=700.0)


@pytest.fixture(scope="module")
def world() -> StaticWorld:
    return office_floor(np.random.default_rng(0), SMALL)


@pytest.fixture(scope="module")
def static_map(world: StaticWorld) -> StaticMap:
    return survey(world, SurveyConfig(edge=0.5), np.random.default_rng(1))


@pytest.fixture(scope="module")
def truth(world: StaticWorld) -> FloorPlan:
    return FloorPlan(survey(world, FAITHFUL, np.random.default_rng(2)))


@pytest.mark.parametrize("seed", [0, 3, 7])
def test_every_room_can_be_reached(seed: int) -> None:
    world = office_floor(np.random.default_rng(seed), SMALL)
    plan = FloorPlan(survey(world, FAITHFUL, np.random.default_rng(seed)))
    rng = np.random.default_rng(0)
    places = {room.name: plan.place_in(room, rng) for room in world.rooms}
    assert [name for name, place in places.items() if place is None] == []


def test_ways_are_free_of_collisions_and_end_at_their_goals(truth: FloorPlan) -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        start, goal = truth.random_free(rng), truth.random_free(rng)
        path = truth.plan(start, goal)
        assert path is not None
        assert np.linalg.norm(path[0] - start) < 0.1
        assert np.linalg.norm(path[-1] - goal) < 0.1
        assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.11
        assert min(truth.clearance_at(x, y) for x, y in path) > truth.config.radius
        assert all(truth.free(x, y) for x, y in path)


def test_walls_and_tables_are_occupied_and_floors_are_not(world: StaticWorld, truth: FloorPlan) -> None:
    tables = [part for part in world.parts if part.semantic_class in ("table", "desk", "workbench")]
    for table in tables:
        assert not truth.free(*table.T_map_part[:2, 3])
    assert truth.image().shape == truth.occupied.shape
    left, right, bottom, top = truth.extent
    assert left < 0 < right
    assert bottom < 0 < top
    assert not truth.free(left - 5.0, bottom)


def test_obstacles_that_were_met_are_planned_around(world: StaticWorld) -> None:
    plan = FloorPlan(survey(world, FAITHFUL, np.random.default_rng(2)))
    rng = np.random.default_rng(3)
    paths = (plan.plan(plan.random_free(rng), plan.random_free(rng)) for _ in range(20))
    path = next(path for path in paths if path is not None and len(path) > 60)
    middle = path[len(path) // 2]
    plan.block(middle[None])
    around = plan.plan(path[0], path[-1])
    assert around is None or np.linalg.norm(around - middle, axis=1).min() > plan.config.radius
    plan.unblock()
    again = plan.plan(path[0], path[-1])
    assert again is not None
    np.testing.assert_allclose(again, path)


def test_a_map_without_rooms_can_be_planned_on() -> None:
    square = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]], dtype=np.float32)
    wall = np.array([[2, 0, 0], [2, 3, 0], [2, 3, 2], [2, 0, 2]], dtype=np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    static_map = StaticMap(np.concatenate([square, wall]), np.concatenate([faces, faces + 4]))
    plan = FloorPlan(static_map, FloorPlanConfig(radius=0.2, margin=0.0))
    path = plan.plan(np.array([1.0, 1.0]), np.array([3.0, 1.0]))
    assert path is not None
    assert path[:, 1].max() > 3.1


def regions_of(moved: list[StaticPart], stamp: int, xy: np.ndarray) -> tuple[RegionOfInterest, ...]:
    """What a perfect pre-segmentation reports of furniture near the robot that no survey shows."""
    out = []
    for part in moved:
        if np.linalg.norm(part.T_map_part[:2, 3] - xy) < 4.0:
            footprint = part.footprint()
            centre = np.array([*(footprint.min(axis=0) + footprint.max(axis=0)) / 2, part.T_map_part[2, 3]])
            extents = np.array([*np.ptp(footprint, axis=0), part.extents[2]])
            out.append(RegionOfInterest(stamp, np.zeros(4), centre, extents, 50, "lidar"))
    return tuple(out)


def belief_at(stamp: int, T: np.ndarray, status: Status, regions: tuple[RegionOfInterest, ...] = ()) -> Belief:
    seen = Presegmentation(stamp, np.zeros(1, bool), 1, np.zeros(1, np.int32), regions, "lidar")
    return Belief(stamp, Localization(stamp, T, np.eye(6), status), T, (), None, seen, frozenset())


@pytest.mark.parametrize("seed", [0, 1])
def test_a_minute_of_touring_covers_ground_without_touching_anything(
    world: StaticWorld, static_map: StaticMap, truth: FloorPlan, seed: int
) -> None:
    surveyed = {entity.name: entity.T_map_entity for entity in static_map.entities}
    moved = [
        part
        for part in world.parts
        if part.survey == "movable"
        and (part.name not in surveyed or np.linalg.norm((surveyed[part.name] - part.T_map_part)[:2, 3]) > 0.05)
    ]
    agent = RouteAgent(static_map, np.random.default_rng(seed))
    corridor = world.rooms[0].polygon.mean(axis=0)
    state, driven, period = np.array([*corridor, 0.3]), 0.0, 1 / 15
    for step in range(int(60 / period)):
        stamp = int(step * period * NANOSECONDS)
        T = transform_planar(state[0], state[1], state[2])
        command = agent.act(
            belief_at(stamp, T, Status.OK, regions_of(moved, stamp, state[:2])), JointState(stamp, (), np.zeros(0))
        )
        advance = command.linear * period * np.array([np.cos(state[2]), np.sin(state[2])])
        assert truth.clearance_at(*(state[:2] + advance)) > 0.24
        state += [*advance, command.angular * period]
        driven += float(np.linalg.norm(advance))
    assert driven > 30.0


def test_a_lost_robot_turns_in_place_and_an_uncertain_one_creeps(static_map: StaticMap, world: StaticWorld) -> None:
    agent = RouteAgent(static_map, np.random.default_rng(0))
    x, y = world.rooms[0].polygon.mean(axis=0)
    T = transform_planar(x, y, 0.0)
    joints = JointState(0, (), np.zeros(0))
    for status, fastest in ((Status.LOST, 1e-9), (Status.AMBIGUOUS, 0.16)):
        for step in range(60):
            command = agent.act(belief_at(step * NANOSECONDS // 15, T, status), joints)
            assert abs(command.linear) <= fastest
    command = agent.act(belief_at(60 * NANOSECONDS // 15, T * np.nan, Status.LOST), joints)
    assert np.isfinite([command.linear, command.angular]).all()
