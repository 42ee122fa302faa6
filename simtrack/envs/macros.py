"""Grasp and place: what an agent cannot steer in ten commands a second, done through physics.

The servos of the arm follow joint angles that bring the cup to where the object is BELIEVED to be. The cup holds what
it truly touches, or nothing. No pose is ever set.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from simtrack.contracts import Float64
from simtrack.envs.actions import Outcome
from simtrack.envs.arm import ARM, ASIDE, RAISED, READY, UPWARDS, ArmKinematics
from simtrack.envs.grasps import suction_spot
from simtrack.geometry.transforms import apply, inverse, yaw_of
from simtrack.objects import ObjectModel
from simtrack.objects.tiago import TORSO
from simtrack.simulation.suction import SuctionCup

if TYPE_CHECKING:
    from simtrack.simulation.simulation import Simulation

Motion: TypeAlias = Iterator[None]
"""One item for each control step."""

HOVER = 0.05
"""Metres above a place from which the cup comes down to it."""
DOWN = 0.008
"""Metres that it comes down at a time."""
DEEPER = 0.015
"""Metres below the believed surface at which it gives up."""
CARRY = 0.11
"""Metres that an object is lifted, or as far as the arm can."""
RELEASE = 0.006
"""Metres above its place at which an object is let go."""
ARRIVED = 2e-3
"""Radians between servo targets and setpoints: there."""
PATIENCE = 60
"""Control steps that a joint may take to its target."""


@dataclass(frozen=True, slots=True)
class Held:
    """What the robot believes to hold."""

    class_name: str
    """Name of its model."""
    T_map_object: Float64
    """(4, 4), where it was believed to be when it was grasped."""
    cup: Float64
    """(3,), the cup's rim at that moment, map frame."""
    yaw: float
    """Heading of the cup's y axis at that moment, map frame, radians."""
    T_cup_object: Float64
    """(4, 4), as it was believed at that moment."""


