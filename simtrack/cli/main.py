"""Entry point: finds the verb, and turns what can go wrong into one clear message."""

import sys
import warnings
from collections.abc import Sequence
from contextlib import nullcontext

import simtrack
from simtrack.cli import console
from simtrack.cli.attribute import attribute
from simtrack.cli.bench import bench
from simtrack.cli.check import check
from simtrack.cli.compare import compare
from simtrack.cli.debug import debug
from simtrack.cli.env import env
from simtrack.cli.evaluate import evaluate
from simtrack.cli.generate import generate
from simtrack.cli.inspect import inspect
from simtrack.cli.map import map_command
from simtrack.cli.objects import objects
from simtrack.cli.query import query
from simtrack.cli.reconstruct import reconstruct
from simtrack.cli.replay import replay
from simtrack.cli.run import run
from simtrack.cli.scenes import scenes
from simtrack.cli.score import score
from simtrack.cli.serve import serve
from simtrack.cli.survey import survey
from simtrack.cli.sweep import sweep
from simtrack.cli.train import train
from simtrack.cli.trials import trials
from simtrack.cli.usage import folded, optional_values, unbroken
from simtrack.cli.validate import validate

VERBS = {
    "run": run,
    "replay": replay,
    "score": score,
    "attribute": attribute,
    "sweep": sweep,
    "compare": compare,
    "debug": debug,
    "env": env,
    "generate": generate,
    "inspect": inspect,
    "validate": validate,
    "train": train,
    "map": map_command,
    "survey": survey,
    "serve": serve,
    "reconstruct": reconstruct,
    "check": check,
    "scenes": scenes,
    "objects": objects,
    "query": query,
    "evaluate": evaluate,
    "trials": trials,
    "bench": bench,
}
DESCRIPTION = "Closed-loop test harness for object trackers and scene graphs of robots, with exact ground truth."


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0 good, 2 wrong usage or input, 130 stopped by the user."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments in (["--version"], ["-V"]):
        print(f"simtrack {simtrack.__version__}")
        return 0
    import tyro

    from simtrack.errors import SimtrackError

    warnings.showwarning = console.show_warning
    try:
        with folded() if {"-h", "--help"} & {*arguments} or not arguments else nullcontext():
            code = tyro.extras.subcommand_cli_from_dict(
                {verb: unbroken(function) for verb, function in VERBS.items()},
                prog="simtrack",
                description=DESCRIPTION,
                args=arguments or ["--help"],
                config=(tyro.conf.PositionalMetavarFromFieldName,),
                registry=optional_values(),
            )
    except SimtrackError as error:
        console.show_error(str(error))
        return 2
    except KeyboardInterrupt:
        console.show_error("stopped")
        return 130
    except BrokenPipeError:  # the reader of our output went away, as `head` does
        sys.stderr.close()
        return 0
    return int(code or 0)


if __name__ == "__main__":
    sys.exit(main())
