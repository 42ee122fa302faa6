"""An agent that goes its rounds: it looks at every surface again and again, known or not."""

from dataclasses import replace

from simtrack.contracts import NANOSECONDS, Belief, CameraIntrinsics, Command, StaticMap
from simtrack.simulation.agents.explorer import ExplorerAgent, ExplorerConfig


class PatrolAgent(ExplorerAgent):
    """Explores anew what it has not looked at for a while; implements `simtrack.contracts.Agent`."""

    def __init__(
        self,
        static_map: StaticMap,
        intrinsics: CameraIntrinsics,
        start: Command,
        config: ExplorerConfig | None = None,
    ) -> None:
        """`config.memory` says after how many seconds a surface has to be looked at again, for `dwell` seconds."""
        super().__init__(static_map, intrinsics, start, config or replace(ExplorerConfig(), memory=9.0, dwell=1.5))

    def _remember(self, belief: Belief, elapsed: float) -> None:
        super()._remember(belief, elapsed)
        for patch in self._patches:
            if belief.stamp - patch.last_seen > self.config.memory * NANOSECONDS:
                patch.seen_for = 0.0
