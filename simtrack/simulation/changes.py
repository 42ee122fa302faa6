"""What somebody does to the world while the robot looks elsewhere: things are moved, taken away and brought."""

from dataclasses import dataclass

import numpy as np

from simtrack.contracts import NANOSECONDS, CameraIntrinsics, Float64
from simtrack.errors import FileFormatError, SimtrackError
from simtrack.geometry.transforms import apply, inverse
from simtrack.simulation.placement import draw_place, out_of_the_world, outline, place_area
from simtrack.simulation.randomness import stream
from simtrack.simulation.settling import put
from simtrack.simulation.world import SENSOR_BODIES, World, body_pose

MARGIN = 0.1
"""Metres from an object's bounding sphere to the view within which it counts as in view."""


@dataclass(frozen=True, slots=True)
class UnseenChange:
    """Something that has happened to an object."""

    stamp: int
    """Nanoseconds."""
    name: str
    T_before: Float64 | None
    """(4, 4) T_map_object; None if the object was away."""
    T_after: Float64 | None
    """(4, 4), before it settles; None if it was taken away."""


class ChangeDirector:
    """Carries out the changes of a scene, each at the first moment that suits; the same seed draws the same places."""

    def __init__(self, world: World, camera: CameraIntrinsics, seed: int) -> None:
        """`camera` decides what the robot sees.

        Raises:
            FileFormatError: a change names a support that does not exist.
        """
        self._world, self._camera = world, camera
        self._data = world.data
        self._open = []
        for k, change in enumerate(world.scene.changes):
            try:
                area = place_area(world.static, change.to)
            except SimtrackError as error:
                raise FileFormatError(world.scene.path, f"changes.{k}.to", str(error)) from error
            purpose = f"change {k}"
            due = float(stream(seed, purpose).uniform(*change.at))
            self._open.append((due, purpose, change, area))
        self._seed = seed
        self._away = {t.id for t in (*world.scene.objects, *world.scene.clutter) if t.place.away}
        self._numbers = {name: number for number, name in enumerate(world.objects)}
        self.done: list[UnseenChange] = []
        """What has happened so far."""

    @property
    def pending(self) -> int:
        """How many changes have not happened yet."""
        return len(self._open)

    def step(self, stamp: int) -> None:
        """Let happen what is due at a stamp (nanoseconds), and is not in view."""
        for entry in tuple(self._open):
            due, purpose, change, area = entry
            if stamp < due * NANOSECONDS or self._seen(change.object):
                continue
            model, rng = self._world.objects[change.object], stream(self._seed, purpose)
            if change.to.away:
                T_after = out_of_the_world(self._numbers[change.object])
            else:
                others = [outline(self._world.objects[n].extents, self._pose(n)) for n in self._others(change.object)]
                T_after = draw_place(change.to, area, model, others, rng)
                if T_after is None or self._in_view(T_after[:3, 3], model.diameter / 2):
                    continue
            before = None if change.object in self._away else self._pose(change.object)
            put(self._world, self._data, change.object, T_after, floating=change.to.away)
            (self._away.add if change.to.away else self._away.discard)(change.object)
            self._open.remove(entry)
            self.done.append(UnseenChange(stamp, change.object, before, None if change.to.away else T_after))

    def _others(self, name: str) -> list[str]:
        return [other for other in self._world.objects if other != name and other not in self._away]

    def _pose(self, name: str) -> Float64:
        return body_pose(self._data, self._world.bodies[name])

    def _seen(self, name: str) -> bool:
        """Whether an object may be in view, wherever it is."""
        return name not in self._away and self._in_view(self._pose(name)[:3, 3], self._world.objects[name].diameter / 2)

    def _in_view(self, centre: Float64, radius: float) -> bool:
        """Whether a ball reaches into the camera's pyramid of view, walls aside."""
        T_map_camera = body_pose(self._data, self._world.model.body(SENSOR_BODIES["camera"]).id)
        K = self._camera
        left, top = K.cx + 0.5, K.cy + 0.5
        right, bottom = K.width - left, K.height - top
        inward = np.array([[K.fx, 0, left], [-K.fx, 0, right], [0, K.fy, top], [0, -K.fy, bottom], [0, 0, 1.0]])
        inward /= np.linalg.norm(inward, axis=1, keepdims=True)
        x = apply(inverse(T_map_camera), centre[None])[0]
        return bool(np.all(inward @ x > -(radius + MARGIN)))
