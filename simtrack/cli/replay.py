"""``simtrack replay``: feed the stack from a recording."""

from pathlib import Path
from typing import Annotated

import tyro


def replay(
    recording: Annotated[Path, tyro.conf.Positional],
    out: Path | None = None,
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    view: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    rrd: Path | None = None,
    threads: int | None = None,
) -> int:
    """Feed the perception stack from a recording: the same estimates as when it was made, or those of a changed stack.

    Args:
        recording: MCAP file that `simtrack run --log` wrote.
        out: Folder for the results; runs/NAME-replay if not given.
        overwrite: Replace the results in an existing folder.
        view: Show the replay live in rerun (needs the extra viz).
        rrd: Save the replay for rerun in this file (needs the extra viz).
        threads: Threads of the compiled kernels; all cores if not given.
    """
    from simtrack.cli import console
    from simtrack.cli.run import _observers
    from simtrack.evaluation.replay import Replay

    folder = out if out is not None else Path("runs") / f"{recording.stem}-replay"
    with console.ProgressLine(f"replay of {recording.name}") as line:
        partial = Replay(recording, folder, overwrite, threads, line.update, _observers(view, rrd)).run()
    console.show_written(folder, ["estimates.csv", "tracks.csv", "graph.json"])
    return 130 if partial else 0
