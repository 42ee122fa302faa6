"""One run of many: a scene, a seed, conditions and stages; kept in a folder that its content names.

A case that was run by the same code is not run again, so that whatever is made of cases can be stopped and carried on.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeAlias

from simtrack.contracts import Command
from simtrack.errors import InvalidValueError, SimtrackError
from simtrack.evaluation.closed_loop import ClosedLoopRun
from simtrack.evaluation.instrument.belongings import belongings
from simtrack.evaluation.instrument.conditions import Conditions
from simtrack.evaluation.metrics import Metrics, read_metrics, write_atomically
from simtrack.evaluation.run_config import ORACLE, RunConfig, plain, versions
from simtrack.evaluation.workers import as_done, as_done_on_ray, code_digest
from simtrack.simulation.oracles import OracleDetectorConfig
from simtrack.simulation.scene_file import load_scene

Engine: TypeAlias = Literal["local", "ray"]
COMMANDS, METRICS = "commands.json", "metrics.json"


@dataclass(frozen=True, slots=True)
class Case:
    """What is run, and how."""

    scene: str
    """Name or path."""
    seed: int = 0
    duration: float | None = None
    """Simulated seconds; the scene's own if None."""
    conditions: Conditions = field(default_factory=Conditions)
    tracker: str | None = None
    """As in `RunConfig`, like those below."""
    localizer: str | None = None
    detector: str = ORACLE
    renderer: str = "mujoco"
    threads: int | None = None
    follows: "Case | None" = None
    """The case whose commands are given again, so that the robot goes the same way whatever is believed."""

    def config(self, out: Path, script: tuple[Command, ...] | None = None) -> RunConfig:
        """The run: results go to the folder `out`, and `script` has the commands to be given again.

        Raises:
            SimtrackError: scene, stage or condition cannot be used.
        """
        return RunConfig(
            scene=self.conditions.scene(load_scene(self.scene)), out=out, duration=self.duration, seed=self.seed,
            detector=self.detector, tracker=self.tracker, localizer=self.localizer, renderer=self.renderer,
            threads=self.threads, overwrite=True, oracle=self.conditions.detector(OracleDetectorConfig()),
            script=script,
        )  # fmt: skip

    @property
    def key(self) -> str:
        """Hash of all that the outcome depends on: these fields, the scene's file, the code, users' code and files (see
        `belongings`), versions of libraries.
        """
        content = {name: value for name, value in asdict(self).items() if name not in ("threads", "follows")}
        content["follows"] = None if self.follows is None else self.follows.key
        scene = load_scene(self.scene)
        content["file"] = plain(scene.model_dump(mode="json"))
        content["code"], content["versions"] = code_digest(), versions()
        content["belongings"] = belongings((self.tracker, self.localizer, self.detector), scene.mjcf_path)
        return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:16]

    def folder(self, work: Path) -> Path:
        """Where its results are kept under a working folder."""
        return work / f"{Path(self.scene).stem.replace(':', '-')}-{self.seed}-{self.key}"

    def way(self, work: Path) -> Path | None:
        """The folder of the case that it follows."""
        return None if self.follows is None else self.follows.folder(work)

    def done(self, work: Path) -> Metrics | None:
        """The metrics of a run that ended; None if there is none."""
        with suppress(SimtrackError):
            metrics = read_metrics(self.folder(work) / METRICS)
            partial = metrics.get("run.partial")
            if partial is not None and partial.value is False and (self.folder(work) / COMMANDS).is_file():
                return metrics
        return None


@dataclass(frozen=True, slots=True)
class _Job:
    """A case with its folders, as it is sent to a worker: there the code may have another hash by then."""

    case: Case
    out: Path
    way: Path | None
    """Folder of the case whose commands are given again."""

    def run(self) -> Metrics:
        script = None
        if self.way is not None:
            entries = json.loads((self.way / COMMANDS).read_text(encoding="utf-8"))
            script = tuple(Command(**entry) for entry in entries)
        run = ClosedLoopRun(self.case.config(self.out, script))
        record = run.run()
        if record.partial:
            raise KeyboardInterrupt
        write_atomically(self.out / COMMANDS, json.dumps([asdict(command) for command in run.commands]) + "\n")
        return record.metrics


@dataclass(frozen=True, slots=True)
class Runner:
    """Runs cases, several at a time."""

    work: Path
    """Folder for what is kept."""
    workers: int = 1
    engine: Engine = "local"
    address: str | None = None
    """Of a Ray cluster."""
    report: Callable[[int, int, str], None] = lambda done, of, what: None
    """Hears how many cases are done, of how many, and what came last."""

    def run(self, cases: Sequence[Case]) -> dict[Case, Metrics | SimtrackError]:
        """Outcomes by case; a case that cannot be run has its error instead of metrics.

        Raises:
            InvalidValueError: the folder cannot be written, or the engine cannot be used.
        """
        try:
            self.work.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            allowed = f"a folder that can be written ({error.strerror})"
            raise InvalidValueError("work", str(self.work), allowed) from error
        outcomes: dict[Case, Metrics | SimtrackError] = {}
        for case in dict.fromkeys(cases):
            if (kept := case.done(self.work)) is not None:
                outcomes[case] = kept
        missing = [case for case in dict.fromkeys(cases) if case not in outcomes]
        total = len(outcomes) + len(missing)
        self.report(len(outcomes), total, f"{len(outcomes)} runs were there" if outcomes else "starting")
        threads = 1 if self.workers > 1 else None
        folder = self.work.resolve()
        jobs = {
            _Job(
                replace(case, threads=threads), case.folder(folder), case.follows and case.follows.folder(folder)
            ): case
            for case in missing
        }
        ends = (
            as_done(list(jobs), _Job.run, self.workers)
            if self.engine == "local"
            else as_done_on_ray(list(jobs), _Job.run, self.workers, self.address)
        )
        for job, outcome in ends:
            case = jobs[job]
            if isinstance(outcome, BaseException) and not isinstance(outcome, SimtrackError):
                outcome = SimtrackError(f"the process that ran it ended: {outcome}")
            outcomes[case] = outcome
            failed = f"failed: {outcome}" if isinstance(outcome, SimtrackError) else "done"
            self.report(len(outcomes), total, f"{name_of(case)}: {failed}")
        return outcomes


def name_of(case: Case) -> str:
    """A case in words."""
    changes = [f"{name} {value:g}" for name, value in case.conditions.changed().items()]
    changes += [f"{stage} {name}" for stage, name in (("tracker", case.tracker), ("localizer", case.localizer)) if name]
    return f"{Path(case.scene).stem} seed {case.seed}" + (f", {', '.join(changes)}" if changes else "")
