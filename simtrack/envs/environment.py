"""The environment: Gymnasium's interface to a task, a world and what a perception stack makes of it."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np

from simtrack.contracts import Command, Float32, Relation, Uint8
from simtrack.envs.actions import Steering, axes, request_of
from simtrack.envs.observations import Arrays, Encoder, Layout, encode_image, encode_robot
from simtrack.envs.policies import Briefing
from simtrack.envs.settings import (
    CONTROL_HZ,
    Settings,
    articulations_of,
    classes_of,
    fixed_building,
    furniture_of,
    with_objects,
)
from simtrack.envs.task import Moment, Score, Task
from simtrack.envs.tasks import make_task
from simtrack.envs.window import check_display, has_display
from simtrack.errors import FileFormatError, InvalidValueError
from simtrack.objects import load_object
from simtrack.simulation.scene_file import load_scene

if TYPE_CHECKING:
    from simtrack.envs.loop import Loop, Snapshot
    from simtrack.envs.view import View
    from simtrack.envs.window import Window

Observation = Arrays | dict[str, Arrays]
TRIES = 20
"""Draws of a placement before an episode counts as impossible."""


class SimtrackEnv(gym.Env[Observation, Float32]):
    """A task in a simulated world, seen through a perception stack, through a camera, or as it is.

    ::

        env = gymnasium.make("simtrack/ActivePerception-v0", observation="belief")
        observation, info = env.reset(seed=1)

    The world is built at the first `reset`, so that making an environment touches neither OpenGL nor threads.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array"], "render_fps": CONTROL_HZ}

    def __init__(
        self,
        task: str | Task = "active-perception",
        observation: str | Sequence[str] = "belief",
        *,
        scene: str | None = None,
        render_mode: str | None = None,
        **arguments: Any,
    ) -> None:
        """Check the arguments.

        Args:
            task: name of a task, ``"module:Class"``, or a `Task`.
            observation: one of ``state``, ``belief`` and ``rgbd``, or several: then observations are a mapping by mode.
            scene: name or path of a scene; the task's own if None.
            render_mode: ``rgb_array``, ``human`` (needs a display) or None.
            arguments: further fields of `simtrack.envs.settings.Settings`.

        Raises:
            SimtrackError: an argument that is not valid; names those that are.
        """
        if unknown := sorted(set(arguments) - set(Settings.__dataclass_fields__)):
            known = ["task", "scene", "render_mode", *Settings.__dataclass_fields__]
            raise InvalidValueError("argument", unknown[0], ", ".join(known))
        self.settings = Settings(observation, **arguments)
        self.task = make_task(task)
        self.task_name = self.task.script or type(self.task).__name__
        chosen = with_objects(load_scene(scene or self.task.scene), self.settings.objects)
        self.scene = self.task.adapt(fixed_building(chosen))
        self.task.check(self.scene)
        self.render_mode = self._checked(render_mode)
        if not has_display():
            self.metadata = {**self.metadata, "render_modes": ["rgb_array"]}  # type: ignore[misc]
        camera = self.settings.camera
        seconds = self.settings.seconds or self.task.seconds
        self.layout = Layout(
            classes_of(self.scene), self.settings.slots, furniture_of(self.scene), seconds, camera.intrinsics,
            camera.max_range, self.task.macros, articulations_of(self.scene),
        )  # fmt: skip
        spaces = {mode: self.layout.space(mode) for mode in self.settings.modes}
        self.observation_space = (
            spaces[self.settings.modes[0]] if self._single else gym.spaces.Dict(spaces)  # type: ignore[assignment]
        )
        self.action_space = gym.spaces.Box(-1.0, 1.0, (len(axes(self.task.macros)),), np.float32)
        robot = self.scene.robot
        posture = Command(head_pan=robot.head_pan, head_tilt=robot.head_tilt, torso=robot.torso)
        self.steering = Steering(posture, 1.0 / CONTROL_HZ)
        self._encoders = {mode: Encoder(self.layout) for mode in ("state", "belief")}
        self._loop: Loop | None = None
        self._view: View | None = None
        self._window: Window | None = None
        self._snapshot: Snapshot | None = None
        self._steps = 0
        self._closed = False

    def _checked(self, render_mode: str | None) -> str | None:
        """The render mode; raises InvalidValueError, and RenderingError for ``human`` without a display."""
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InvalidValueError("render_mode", render_mode, f"None, {', '.join(self.metadata['render_modes'])}")
        if render_mode == "human":
            check_display()
        return render_mode

    @property
    def _single(self) -> bool:
        return isinstance(self.settings.observation, str)

    @property
    def steps(self) -> int:
        """Control steps in an episode."""
        return round(self.layout.seconds * CONTROL_HZ)

    # ------------------------------------------------------------------------------------------------------ the episode

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; `options` are not used.

        Raises:
            FileFormatError: the scene cannot be built, or leaves no room for its objects.
        """
        super().reset(seed=seed)
        loop = self._built()
        self._restart(loop)
        self.task.begin(loop.simulation, self.np_random)
        self.steering.reset()
        for encoder in self._encoders.values():
            encoder.reset()
        self._steps = 0
        self._snapshot = loop.step(self.steering.command)  # the sensors' first look
        return self._shown(self._snapshot, self._judge(self._snapshot))

    def _judge(self, snapshot: "Snapshot") -> Score:
        seconds = self._steps / CONTROL_HZ
        return self.task.score(Moment(seconds, snapshot.truth, snapshot.belief, snapshot.holding))

    def _built(self) -> "Loop":
        """The world, built on first need."""
        if self._closed:
            raise InvalidValueError("environment", "closed", "an environment that has not been closed")
        if self._loop is None:
            from simtrack.envs.loop import Loop

            self._loop = Loop(self.scene, self.settings)
            self.task.prepare(self._loop.simulation)
        return self._loop

    def _restart(self, loop: "Loop") -> None:
        """Draw a placement; one that does not come to rest where it should, or cannot be played, is drawn again."""
        for last in [False] * (TRIES - 1) + [True]:
            try:
                loop.restart(int(self.np_random.integers(2**31)))
            except FileFormatError:
                if last:
                    raise
                continue
            if self.task.playable(loop.simulation):
                return
        raise FileFormatError(self.scene.path, "robot.start", f"none of {TRIES} draws can be played; use another scene")

    def step(self, action: Float32) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Act for a tenth of a second.

        Raises:
            InvalidValueError: the environment was not reset, or the action is not an array (A,) of finite numbers.
        """
        if self._loop is None or self._snapshot is None:
            raise InvalidValueError("step", "an environment that was not reset", "step after reset")
        if np.shape(action) != self.action_space.shape or not np.isfinite(action).all():
            raise InvalidValueError("action", action, f"an array {self.action_space.shape} of finite numbers")
        self.task.act(self._loop.simulation, self._steps / CONTROL_HZ)
        request = request_of(action, self.task.macros) if self.task.macros else None
        self._snapshot = self._loop.step(self.steering.apply(action, self._loop.busy or request is not None), request)
        self._steps += 1
        score = self._judge(self._snapshot)
        observation, info = self._shown(self._snapshot, score)
        truncated = self._steps >= self.steps and not score.terminated
        if self.render_mode == "human":
            self.render()
        return observation, float(score.reward), bool(score.terminated), truncated, info

    def _shown(self, snapshot: "Snapshot", score: Score) -> tuple[Observation, dict[str, Any]]:
        modes = {mode: self._arrays(mode, snapshot) for mode in self.settings.modes}
        truth = snapshot.truth
        objects = [thing for thing in truth.objects.values() if thing.kind == "catalogue"]
        info = {
            "success": bool(score.success),
            "metrics": {name: float(value) for name, value in score.metrics.items()},
            "truth": {
                "names": tuple(thing.name for thing in objects),
                "poses": np.array([thing.T_map_object for thing in objects]).reshape(-1, 4, 4),
                "base": truth.T_map_base.copy(),
                "supports": tuple(sorted(truth.contacts)),
            },
        }
        return (modes[self.settings.modes[0]] if self._single else modes), info

    def _arrays(self, mode: str, snapshot: "Snapshot") -> Arrays:
        if mode == "rgbd":
            assert snapshot.image is not None
            return {
                **encode_image(snapshot.image, self.layout),
                **encode_robot(snapshot.felt, snapshot.truth.stamp, self.layout),
            }
        belief = snapshot.belief if mode == "belief" else snapshot.state
        assert belief is not None
        return self._encoders[mode].encode(belief, snapshot.felt)

    # -------------------------------------------------------------------------------------------------------- the rest

    def briefing(self) -> Briefing:
        """What an agent may know before it starts: survey, robot, posture, layout; never the truth."""
        loop = self._built()
        simulation = loop.simulation
        classes = {thing.id: load_object(thing.model).name for thing in self.scene.objects}
        goals = (Relation(*(classes.get(n, n) for n in (g.subject, g.name, g.reference))) for g in self.task.goals)
        return Briefing(
            simulation.static_map, simulation.robot, self.steering.start, self.layout, self.settings.modes,
            simulation.models, tuple(goals),
        )  # fmt: skip

    @property
    def snapshot(self) -> "Snapshot | None":
        """What there is to know after the last step: for pictures and recordings, never for agents."""
        return self._snapshot

    @property
    def loop(self) -> "Loop | None":
        """World and perception, once they are built: for pictures and recordings, never for agents."""
        return self._loop

    def render(self) -> Uint8 | None:  # type: ignore[override]
        """(480, 640, 3) picture of the robot at work, or None after showing it in a window."""
        if self.render_mode is None or self._loop is None or self._snapshot is None:
            return None
        if self._view is None:
            from simtrack.envs.view import View

            self._view = View(self._loop.simulation, self.task.eye, self.task.focus)
        picture = self._view.picture(self._snapshot.truth)
        if self.render_mode == "rgb_array":
            return picture
        if self._window is None:
            from simtrack.envs.window import Window

            self._window = Window("simtrack")
        self._window.show(picture)
        return None

    def close(self) -> None:
        """Release the world; may be called twice."""
        self._closed = True
        if self._window is not None:
            self._window.close()
            self._window = None
        if self._loop is not None:
            self._loop.close()
            self._loop = None
        self._view = self._snapshot = None
