"""What the command prints: messages, tables, a progress line; rich is imported when something is printed."""

import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as Bar

    from simtrack.evaluation.closed_loop import Progress

QUIET_PERIOD = 5.0
"""Seconds between lines of progress where there is no terminal."""


def out() -> "Console":
    """Standard output."""
    from rich.console import Console

    return Console(highlight=False, width=None if _is_terminal() else 120)


def err() -> "Console":
    """Standard error."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def _is_terminal() -> bool:
    return sys.stdout.isatty()


def show_error(message: str) -> None:
    """Print one message in red to standard error."""
    from rich.console import Console
    from rich.text import Text

    console = Console(stderr=True, highlight=False, soft_wrap=True)
    console.print(Text.assemble(("error: ", "bold red"), (message, "red")))


def show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Print a warning for a person, without file and line; in the place of `warnings.showwarning`."""
    from rich.console import Console
    from rich.text import Text

    console = Console(stderr=True, highlight=False, soft_wrap=True)
    console.print(Text.assemble(("warning: ", "bold yellow"), str(message)))


def show_choice(what: str, chosen: str, reason: str) -> None:
    """Tell what was chosen for the user, and why."""
    from rich.text import Text

    out().print(Text.assemble(f"{what}: ", (chosen, "bold"), f" ({reason})"))


_LEAST_TEXT = 20
"""Characters of a column of text that are not given away to the others."""


def show_table(columns: Sequence[str], rows: Iterable[Sequence[object]], right: Sequence[int] = ()) -> None:
    """Print a table; `right` are the columns to be aligned right. Too wide, it folds text and headers, not numbers."""
    from rich.table import Table
    from rich.text import Text

    rows, console = list(rows), out()
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    longest = [max((len(str(row[k])) for row in rows), default=0) for k in range(len(columns))]
    fits = sum(max(len(name), most) + 2 for name, most in zip(columns, longest, strict=True)) <= console.width
    for k, column in enumerate(columns):
        if k in right:
            width = None if fits or not longest[k] else longest[k]  # its header is folded instead
            table.add_column(column, justify="right", overflow="fold", width=width, no_wrap=width is None)
        else:
            table.add_column(column, overflow="fold", min_width=min(longest[k], _LEAST_TEXT))
    for row in rows:
        table.add_row(*(cell if isinstance(cell, Text) else Text(str(cell)) for cell in row))
    console.print(table)


class ProgressLine:
    """One live line in a terminal, a line of text now and then elsewhere; a context manager."""

    def __init__(self, title: str, first: str = "building the world", *, to_stderr: bool = False) -> None:
        self._title, self._first, self._to_stderr = title, first, to_stderr
        self._bar: Bar | None = None
        self._task = None
        self._what = ""
        self._said = -QUIET_PERIOD
        self._told: set[str] = set()

    def __enter__(self) -> "ProgressLine":
        console = err() if self._to_stderr else out()
        if console.is_terminal:
            from rich.progress import BarColumn, Progress, TextColumn

            columns = [TextColumn("{task.description}"), TextColumn("{task.fields[state]}")]
            if console.width >= 72:
                columns.insert(1, BarColumn(bar_width=None))  # type: ignore[arg-type]
            self._bar = Progress(*columns, console=console, transient=True, expand=True, refresh_per_second=8)
            self._bar.start()
            self._task = self._bar.add_task(self._title, total=1.0, state="")
        self.say(self._first)
        return self

    def say(self, what: str, thing: str = "") -> None:
        """Tell what is being done before a run gets going; where there is no terminal, once each."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, state=f"{what}: {thing}" if thing else what)
        elif what not in self._told:
            self._told.add(what)
            self._print(f"{self._title}: {what}")

    def update(self, progress: "Progress") -> None:
        """Show how far a run is."""
        if self._what and self._what != progress.what:
            self._title = f"{self._title.split(' · ')[0]} · {progress.what}"
        self._what = progress.what
        whole = f"/{progress.duration:g}" if progress.duration else ""
        objects = "" if progress.tracks is None else f"{progress.tracks} objects  "
        state = (
            f"{progress.seconds:.1f}{whole} s  {progress.frames_per_second:.1f} fps  "
            f"{objects}localization {progress.localization}"
        )
        self.show(state, progress.seconds / progress.duration if progress.duration else 0.0)

    def show(self, state: str, share: float) -> None:
        """Show a state, and the share of the work that is done, 0 to 1."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, description=self._title, completed=share, state=state)
        elif time.monotonic() - self._said >= QUIET_PERIOD:
            self._said = time.monotonic()
            self._print(f"{self._title}: {state}")

    def _print(self, text: str) -> None:
        print(text, file=sys.stderr if self._to_stderr else sys.stdout, flush=True)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()


def show_written(folder: Path, names: Sequence[str]) -> None:
    """Tell where results are."""
    from rich.text import Text

    for name in names:
        out().print(Text.assemble("wrote ", (str(folder / name), "bold")))
