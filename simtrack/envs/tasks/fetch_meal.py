"""Fetch a meal: out of the fridge, into the microwave, door closed."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Float64, Relation
from simtrack.envs.task import Moment, Score, Task
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import apply, exp_so3, inverse
from simtrack.objects import load_object
from simtrack.simulation.agents.floor_plan import FloorPlan
from simtrack.simulation.building.parts import MovingPart, StaticPart, StaticWorld
from simtrack.simulation.mjcf_world import free_bodies, level_faces, mjcf_building, mjcf_scene
from simtrack.simulation.scene_file import SceneFile, parse_scene

if TYPE_CHECKING:
    from simtrack.simulation.simulation import Simulation

ITEM = "relay"
"""Model of the catalogue that stands for the meal: its ends are flat."""
OPENED = np.deg2rad(60.0)
"""Radians from which on the fridge counts as opened."""
CLOSED = np.deg2rad(4.0)
"""Radians up to which the microwave counts as closed."""
SHELF_HEIGHTS, CAVITY_HEIGHTS = (0.55, 1.03), (0.7, 1.06)
"""Metres above the floor within which the arm works from the front: boards of fridges, floors of microwaves."""
HEADROOM = 0.2
"""Metres of free height above a board."""
DEPTH = (0.05, 0.10)
"""Metres from a board's front edge to the middle of the item."""
ASIDE, TURN = 0.06, 0.15
"""Metres off the middle of the board, and radians off the direction to its front, at most."""
BEFORE = 1.0
"""Metres before the middle of a board to which there has to be a way."""
AT_REST = 0.05
"""m/s."""
WORTH = {"opened": 1.0, "taken": 1.0, "inside": 1.0, "closed": 2.0}
"""Stage -> what the first time that it is reached is worth."""


@dataclass(frozen=True, slots=True)
class Appliance:
    """A fridge or a microwave: a body with a hinged door and a board behind it."""

    body: StaticPart
    door: MovingPart
    board: int
    """Which of its level faces."""
    T_map_board: Float64
    """(4, 4), origin in its middle, x towards the door, z up."""
    size: Float64
    """(2,), metres, along x and y."""
    headroom: float
    """Metres of free height."""


