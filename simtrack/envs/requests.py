"""What an agent asks the arm for, made into macros by what the robot believes at that moment."""

from collections.abc import Callable, Mapping

import numpy as np

from simtrack.contracts import Belief
from simtrack.envs.actions import Outcome, Request
from simtrack.envs.macros import Manipulator
from simtrack.geometry.transforms import apply, yaw_of
from simtrack.objects import ObjectModel

MEANT = 0.1
"""Metres: what is believed to be nearest to the place that is named, within this, is grasped."""


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
    turn = request.heading + yaw_of(T_map_base) - yaw_of(manipulator.held.T_map_object)
    return manipulator.place(apply(T_map_base, request.position[None])[0], T_map_base, (turn,))


_BEGIN: Mapping[str, Callable[[Manipulator, Request, Belief, Mapping[str, ObjectModel]], None]] = {
    "grasp": _grasp, "place": _place,
}  # fmt: skip
