"""Commands as a user gives them: in this process, or in one of their own where it is the process that is tested."""

import gc
import io
import os
import subprocess
import sys
import warnings
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import numba

from simtrack.cli.main import main

ROOT = Path(__file__).parents[2]
TERMINAL = {"COLUMNS": "100", "NO_COLOR": "1"}


@dataclass(frozen=True)
class Done:
    """How a command ended."""

    returncode: int
    stdout: str
    stderr: str


def simtrack_command(*arguments: object, env: dict[str, str] | None = None) -> Done:
    """Run a command in this process, which takes a tenth of the time; what it raises is raised."""
    out, err = io.StringIO(), io.StringIO()
    threads, collector = numba.get_num_threads(), gc.get_threshold()
    with ExitStack() as exits:
        exits.enter_context(patch.dict(os.environ, {**TERMINAL, **(env or {})}))
        exits.enter_context(warnings.catch_warnings())
        exits.enter_context(redirect_stdout(out))
        exits.enter_context(redirect_stderr(err))
        exits.callback(numba.set_num_threads, threads)
        exits.callback(gc.set_threshold, *collector)
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
    return Done(code, out.getvalue(), err.getvalue())


def start(*arguments: object) -> subprocess.Popen[str]:
    """Start a command in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **TERMINAL}
    command = [sys.executable, "-m", "simtrack", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def simtrack_process(*arguments: object) -> Done:
    """Run a command in a process of its own."""
    process = start(*arguments)
    stdout, stderr = process.communicate(timeout=600)
    return Done(process.returncode, stdout, stderr)


def refused(*arguments: object, env: dict[str, str] | None = None) -> str:
    """The message of a command that has to fail with exit code 2 and without a traceback."""
    return refusal(simtrack_command(*arguments, env=env))


def refusal(done: Done) -> str:
    """What a command has said that has to have failed with exit code 2 and without a traceback."""
    assert done.returncode == 2, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return " ".join(done.stderr.split())
