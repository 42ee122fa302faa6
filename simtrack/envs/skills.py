"""Macros by name, for agents that choose from a list: ``grasp relay``, ``put in materialbox``."""

from typing import TYPE_CHECKING

from simtrack.contracts import Belief, Relation
from simtrack.envs.actions import Request
from simtrack.envs.planning import Places, believed
from simtrack.envs.policies import Briefing
from simtrack.geometry.transforms import apply, inverse, yaw_of

if TYPE_CHECKING:
    from simtrack.envs.macros import Held

WAYS = ("in", "left-of", "right-of", "in-front-of", "behind")
"""Relations to another thing in which something can be put down."""


def skill_names(classes: tuple[str, ...], macros: tuple[str, ...]) -> tuple[str, ...]:
    """What can be asked for, given the classes of the scene's objects and the task's macros."""
    names = [f"grasp {name}" for name in classes] if "grasp" in macros else []
    names += [f"put {way} {name}" for way in WAYS for name in classes] if "place" in macros else []
    return tuple(names)


class Skills:
    """Turns names into requests by what is believed."""

    def __init__(self, briefing: Briefing) -> None:
        """Look at map and models."""
        classes = briefing.layout.classes
        goals = [Relation(a, way, b) for way in WAYS for a in classes for b in classes if a != b]
        self._places = Places(briefing.static_map, briefing.models, goals)

    def request(self, skill: str, belief: Belief, held: "Held | None") -> Request | None:
        """What the arm is asked for; None where the skill cannot even be tried.

        Args:
            skill: one of `skill_names`.
            belief: of now.
            held: what the robot believes to hold.
        """
        T_base_map = inverse(belief.localization.T_map_base)
        verb, *way, name = skill.split()
        if verb == "grasp":
            track = believed(belief, name)
            return None if track is None else Request("grasp", apply(T_base_map, track.T_map_object[None, :3, 3])[0])
        if held is None or held.class_name == name:
            return None
        spots = self._places.spots(Relation(held.class_name, way[0], name), belief, held.T_map_object)
        if not spots:
            return None
        heading = spots[0].heading - yaw_of(belief.localization.T_map_base)
        return Request("place", apply(T_base_map, spots[0].position[None])[0], heading)
