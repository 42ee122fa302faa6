"""What an agent asks the arm for, made into macros by what the robot believes at that moment."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from simtrack.contracts import Articulation, Belief, Float64, StaticMap, Track
from simtrack.envs.actions import Outcome, Request
from simtrack.envs.front_macros import articulate, insert, take
from simtrack.envs.macros import Manipulator
from simtrack.geometry.transforms import apply, inverse, yaw_of
from simtrack.objects import ObjectModel
from simtrack.perception.tracking.articulation import motion

MEANT = 0.1
"""Metres: what is believed to be nearest to the place that is named, within this, is grasped."""
CLEARANCE, SPARE = 0.03, 0.01
"""Metres from which something is put down at least, and above the rim of what it is put into."""


def begin(
    manipulator: Manipulator,
    request: Request,
    belief: Belief,
    models: Mapping[str, ObjectModel],
    static_map: StaticMap | None = None,
) -> None:
    """Let an arm that is not at work begin what it is asked for.

    Args:
        manipulator: tells afterwards how it fared.
        request: places are those of the base where it believes to be.
        belief: of now.
        models: class name -> model, as the robot knows it.
        static_map: with the doors and drawers that can be articulated.
    """
    if request.macro == "articulate":
        return _articulate(manipulator, request, belief, () if static_map is None else static_map.articulations)
    return _BEGIN[request.macro](manipulator, request, belief, models)


def _articulate(
    manipulator: Manipulator, request: Request, belief: Belief, articulations: Sequence[Articulation]
) -> None:
    """Move the door or drawer of which some point is believed to be nearest to the place."""
    if manipulator.held is not None:
        return manipulator.refuse(Outcome.FULL)
    place = apply(belief.localization.T_map_base, request.position[None])[0]
    positions = {joint.name: joint.position for joint in belief.joints}
    best: tuple[float, Articulation] | None = None
    for articulation in articulations:
        near = apply(inverse(motion(articulation, positions[articulation.name])), place[None])[0]
        gap = float(np.linalg.norm(articulation.vertices - near, axis=1).min())
        low, high = articulation.vertices.min(axis=0), articulation.vertices.max(axis=0)
        gap = min(gap, float(np.linalg.norm(near - np.clip(near, low, high))))
        if best is None or gap < best[0]:
            best = gap, articulation
    if best is None or best[0] > MEANT:
        return manipulator.refuse(Outcome.UNKNOWN)
    chosen = best[1]
    goal = float(np.clip(request.heading, chosen.lower, chosen.upper))
    return manipulator.begin(articulate(manipulator, chosen, positions[chosen.name], goal))


def _take(manipulator: Manipulator, request: Request, belief: Belief, models: Mapping[str, ObjectModel]) -> None:
    track = _meant(manipulator, request, belief)
    if track is not None:
        manipulator.begin(take(manipulator, models[track.class_name], track.T_map_object))


def _insert(manipulator: Manipulator, request: Request, belief: Belief, models: Mapping[str, ObjectModel]) -> None:
    if manipulator.held is None:
        return manipulator.refuse(Outcome.EMPTY)
    place = apply(belief.localization.T_map_base, request.position[None])[0]
    return manipulator.begin(insert(manipulator, place))


def _grasp(manipulator: Manipulator, request: Request, belief: Belief, models: Mapping[str, ObjectModel]) -> None:
    track = _meant(manipulator, request, belief)
    if track is not None:
        manipulator.grasp(track.T_map_object, models[track.class_name], belief.localization.T_map_base)


def _meant(manipulator: Manipulator, request: Request, belief: Belief) -> Track | None:
    """What is believed to be nearest to the place; None, and the macro is refused, if the cup is not free for it."""
    if manipulator.held is not None:
        manipulator.refuse(Outcome.FULL)
        return None
    place = apply(belief.localization.T_map_base, request.position[None])[0]
    gaps = [(float(np.linalg.norm(t.T_map_object[:3, 3] - place)), t.id, t) for t in belief.tracks if t.believed]
    gap, _, track = min(gaps, default=(np.inf, 0, None))
    if track is None or gap > MEANT:
        manipulator.refuse(Outcome.UNKNOWN)
        return None
    return track


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
    "grasp": _grasp, "place": _place, "take": _take, "insert": _insert,
}  # fmt: skip
