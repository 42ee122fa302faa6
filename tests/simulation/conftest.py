import copy
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from simtrack.simulation.scene_file import SceneFile, parse_scene
from simtrack.simulation.simulation import Simulation

SMALL: dict[str, Any] = {
    "name": "small",
    "static": {"builder": "lab_room"},
    "objects": [
        {"model": "materialbox", "place": {"on": "workbench", "x": [-0.1, 0.1], "y": [-0.3, -0.05]}},
        {"model": "relay", "place": {"on": "workbench", "x": [0.0, 0.25], "y": [0.1, 0.35], "separation": 0.08}},
    ],
    "clutter": [{"model": "mug", "place": {"on": "workbench", "x": [-0.25, -0.1], "y": [0.4, 0.6]}}],
    "robot": {"start": {"facing": "workbench", "distance": [1.1, 1.2]}, "torso": 0.3, "head_tilt": -0.3},
}


@pytest.fixture
def document() -> dict[str, Any]:
    """A scene as plain data, to be changed by the test."""
    return copy.deepcopy(SMALL)


@pytest.fixture(scope="session")
def small_scene() -> Callable[..., SceneFile]:
    """Makes the small scene; keyword arguments replace fields, `folder` says where it lies."""

    def make(folder: Path = Path("small"), **changes: Any) -> SceneFile:
        return parse_scene(copy.deepcopy(SMALL) | changes, folder / "scene.yaml")

    return make


@pytest.fixture(scope="session")
def resting(small_scene: Callable[..., SceneFile]) -> Iterator[Simulation]:
    """A small scene without a hand, rendered with rays, after a few frames."""
    from simtrack.contracts import Command

    with Simulation(small_scene(), seed=3, renderer="embree") as simulation:
        for _ in range(4):
            simulation.advance(Command(torso=0.3, head_tilt=-0.3))
        yield simulation
