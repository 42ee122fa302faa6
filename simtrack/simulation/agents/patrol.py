"""An agent that goes its rounds: it looks at every surface again and again, known or not."""

from simtrack.contracts import NANOSECONDS, Belief
from simtrack.simulation.agents.explorer import ExplorerAgent, ExplorerConfig

ROUNDS = ExplorerConfig(memory=9.0, dwell=1.5)
"""Each surface is looked at again after 9 s, for 1.5 s."""


class PatrolAgent(ExplorerAgent):
    """Explores anew what it has not looked at for `memory` seconds; implements `simtrack.contracts.Agent`."""

    def _remember(self, belief: Belief, elapsed: float) -> None:
        super()._remember(belief, elapsed)
        for patch in self._patches:
            if belief.stamp - patch.last_seen > self.config.memory * NANOSECONDS:
                patch.seen_for = 0.0
