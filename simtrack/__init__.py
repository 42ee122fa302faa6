"""simtrack: a closed-loop harness for object trackers and scene graphs of robots, with exact ground truth."""

__version__ = "0.1.0"

import gymnasium as _gymnasium

_ENVIRONMENTS = {
    "ActivePerception": "active-perception",
    "Localize": "localize",
    "Tidy": "tidy",
    "FetchMeal": "fetch-meal",
}
"""Name of an environment -> its task; the code is imported when one is made."""

for _name, _task in _ENVIRONMENTS.items():
    _gymnasium.register(
        id=f"simtrack/{_name}-v0", entry_point="simtrack.envs.environment:SimtrackEnv", kwargs={"task": _task}
    )
