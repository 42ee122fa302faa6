"""The process in which a file is read and an engine runs: ``python -m simtrack.plausibility.child``.

Reads its job as JSON from standard input; leaves ``result.json`` and ``stage`` (what it was doing last) in the job's
work folder. What the engine prints goes where standard output goes.
"""

import json
import resource
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

MEMORY = 12 * 2**30
"""Bytes of address space."""


def main() -> None:
    """Do the job."""
    job = json.load(sys.stdin)
    _bound(resource.RLIMIT_AS, MEMORY)
    _bound(resource.RLIMIT_CORE, 0)
    work = Path(job["work"])
    result = run(job, work)
    unfinished = work / "result.part"
    unfinished.write_text(json.dumps(result), encoding="utf-8")
    unfinished.rename(work / "result.json")


def _bound(kind: int, value: int) -> None:
    hard = resource.getrlimit(kind)[1]
    resource.setrlimit(kind, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))


def run(job: dict[str, Any], work: Path) -> dict[str, Any]:
    """Read the file and let one engine examine it; JSON-ready ``findings`` and ``engine`` (None: not run)."""
    from simtrack.errors import SimtrackError
    from simtrack.plausibility.procedure import examine, prepare
    from simtrack.plausibility.urdf_reader import read_urdf
    from simtrack.plausibility.verdict import CheckConfig, Finding

    def say(stage: str) -> None:
        (work / "stage").write_text(stage, encoding="utf-8")

    say("reading the file")
    tree, findings = read_urdf(job["file"], job["root"])
    if tree is None:
        return {"findings": [asdict(finding) for finding in findings], "engine": None}
    prepared = prepare(tree)
    found = [*findings, *prepared.findings]
    say("loading")
    try:
        engine = _engine(job["engine"])(prepared.tree, work / "files")
        pictures = Path(job["pictures"]) if job["pictures"] else None

        def picture(name: str) -> None:
            if pictures is not None:
                engine.picture(pictures / f"{name}.png")

        result = examine(engine, CheckConfig(**job["config"]), say, picture)
        engine.close()
    except SimtrackError as error:
        found.append(Finding("unreadable", "engine", job["engine"], str(error)))
        return {"findings": [asdict(finding) for finding in found], "engine": None}
    return {"findings": [asdict(finding) for finding in found], "engine": asdict(result)}


def _engine(name: str) -> Any:
    if name == "pybullet":
        from simtrack.plausibility.pybullet_engine import PybulletEngine

        return PybulletEngine
    from simtrack.plausibility.mujoco_engine import MujocoEngine

    return MujocoEngine


if __name__ == "__main__":
    main()