class Manipulator:
    """Arm and cup of a simulated robot; does one macro at a time, a control step at a time."""

    def __init__(self, simulation: "Simulation") -> None:
        """Take hold of the robot; raises InvalidValueError if it has no suction cup."""
        self._simulation = simulation
        self.cup = SuctionCup(simulation)
        self.arm = ArmKinematics(simulation.robot)
        self.T_map_base = np.eye(4)
        """(4, 4), where the base is believed to be now."""
        self.reset()

    def reset(self) -> None:
        """The world begins anew, with the arm tucked."""
        self.cup.reset()
        self.outcome = Outcome.IDLE
        """Of the macro that runs or ran last."""
        self.held: Held | None = None
        self.drive: float = 0.0
        """m/s at which the macro that runs wants the base to go."""
        self._tucked = True
        self._motion: Motion = iter(())

    @property
    def busy(self) -> bool:
        """Whether a macro runs."""
        return self.outcome is Outcome.BUSY

    def grasp(self, T_map_object: Float64, model: ObjectModel, T_map_base: Float64) -> None:
        """Begin to grasp an object from above where it is believed to be.

        Args:
            T_map_object: (4, 4), believed.
            model: of the object, as the robot knows it.
            T_map_base: (4, 4), believed.
        """
        self.begin(self._grasp(T_map_object, model, T_map_base))

    def place(
        self, position: Float64, T_map_base: Float64, turns: Sequence[float] = (), clearance: float = 0.03
    ) -> None:
        """Begin to put down what is held.

        Args:
            position: (3,), where the origin of the object shall be, map frame, metres.
            T_map_base: (4, 4), believed.
            turns: by how much the object may be turned about the vertical, radians; as it comes if none is given.
            clearance: least height above its place from which it comes down, metres: over the rim of a box, say.
        """
        self.begin(self._place(np.asarray(position, dtype=float), T_map_base, turns or (None,), clearance))

    def refuse(self, outcome: Outcome) -> None:
        """Do not even begin, for this reason."""
        self._motion, self.outcome = iter(()), outcome

    def begin(self, motion: Motion) -> None:
        """Begin any motion: it sets the outcome when it ends."""
        self._motion, self.outcome = motion, Outcome.BUSY

    def step(self, T_map_base: Float64 | None = None) -> None:
        """Go on with the macro, if one runs: once before each control step; `T_map_base` (4, 4) is believed."""
        self.drive = 0.0
        if T_map_base is not None:
            self.T_map_base = T_map_base
        if self.busy:
            next(self._motion, None)

    # -------------------------------------------------------------------------------------------------------- motions

    def _grasp(self, T_map_object: Float64, model: ObjectModel, T_map_base: Float64) -> Motion:
        spot = suction_spot(model, T_map_object)
        if spot is None:
            self.outcome = Outcome.NO_SPOT
            return
        target = apply(inverse(T_map_base), spot[None])[0]
        above = self._solve(target + (0.0, 0.0, HOVER))
        if above is None or self._solve(target, above) is None:
            self.outcome = Outcome.OUT_OF_REACH
            return
        yield from self.unfold()
        yield from self._approach(above)
        touched = False
        for depth in np.arange(HOVER - DOWN, -DEEPER, -DOWN):
            lower = self._solve(target + (0.0, 0.0, float(depth)), self.joints())
            if lower is None:
                break
            yield from self.go(lower)
            if touched := self.cup.close() is not None:
                break
        if touched:
            T_base_cup = self.arm.cup(self.joints() | {TORSO: self.torso()})
            cup = apply(T_map_base, T_base_cup[:3, 3][None])[0]
            heading = yaw_of(T_map_base) + float(np.arctan2(T_base_cup[1, 1], T_base_cup[0, 1]))
            T_cup_object = inverse(T_map_base @ T_base_cup) @ T_map_object
            self.held = Held(model.name, T_map_object.copy(), cup, heading, T_cup_object)
        yield from self._lift(target)
        yield from self._raise()
        self.outcome = Outcome.DONE if touched else Outcome.MISSED

    def _place(self, position: Float64, T_map_base: Float64, turns: Sequence[float | None], clearance: float) -> Motion:
        if self.held is None:
            self.outcome = Outcome.EMPTY
            return
        best: tuple[float, dict[str, float], dict[str, float]] | None = None
        for turn in turns:
            target, heading = self._cup_for(self.held, position, T_map_base, turn)
            height, above = self._highest(target, heading)
            down = None if above is None else self._solve(target, above, heading)
            if above is not None and down is not None and height >= max(clearance, best[0] if best else 0.0):
                best = height, above, down
        if best is None:
            self.outcome = Outcome.OUT_OF_REACH
            return
        height, above, down = best
        yield from self._approach(above)
        for share in np.linspace(0.0, 1.0, int(np.ceil(height / DOWN)) + 1)[1:]:
            yield from self.go({name: above[name] + share * (down[name] - above[name]) for name in ARM})
        yield from self.wait(2)
        self.cup.open()
        self.held = None
        yield from self.wait(2)
        yield from self.go(above)
        yield from self._raise()
        self.outcome = Outcome.DONE

    def _cup_for(
        self, held: Held, position: Float64, T_map_base: Float64, turn: float | None
    ) -> tuple[Float64, float | None]:
        """Where in the base frame the cup has to be, and its heading, for the object to be at a place and so turned."""
        c, s = np.cos(turn or 0.0), np.sin(turn or 0.0)
        lever = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ (held.cup - held.T_map_object[:3, 3])
        target = apply(inverse(T_map_base), (position + lever)[None])[0] + (0.0, 0.0, RELEASE)
        return target, None if turn is None else held.yaw + turn - yaw_of(T_map_base)

    def unfold(self) -> Motion:
        """From the tucked posture beside the robot to the one before its chest."""
        if self._tucked:
            yield from self.go(ASIDE)
            yield from self.go(RAISED)
            self._tucked = False

    def _approach(self, joints: Mapping[str, float]) -> Motion:
        """To joint angles with the cup over a place, and down to it at the end."""
        yield from self.go({name: RAISED[name] if name in UPWARDS else angle for name, angle in joints.items()})
        yield from self.go(joints)

    def _raise(self) -> Motion:
        """Up from where the arm is, and then before the chest: over whatever stands there."""
        yield from self.go({name: RAISED[name] for name in UPWARDS})
        yield from self.go(RAISED)

    def _lift(self, target: Float64) -> Motion:
        _, joints = self._highest(target, None)
        if joints is not None:
            yield from self.go(joints)

    def _highest(self, target: Float64, heading: float | None) -> tuple[float, dict[str, float] | None]:
        """How far above a place the cup can be held, up to `CARRY` metres, and the joint angles that do so."""
        for height in np.arange(CARRY, 0.015, -0.01).tolist():
            joints = self._solve(target + (0.0, 0.0, height), READY, heading)
            if joints is not None:
                return height, joints
        return 0.0, None

    def go(self, joints: Mapping[str, float]) -> Motion:
        """Until the servos' setpoints are at the targets, and one step for the arm to follow."""
        controller = self._simulation.world.controller
        controller.reach(joints)
        for _ in range(PATIENCE):
            yield
            now = controller.setpoints
            if max(abs(now[name] - joints[name]) for name in joints) < ARRIVED:
                break
        yield

    def wait(self, steps: int) -> Motion:
        """Hold still."""
        for _ in range(steps):
            yield

    def follow(self, joints: Mapping[str, float]) -> None:
        """New targets for the arm's servos, from now on."""
        self._simulation.world.controller.reach(joints)

    def joints(self) -> dict[str, float]:
        """Joint of the arm -> where its servo is asked to be, radians."""
        setpoints = self._simulation.world.controller.setpoints
        return {name: setpoints[name] for name in ARM}

    def torso(self) -> float:
        """Lift, metres."""
        return self._simulation.world.controller.setpoints[TORSO]

    def _solve(
        self, position: Float64, start: Mapping[str, float] = READY, heading: float | None = None
    ) -> dict[str, float] | None:
        return self.arm.solve(position, self.torso(), start, heading)
