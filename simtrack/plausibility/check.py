"""The check of a URDF file: a child process an engine, a time limit, one report."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any, TypeAlias

import simtrack
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.plausibility.verdict import (
    SEVERITIES,
    CheckConfig,
    CheckReport,
    EngineResult,
    Finding,
    Verdict,
    result_from_json,
)

ENGINES = ("pybullet", "mujoco")
"""The first decides; the others stand beside it."""
RESULTS = ("check.json", "before.png", "after.png")
"""Files that a check writes."""
TIME_LIMIT = 300.0
"""Seconds that an engine may take."""
LOG_TAIL = 300
"""Characters of what an engine printed that are repeated when it died."""


Answer: TypeAlias = tuple[list[Finding], EngineResult | None]
"""What a child found in the file, and what its engine says of it; None if it could not run."""


@dataclass(frozen=True, slots=True)
class _Child:
    engine: str
    process: "subprocess.Popen[bytes]"
    work: Path
    log: IO[bytes]


def check_urdf(
    path: str | Path,
    *,
    root: str | Path | None = None,
    out: str | Path | None = None,
    engines: Sequence[str] = ENGINES,
    config: CheckConfig | None = None,
    time_limit: float = TIME_LIMIT,
) -> CheckReport:
    """Whether the scene in a URDF file is physically plausible.

    Args:
        path: the file.
        root: folder in which all files that it names must lie; its own folder if None.
        out: folder for ``check.json`` and the pictures ``before.png`` and ``after.png``; nothing is written if None.
        engines: names among `ENGINES`; the first decides.
        config: what counts as plausible.
        time_limit: seconds that each engine may take.

    Raises:
        UnknownNameError: no such engine.
        InvalidValueError: the time limit is not positive, or no engine is named.
    """
    config = config or CheckConfig()
    if not time_limit > 0.0:
        raise InvalidValueError("time_limit", time_limit, "above 0 seconds")
    if not engines:
        raise InvalidValueError("engines", engines, f"one or more of {', '.join(ENGINES)}")
    for name in engines:
        if name not in ENGINES:
            raise UnknownNameError("engine", name, ENGINES)
    folder = None if out is None else Path(out)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        for name in RESULTS:  # of an older check: none of them may pass for this one's
            (folder / name).unlink(missing_ok=True)
    with tempfile.TemporaryDirectory(prefix="simtrack-check-") as work:
        children = [
            _start(name, Path(work) / name, Path(path), root, folder if k == 0 else None, config)
            for k, name in enumerate(engines)
        ]
        deadline = time.monotonic() + time_limit
        answers = [_answer(child, deadline, time_limit) for child in children]
    report = judge(Path(path), answers, config)
    if folder is not None:
        document = {"verdict": report.verdict, **asdict(report)}
        (folder / RESULTS[0]).write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    return report


def _start(
    engine: str, work: Path, path: Path, root: str | Path | None, pictures: Path | None, config: CheckConfig
) -> _Child:
    work.mkdir()
    job = {
        "engine": engine,
        "file": str(path.absolute()),
        "root": None if root is None else str(Path(root).absolute()),
        "work": str(work),
        "pictures": None if pictures is None else str(pictures.absolute()),
        "config": asdict(config),
    }
    log = (work / "log").open("wb")
    package = str(Path(simtrack.__file__).parents[1])
    search = os.pathsep.join([package, *filter(None, [os.environ.get("PYTHONPATH")])])
    process = subprocess.Popen(
        [sys.executable, "-m", "simtrack.plausibility.child"],
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=subprocess.STDOUT,
        env={**os.environ, "PYTHONPATH": search},
    )
    assert process.stdin is not None
    with suppress(BrokenPipeError):  # it has died already; `_answer` says so
        process.stdin.write(json.dumps(job).encode())
        process.stdin.close()
    return _Child(engine, process, work, log)


def _answer(child: _Child, deadline: float, time_limit: float) -> Answer:
    try:
        code = child.process.wait(max(0.0, deadline - time.monotonic()))
    except subprocess.TimeoutExpired:
        code = None
    finally:
        if child.process.poll() is None:
            child.process.kill()
            child.process.wait()
        child.log.close()
    result = child.work / "result.json"
    if result.is_file():
        return answer_of(json.loads(result.read_text(encoding="utf-8")))
    stage = child.work / "stage"
    doing = stage.read_text(encoding="utf-8") if stage.is_file() else "starting"
    if code is None:
        finding = Finding(
            "unreadable", "time-limit", child.engine, f"took over {time_limit:g} s and was ended ({doing})"
        )
        return [finding], None
    tail = (child.work / "log").read_text(encoding="utf-8", errors="replace").strip()[-LOG_TAIL:]
    died = f"signal {-code}" if code < 0 else f"exit code {code}"
    return [Finding("unreadable", "crash", child.engine, f"died of {died} ({doing}): {tail}")], None


def answer_of(document: dict[str, Any]) -> Answer:
    """What a child found (the result of `simtrack.plausibility.child.run`)."""
    engine = document["engine"]
    return [Finding(**row) for row in document["findings"]], None if engine is None else result_from_json(engine)


def judge(path: Path, answers: Sequence[Answer], config: CheckConfig) -> CheckReport:
    """The verdict that follows from the answers of the engines, the deciding one first."""
    results = tuple(result for _, result in answers if result is not None)
    first = answers[0][1]
    findings: list[Finding] = []
    for number, (found, _) in enumerate(answers):
        for finding in found:
            beside = (
                number > 0 and finding.kind in ("crash", "time-limit", "engine") and finding.severity == "unreadable"
            )
            kept = Finding("warning", finding.kind, finding.subject, finding.message) if beside else finding
            if kept not in findings:
                findings.append(kept)
    if first is not None:
        findings += _engine_findings(first, config)
    agreement = None
    for other in results[1:] if first is not None else ():
        agreement, disagreements = _compare(results[0], other)
        findings += disagreements
    findings.sort(key=lambda finding: -SEVERITIES.index(finding.severity))
    verdict: Verdict = "plausible"
    if first is None or any(finding.severity == "unreadable" for finding in findings):
        verdict = "unreadable"
    elif any(finding.severity == "problem" for finding in findings):
        verdict = "not plausible"
    return CheckReport(str(path), verdict, tuple(findings), results, agreement, config)


def _engine_findings(result: EngineResult, config: CheckConfig) -> list[Finding]:
    """What the deciding engine holds against bodies and joints, as problems; what is only notable, as notes."""
    out = []
    for body in result.bodies:
        tilt = f"{body.tilt * 57.29578:.1f} deg"
        gap = "nothing near below it" if body.gap is None else f"{1e3 * body.gap:.1f} mm above what is below it"
        depth = 1e3 * max(body.penetration_start, body.penetration_end)
        texts = {
            "fell": f"fell {body.drift:.2f} m in {config.duration:g} s",
            "drifted": f"moved {1e3 * body.drift:.1f} mm in {config.duration:g} s",
            "toppled": f"toppled, it turned by {tilt}",
            "tilted": f"turned by {tilt} away from the vertical",
            "floating": f"floats: {gap}",
            "penetrating": f"is {depth:.1f} mm deep in another body",
        }
        out += [Finding("problem", problem, body.name, texts[problem]) for problem in body.problems]
        if not body.problems and not body.resting:
            out.append(Finding("warning", "restless", body.name, f"still moves after {config.duration:g} s"))
    for first, second, depth in result.inside:
        message = f"is {1e3 * depth:.1f} mm deep in '{second}'; both are fixed to each other and cannot give way"
        out.append(Finding("warning", "overlap", first, message))
    for joint in result.joints:
        free, own = (f"{100.0 * share:.0f} % of its range" for share in (joint.reached, joint.reached_alone))
        met = f"meets '{joint.blocked_by}', {1e3 * joint.depth:.0f} mm deep"
        texts = {
            "drives-into-body": f"drives '{joint.body}' into its own body: {met}",
            "unreachable": f"its own object leaves it {own}: it {met}",
            "astray": f"leads '{joint.body}' {1e3 * joint.follows:.1f} mm away from where its axis says",
        }
        out += [Finding("problem", problem, joint.name, texts[problem]) for problem in joint.problems]
        if joint.problems or joint.blocked_by is None:
            continue
        if joint.reached < config.least_range:  # no fault of the object: so are real rooms, too
            out.append(Finding("warning", "obstructed", joint.name, f"has room for {free} only: it {met}"))
        else:
            out.append(Finding("note", "blocked", joint.name, f"moves through {free}, then {met}"))
    return out


def _compare(first: EngineResult, other: EngineResult) -> tuple[float | None, list[Finding]]:
    """Share of free bodies that both engines judge alike, and where they differ."""
    theirs = {body.name: body for body in other.bodies}
    findings, alike, count = [], 0, 0
    for body in first.bodies:
        beside = theirs.get(body.name)
        if body.static or beside is None:
            continue
        count += 1
        if bool(body.problems) == bool(beside.problems):
            alike += 1
            continue
        said = " but ".join(
            f"{engine.engine} says {', '.join(row.problems) or 'stable'}"
            for engine, row in ((first, body), (other, beside))
        )
        findings.append(Finding("warning", "engines-disagree", body.name, said))
    moved = {joint.name: joint for joint in other.joints}
    for joint in first.joints:
        beside_joint = moved.get(joint.name)
        if beside_joint is not None and bool(beside_joint.problems) != bool(joint.problems):
            said = " but ".join(
                f"{engine.engine} says {', '.join(row.problems) or 'free'}"
                for engine, row in ((first, joint), (other, beside_joint))
            )
            findings.append(Finding("warning", "engines-disagree", joint.name, said))
    return (alike / count if count else None), findings
