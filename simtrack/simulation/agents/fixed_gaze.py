"""An agent that never moves: the yardstick for what looking around is worth."""

from simtrack.contracts import Belief, Command, JointState


class FixedGazeAgent:
    """Stands still and keeps looking where the robot looked at the start; implements `simtrack.contracts.Agent`."""

    def __init__(self, start: Command) -> None:
        self._posture = Command(0.0, 0.0, start.head_pan, start.head_tilt, start.torso)

    def act(self, belief: Belief, joints: JointState) -> Command:
        """The same posture, whatever is believed."""
        return self._posture
