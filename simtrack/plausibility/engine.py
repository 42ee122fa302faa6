"""What a check asks of a physics engine; the procedure knows no more of it."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from simtrack.contracts import Float64
from simtrack.perception.reconstruction.body_tree import BodyTree


@dataclass(frozen=True, slots=True)
class Proximity:
    """Two bodies that are near each other."""

    body_a: str
    body_b: str
    distance: float
    """Metres between the shapes without the engine's margins; negative where they overlap."""
    up: float
    """z of the unit normal from b to a, -1 to 1: 1 where a stands on b."""


class Engine(Protocol):
    """A loaded scene."""

    name: str
    version: str
    margin: float
    """Metres that meshes are thicker than drawn, a side. `proximities` subtracts it."""
    tree: BodyTree

    def reset(self) -> None:
        """Put everything where the description has it, at rest."""
        ...

    def step(self, duration: float) -> None:
        """Simulate for so many seconds."""
        ...

    def place(self, positions: Mapping[str, float]) -> None:
        """Reset, then move joints (rad or m) and all that hangs on them, also freely, without simulating."""
        ...

    def poses(self) -> dict[str, Float64]:
        """Body name -> (4, 4) T_scene_body."""
        ...

    def proximities(self, limit: float, bodies: Collection[str] | None = None) -> list[Proximity]:
        """Pairs of bodies nearer than `limit` metres, one of them in `bodies` (all if None), nearest point each."""
        ...

    def picture(self, path: Path) -> bool:
        """Write an image of the scene as it is; False if the engine has no renderer without a screen."""
        ...

    def close(self) -> None:
        """Give everything back."""
        ...
