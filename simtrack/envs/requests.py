"""What an agent asks the arm for, made into macros by what the robot believes at that moment."""

from collections.abc import Callable, Mapping

import numpy as np

from simtrack.contracts import Belief, Float64
from simtrack.envs.actions import Outcome, Request
from simtrack.envs.macros import Manipulator
from simtrack.geometry.transforms import apply, inverse, yaw_of
from simtrack.objects import ObjectModel

MEANT = 0.1
"""Metres: what is believed to be nearest to the place that is named, within this, is grasped."""
CLEARANCE, SPARE = 0.03, 0.01
"""Metres from which something is put down at least, and above the rim of what it is put into."""


def begin(manipulator: Manipulator, request: Request, belief: Belief, models: Mapping[str, ObjectModel]) -> None:
    """Let an arm that is not at work begin what it is asked for.

    Args:
        manipulator: tells afterwards how it fared.
        request: places are those of the base where it believes to be.
        belief: of now.
        models: class name -> model, as the robot knows it.
    """
    _BEGIN[request.macro](manipulator, request, belief, models)


def _grasp(manipulator: Manipulator, request: Request, belief: Belief, models: Mapping[str, ObjectModel]) -> None:
    if manipulator.held is not None:
        return manipulator.refuse(Outcome.FULL)
    T_map_base = belief.localization.T_map_base
    place = apply(T_map_base, request.position[None])[0]
    gaps = [(float(np.linalg.norm(t.T_map_object[:3, 3] - place)), t.id, t) for t in belief.tracks if t.believed]
    gap, _, track = min(gaps, default=(np.inf, 0, None))
    if track is None or gap > MEANT:
        return manipulator.refuse(Outcome.UNKNOWN)
    return manipulator.grasp(track.T_map_object, models[track.class_name], T_map_base)


def _place(manipulator: Manipulator, request: Request, belief: Belief, models: Mapping[str, ObjectModel]) -> None:
    if manipulator.held is None:
        return manipulator.refuse(Outcome.EMPTY)
    T_map_base = belief.localization.T_map_base
    place = apply(T_map_base, request.position[None])[0]
    turn = request.heading + yaw_of(T_map_base) - yaw_of(manipulator.held.T_map_object)
    clearance = _clearance(place, models[manipulator.held.class_name], belief, models)
    return manipulator.place(place, T_map_base, (turn,), clearance)


def _clearance(place: Float64, model: ObjectModel, belief: Belief, models: Mapping[str, ObjectModel]) -> float:
    """Metres above its place from which something comes down without touching what it is put into."""
    bottom, clearance = place[2] - model.extents[2] / 2, CLEARANCE
    for track in belief.tracks:
        offset = apply(inverse(track.T_map_object), place[None])[0]
        half = models[track.class_name].extents / 2
        if track.believed and track.class_name != model.name and (np.abs(offset[:2]) < half[:2]).all():
            top = track.T_map_object[2, 3] + np.abs(track.T_map_object[2, :3]) @ half
            clearance = max(clearance, float(top - bottom) + SPARE)
    return clearance


_BEGIN: Mapping[str, Callable[[Manipulator, Request, Belief, Mapping[str, ObjectModel]], None]] = {
    "grasp": _grasp, "place": _place,
}  # fmt: skip
