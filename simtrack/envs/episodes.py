"""Results of episodes in a file, so that a run that was stopped carries on."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from simtrack.envs.play import EpisodeResult
from simtrack.errors import FileFormatError


class EpisodeFile:
    """What was played with which arguments: a JSON object with ``arguments`` and ``episodes``."""

    def __init__(self, path: Path, arguments: Mapping[str, Any]) -> None:
        """Take up what the file holds already.

        Raises:
            FileFormatError: it is not such a file, or was made with other arguments.
        """
        self.path, self._arguments = path, json.loads(json.dumps(dict(arguments)))
        self.results: dict[int, EpisodeResult] = {}
        """Seed -> how its episode ended."""
        if not path.exists():
            return
        try:
            document = json.loads(path.read_text())
            made_with, episodes = document["arguments"], [EpisodeResult(**entry) for entry in document["episodes"]]
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise FileFormatError(path, "episodes", f"not a file of episodes ({error}); name another one") from error
        if made_with != self._arguments:
            raise FileFormatError(path, "arguments", f"was made with {made_with}, not with {self._arguments}")
        self.results = {result.seed: result for result in episodes}

    def add(self, result: EpisodeResult) -> None:
        """Keep a result; what is in the file is whole at any time."""
        self.results[result.seed] = result
        episodes = [self.results[seed].plain() for seed in sorted(self.results)]
        self.path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = self.path.with_suffix(".part")
        unfinished.write_text(json.dumps({"arguments": self._arguments, "episodes": episodes}, indent=1) + "\n")
        unfinished.replace(self.path)
