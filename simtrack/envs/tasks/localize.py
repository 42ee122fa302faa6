"""Drive about an office floor and know where you are, although the wheels slip and somebody carries the robot off."""

from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Status
from simtrack.envs.task import Moment, Score, Task
from simtrack.geometry.transforms import difference
from simtrack.simulation.placement import start_pose
from simtrack.simulation.randomness import stream
from simtrack.simulation.scene_file import SceneFile, StartRoom

if TYPE_CHECKING:
    from simtrack.simulation.simulation import Simulation

SLIP_RATE = 0.3
"""Slips a metre, on average; each is of some centimetres and degrees (see `OdometryNoiseConfig`)."""
GRACE = 1.0
"""Seconds after the robot was carried off in which nobody can have noticed: they do not count."""
RIGHT_TRANSLATION, RIGHT_ROTATION = 0.1, np.radians(5.0)
"""Metres and radians within which the robot counts as localized."""
ATE_ASKED = 0.05
"""Metres: largest root mean square error of the poses that were claimed, for a success."""
SHARE_ASKED = 0.8
"""Least share of the episode that the robot is localized, for a success."""
WAY_ASKED = 10.0
"""Metres that have to be driven, for a success."""


class Localize(Task):
    """Stay localized on the lab floor.

    The wheels slip, and once, in the second quarter of the episode, the robot is carried to another room. A step in
    which the robot is localized (10 cm, 5 degrees) gives 0.02 and 0.2 a metre that it has driven; a step in which it
    claims a pose (status OK) that is wrong by more than that costs 0.1.
    """

    scene = "lab_floor"
    script = "localize"
    seconds = 40.0

    def adapt(self, scene: SceneFile) -> SceneFile:
        """Let the wheels slip, unless the scene says how they do."""
        odometry = {"slip_rate": SLIP_RATE, **scene.sensors.odometry}
        return scene.model_copy(update={"sensors": scene.sensors.model_copy(update={"odometry": odometry})})

    def begin(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Draw when and where to the robot is carried."""
        self._when = float(rng.uniform(0.25, 0.5)) * self.seconds
        rooms = sorted(room.name for room in simulation.world.static.rooms)
        room = rooms[int(rng.integers(len(rooms)))]
        elsewhere = simulation.scene.robot.model_copy(update={"start": StartRoom(room=room)})
        scene = simulation.scene.model_copy(update={"robot": elsewhere})
        self._where = start_pose(scene, simulation.world.static, stream(int(rng.integers(2**31)), "kidnapping"))
        self._carried: float | None = None
        self._last = np.zeros(2)
        self._way, self._squares, self._claims, self._right, self._steps = 0.0, 0.0, 0, 0, 0

    def act(self, simulation: "Simulation", seconds: float) -> None:
        """Carry the robot off when the time has come."""
        if self._carried is None and seconds >= self._when:
            simulation.carry_robot(*self._where)
            self._carried, self._last = seconds, np.array(self._where[:2])

    def score(self, moment: Moment) -> Score:
        """See the class."""
        here, claimed = moment.truth.T_map_base[:2, 3], moment.belief.localization
        gap = difference(moment.truth.T_map_base, claimed.T_map_base)
        translation, rotation = float(np.linalg.norm(gap[:3])), float(np.linalg.norm(gap[3:]))
        step = float(np.linalg.norm(here - self._last)) if self._steps else 0.0
        self._last = here.copy()
        self._steps += 1
        right = translation <= RIGHT_TRANSLATION and rotation <= RIGHT_ROTATION
        sure = claimed.status not in (Status.LOST, Status.AMBIGUOUS)
        excused = self._carried is not None and moment.seconds - self._carried < GRACE
        self._way, self._right = self._way + step, self._right + right
        if sure and not excused:
            self._squares, self._claims = self._squares + translation**2, self._claims + 1
        reward = 0.02 + 0.2 * step if right else -0.1 if sure and not excused else 0.0
        ate = float(np.sqrt(self._squares / self._claims)) if self._claims else 0.0
        share = self._right / self._steps
        success = ate <= ATE_ASKED and share >= SHARE_ASKED and self._way >= WAY_ASKED
        metrics = {
            "translation_error": translation,
            "rotation_error": rotation,
            "ate": ate,
            "localized_share": share,
            "way": self._way,
        }
        return Score(reward, success, metrics=metrics)