class FetchMeal(Task):
    """Open the fridge, take the item, put it into the microwave, close it.

    One point each for the fridge opened (60 degrees), the item taken off its board, the item inside of the microwave,
    and two for the microwave closed with the item inside, which ends the episode as a success.
    """

    script = "fetch-meal"
    scene = "open_kitchen:0"
    seconds = 360.0
    macros = ("articulate", "take", "insert")

    def adapt(self, scene: SceneFile) -> SceneFile:
        """The scene as one with doors that open, the item on a board of the fridge, the robot anywhere.

        Raises:
            InvalidValueError: there is no fridge or no microwave of which the arm reaches a board, or no floor.
        """
        if scene.static.builder == "room":
            from simtrack.simulation.building.rooms.functional import functional_room
            from simtrack.simulation.building.rooms.plan import kind_of

            scene = mjcf_scene(functional_room(scene.static.seed or 0, kind_of(scene.static.config)))
        if scene.static.builder != "mjcf":
            raise InvalidValueError(
                "scene", scene.name, "a kitchen (open_kitchen:SEED, kitchen:SEED), or an MJCF file of one"
            )
        world = mjcf_building(scene, supports=False)
        fridge = appliance(world, "fridge", SHELF_HEIGHTS, scene)
        microwave = appliance(world, "microwave", CAVITY_HEIGHTS, scene)
        self.fridge, self.microwave = fridge.door.part.name, microwave.door.part.name
        self.goals = (Relation(ITEM, "on", microwave.body.name),)
        place = _placement(fridge)
        document = scene.model_dump(mode="json", exclude_defaults=True)
        document["objects"] = [{"model": ITEM, "name": ITEM, "place": place}]
        document["robot"] = {"start": {"room": "room"}, "torso": 0.3, "head_tilt": -0.4, "suction": True}
        self._kept, self._inside = fridge, microwave
        return parse_scene(document, scene.path)

    def begin(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Nothing is done yet."""
        self._stages: dict[str, bool] = dict.fromkeys(WORTH, False)

    def score(self, moment: Moment) -> Score:
        """See the class."""
        truth = moment.truth
        item, joints = truth.objects[ITEM], truth.joints
        fridge, microwave = joints[self.fridge], joints[self.microwave]
        low = self._inside.door.lower
        inside = self._contains(item.T_map_object[:3, 3])
        free = moment.holding != ITEM
        resting = float(np.linalg.norm(item.velocity[:3])) < AT_REST
        inside = inside and free and resting
        closed = inside and microwave - low < CLOSED
        now = {
            "opened": fridge - self._fridge_closed >= OPENED,
            "taken": moment.holding == ITEM,
            "inside": inside,
            "closed": closed,
        }
        reward = sum(WORTH[stage] for stage, done in now.items() if done and not self._stages[stage])
        self._stages = {stage: done or now[stage] for stage, done in self._stages.items()}
        metrics = {
            "fridge": fridge - self._fridge_closed,
            "microwave": microwave - low,
            **{stage: float(done) for stage, done in self._stages.items()},
        }
        return Score(reward, closed, terminated=closed, metrics=metrics)

    def prepare(self, simulation: "Simulation") -> None:
        """Look up where the fridge is closed and where one can drive."""
        doors = {moving.part.name: moving for moving in simulation.world.static.moving}
        self._fridge_closed = doors[self.fridge].lower
        self._floor = FloorPlan(simulation.static_map)

    def playable(self, simulation: "Simulation") -> bool:
        """Whether there is a way from the start to both appliances."""
        start = simulation.start[:2, 3]
        fronts = (T[:2, 3] + BEFORE * T[:2, 0] for T in (self._kept.T_map_board, self._inside.T_map_board))
        return self._floor.free(*start.tolist()) and all(self._floor.plan(start, front) is not None for front in fronts)

    def _contains(self, place: Float64) -> bool:
        """Whether the middle of something is inside of the microwave, above its board."""
        x, y, z = apply(inverse(self._inside.T_map_board), place[None])[0]
        half = self._inside.size / 2
        return bool(abs(x) < half[0] and abs(y) < half[1] and 0.0 < z < self._inside.headroom)


def appliance(world: StaticWorld, kind: str, heights: tuple[float, float], scene: SceneFile) -> Appliance:
    """The appliance of a class whose door and board the arm reaches.

    Raises:
        InvalidValueError: there is none.
    """
    taken = free_bodies(scene)
    for body in (part for part in world.parts if part.semantic_class == kind):
        doors = [m for m in world.moving if m.part.name.startswith(f"{body.name}/") and m.kind == "revolute"]
        for door in doors:
            found = [board for board in _boards(body, door, heights) if not _covered(board, taken)]
            if found:
                return max(found, key=lambda board: float(board.T_map_board[2, 3]))
    allowed = f"one with a {kind} that has a door and a free board {heights[0]:g} to {heights[1]:g} m above the floor"
    raise InvalidValueError("scene", scene.name, allowed)


def _boards(body: StaticPart, door: MovingPart, heights: tuple[float, float]) -> list[Appliance]:
    """Level faces behind a door, within its height and with headroom, turned so that x points to the door."""
    front = outwards(door)
    faces = level_faces(body)
    levels = sorted(float((body.T_map_part @ T)[2, 3]) for T, _ in faces)
    top = float(body.T_map_part[2, 3] + body.extents[2] / 2)
    low, high = (door.part.T_map_part[2, 3] + s * door.part.extents[2] / 2 for s in (-1, 1))
    out = []
    for number, (T_part_face, size) in enumerate(faces):
        T = body.T_map_part @ T_part_face
        z = float(T[2, 3])
        above = min((level for level in levels if level > z + 0.05), default=top)
        if not (heights[0] <= z <= heights[1] and z < high and z > low - 0.1 and z < top - 0.1):
            continue
        if min(above, top) - z < (HEADROOM if body.semantic_class == "fridge" else 0.14):
            continue
        side = np.cross([0.0, 0.0, 1.0], front)
        local = T[:3, :3].T @ front
        swapped = abs(local[1]) > abs(local[0])
        T_map_board = np.eye(4)
        T_map_board[:3, :3] = np.stack([front, side, [0.0, 0.0, 1.0]], axis=1)
        T_map_board[:3, 3] = T[:3, 3]
        headroom = min(above, top) - z
        out.append(Appliance(body, door, number, T_map_board, size[::-1] if swapped else size, headroom))
    return out


def outwards(door: MovingPart) -> Float64:
    """(3,), unit vector, horizontal: where the closed door looks, map frame."""
    arm = door.part.T_map_part[:3, 3] - door.anchor
    arm = arm - (arm @ door.axis) * door.axis
    out = np.cross(door.axis, arm)
    out[2] = 0.0
    out /= np.linalg.norm(out)
    return _closed_direction(out, door)


def _closed_direction(out: Float64, door: MovingPart) -> Float64:
    """The direction at the joint's lower end, which is where the door is closed; 0 is where it was seen."""
    return exp_so3(door.lower * door.axis) @ out


def _covered(board: Appliance, taken: dict[str, Float64]) -> bool:
    """Whether something free stands on the part of a board that is needed."""
    T = inverse(board.T_map_board)
    for name, (low, high) in taken.items():
        if name == board.body.name or name.startswith(f"{board.body.name}/"):
            continue
        corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        local = apply(T, corners)
        near, far = local.min(axis=0), local.max(axis=0)
        if (
            far[2] < -0.02
            or near[2] > board.headroom - 0.03
            or near[0] > board.size[0] / 2
            or far[0] < board.size[0] / 2 - 0.25
        ):
            continue
        if near[1] < 0.18 and far[1] > -0.18:
            return True
    return False


def _placement(fridge: Appliance) -> dict:
    """Where the item may stand, in the frame of the face that the scene's placement refers to."""
    T_map_face = fridge.body.T_map_part @ level_faces(fridge.body)[fridge.board][0]
    height = float(load_object(ITEM).extents[2])
    edge = float(fridge.size[0]) / 2
    corners = np.array([[edge - d, y, height] for d in DEPTH for y in (-ASIDE, ASIDE)])
    local = apply(inverse(T_map_face) @ fridge.T_map_board, corners)
    low, high = local.min(axis=0), local.max(axis=0)
    front = T_map_face[:3, :3].T @ fridge.T_map_board[:3, 0]
    yaw = float(np.arctan2(front[1], front[0]))
    return {
        "on": fridge.body.name,
        "face": fridge.board,
        "x": [float(low[0]), float(high[0])],
        "y": [float(low[1]), float(high[1])],
        "yaw": [yaw - TURN, yaw + TURN],
    }
