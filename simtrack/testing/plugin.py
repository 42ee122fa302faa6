"""The pytest plugin: ``--simtrack`` lets tests run the closed loop; without it they are skipped."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from simtrack.testing.assertions import Runs

SimtrackRuns = Callable[..., Runs]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of the plugin."""
    group = parser.getgroup("simtrack", "end-to-end accuracy with simtrack")
    group.addoption("--simtrack", action="store_true", help="run the tests that need closed-loop runs")
    group.addoption("--simtrack-work", default="runs/cases", help="folder where runs are kept (default: runs/cases)")
    group.addoption("--simtrack-workers", type=int, default=1, help="runs at a time (default: 1)")
    group.addoption("--simtrack-store", action="store_true", help="store results anew, for later regression bands")


@pytest.fixture(scope="session")
def simtrack_runs(request: pytest.FixtureRequest) -> SimtrackRuns:
    """``simtrack_runs(scene, seed=0, duration=10.0, noise=2.0, tracker="package.module:Class", ...)`` -> `Runs`.

    Conditions by their names (see `simtrack.evaluation.instrument.conditions.Conditions`), stages as on the command
    line. Nothing runs before a test asserts something.
    """
    if not request.config.getoption("--simtrack"):
        pytest.skip("closed-loop runs take minutes; ask for them with --simtrack")
    from simtrack.evaluation.instrument.cases import Case, Runner
    from simtrack.evaluation.instrument.conditions import AXES, Conditions

    work = Path(str(request.config.getoption("--simtrack-work")))
    runner = Runner(work, int(str(request.config.getoption("--simtrack-workers"))))

    def make(scene: str = "workbench", **settings: Any) -> Runs:
        conditions = {name: settings.pop(name) for name in list(settings) if name in AXES}
        case = Case(scene, conditions=Conditions(**conditions), **{"duration": 10.0, **settings})
        case.config(work)  # what cannot be run is told here
        return Runs(case, runner)

    return make


@pytest.fixture(scope="session")
def simtrack_store(request: pytest.FixtureRequest) -> bool:
    """Whether results are to be stored anew: hand it to `assert_no_regression`."""
    return bool(request.config.getoption("--simtrack-store"))
