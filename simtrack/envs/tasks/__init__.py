"""The tasks that come along, one a module."""

from collections.abc import Callable
from importlib import import_module
from typing import cast

from simtrack.envs.task import Task
from simtrack.errors import InvalidValueError, UnknownNameError

TASKS = {
    "active-perception": "simtrack.envs.tasks.active_perception:ActivePerception",
    "localize": "simtrack.envs.tasks.localize:Localize",
    "tidy": "simtrack.envs.tasks.tidy:Tidy",
    "fetch-meal": "simtrack.envs.tasks.fetch_meal:FetchMeal",
}
"""Name -> where its class is."""


def make_task(task: "str | Task") -> Task:
    """A task by name, by ``"module:Class"``, or as it is.

    Raises:
        UnknownNameError: there is no such task.
        InvalidValueError: what is named is no task.
    """
    if isinstance(task, Task):
        return task
    where = TASKS.get(task, task)
    if ":" not in where:
        raise UnknownNameError("task", task, TASKS)
    module, _, name = where.partition(":")
    try:
        made = cast("Callable[[], object]", getattr(import_module(module), name))()
    except (ImportError, AttributeError) as error:
        raise UnknownNameError("task", task, TASKS) from error
    if not isinstance(made, Task):
        raise InvalidValueError("task", task, "a subclass of simtrack.envs.task.Task")
    return made
