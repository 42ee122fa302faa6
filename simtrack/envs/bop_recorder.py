"""Episodes as a data set in the format of the BOP benchmark: one scene an episode, labelled by the truth."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsFloat, cast

import gymnasium as gym

from simtrack.contracts import RgbdFrame
from simtrack.envs.wrappers import simtrack_env
from simtrack.errors import InvalidValueError

if TYPE_CHECKING:
    from simtrack.datasets.frame import DatasetInfo
    from simtrack.datasets.simulated import SimulationLabels
    from simtrack.datasets.writers.bop import BopSceneWriter, BopWriter


class BopRecorder(gym.Wrapper):
    """Writes what the robot's camera saw in each episode, with poses and masks of all objects, as a BOP data set.

    ``folder/bop/train_pbr/000000`` is the first episode. Agents see what they would see without it.
    """

    def __init__(self, env: gym.Env, folder: str | Path, every: int = 1) -> None:
        """Wrap an environment.

        Args:
            env: one that observes ``belief`` or ``rgbd``: else there are no images.
            folder: a new or empty one.
            every: write every so many-th image.

        Raises:
            InvalidValueError: there are no images, or the folder has something in it.
        """
        super().__init__(env)
        self._inner, self._folder, self._every = simtrack_env(env), Path(folder), every
        if "camera" not in self._inner.settings.sensors:
            raise InvalidValueError("observation", self._inner.settings.modes, "'belief' or 'rgbd' among the modes")
        if self._folder.exists() and (not self._folder.is_dir() or any(self._folder.iterdir())):
            raise InvalidValueError("folder", str(folder), "a new or empty folder")
        if every < 1:
            raise InvalidValueError("every", every, "1 or more")
        self._writer: BopWriter | None = None
        self._info: DatasetInfo | None = None
        self._labels: SimulationLabels | None = None
        self._scene: BopSceneWriter | None = None
        self._episodes, self._images, self._steps = 0, 0, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, and a scene."""
        from simtrack.datasets.frame import SceneInfo

        self._finish_scene()
        self._inner.briefing()  # the world is built
        loop = self._inner.loop
        assert loop is not None
        loop.colours = True
        observation, info = self.env.reset(seed=seed, options=options)
        if self._writer is None:
            self._begin()
        assert self._writer is not None and self._info is not None
        scene = SceneInfo(self._episodes, -(-(self._inner.steps + 1) // self._every))
        self._scene = self._writer.open_scene(self._folder, self._info, scene)
        self._images = self._steps = 0
        self._write()
        return observation, info

    def _begin(self) -> None:
        from simtrack.datasets.frame import DatasetInfo
        from simtrack.datasets.simulated import SimulationLabels, stuff_of, target_categories
        from simtrack.datasets.writers.bop import BopOptions, BopWriter

        loop = self._inner.loop
        assert loop is not None
        world, simulation = loop.simulation.world, loop.simulation
        models = {m.name: m for name, m in world.objects.items() if world.is_catalogue(name)}
        clutter = {m.semantic_class for name, m in world.objects.items() if not world.is_catalogue(name)}
        categories = target_categories(list(models.values()))
        stuff = stuff_of({part.semantic_class for part in world.static.parts}, clutter, len(categories))
        self._labels = SimulationLabels(simulation, categories, stuff)
        self._info = DatasetInfo(
            name=simulation.scene.name, description=f"episodes of {self._inner.task_name}", seed=0, recipe="",
            intrinsics=simulation.camera.intrinsics, categories=categories, stuff=tuple(stuff.values()),
        )  # fmt: skip
        self._writer = BopWriter(BopOptions())
        self._writer.begin(self._folder, self._info)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Act, and write what the camera saw."""
        outcome = self.env.step(action)
        self._steps += 1
        self._write()
        return cast("tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]", outcome)

    def _write(self) -> None:
        snapshot = self._inner.snapshot
        if snapshot is None or self._scene is None or self._labels is None or self._steps % self._every:
            return
        for frame in snapshot.feed:
            if isinstance(frame, RgbdFrame) and frame.rgb is not None:
                self._scene.write(self._labels.label(frame, self._episodes, self._images))
                self._images += 1

    def _finish_scene(self) -> None:
        if self._scene is not None:
            self._scene.close()
            self._scene = None
            self._episodes += 1

    def close(self) -> None:
        """Finish the data set and release the world."""
        self._finish_scene()
        if self._writer is not None and self._info is not None:
            self._writer.finish(self._folder, self._info, self._episodes)
            self._writer = None
        super().close()
