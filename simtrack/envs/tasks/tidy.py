"""Tidy a table: things belong into a box, or beside one another."""

from simtrack.envs.goal_task import GoalTask
from simtrack.envs.goals import parse_goal


class Tidy(GoalTask):
    """Put the relay into its box and the multimeter to the left of the screwdriver; see `GoalTask` for the reward."""

    scene = "tidy"
    seconds = 90.0
    goals = tuple(parse_goal(text) for text in ("relay in materialbox", "multimeter left-of screwdriver"))
