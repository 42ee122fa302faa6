"""``simtrack check``: say whether the scene in a URDF file is physically plausible."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from simtrack.plausibility.verdict import CheckReport


def check(
    file: Annotated[Path, tyro.conf.Positional],
    out: Path | None = None,
    root: Path | None = None,
    duration: float = 5.0,
    time_limit: float = 300.0,
) -> int:
    """Say whether the scene in a URDF file is physically plausible.

    Settles it under gravity and moves its joints in Bullet, with MuJoCo beside it. Ends with exit code 0 if it is
    plausible, 1 if not, 2 if it cannot be read or judged.

    Args:
        file: The URDF file; any, not only simtrack's.
        out: Folder for check.json, before.png and after.png; runs/check-NAME if not given.
        root: Folder in which all files that it names must lie; its own folder if not given.
        duration: Simulated seconds to settle.
        time_limit: Seconds that each engine may take.
    """
    from simtrack.cli import console
    from simtrack.errors import FileFormatError
    from simtrack.plausibility.check import RESULTS, check_urdf
    from simtrack.plausibility.verdict import CheckConfig

    if not file.is_file():
        raise FileFormatError(file, "", "no such file; give a URDF file")
    folder = out if out is not None else Path("runs") / f"check-{file.stem or file.resolve().name}"
    with console.ProgressLine(f"check of {file}", "settling in both engines"):
        report = check_urdf(file, root=root, out=folder, config=CheckConfig(duration=duration), time_limit=time_limit)
    show(report)
    console.show_written(folder, [name for name in RESULTS if (folder / name).is_file()])
    return report.exit_code


def show(report: "CheckReport") -> None:
    """Print bodies, joints, findings and the verdict."""
    from simtrack.cli import console

    rows = [
        (
            body.name,
            engine.engine,
            "static" if body.static else f"{1e3 * body.drift:.1f} mm",
            "" if body.static else f"{body.tilt * 57.29578:.1f} deg",
            f"{1e3 * body.penetration_start:.1f} mm",
            f"{1e3 * body.penetration_end:.1f} mm",
            "" if body.static else "none near" if body.gap is None else f"{1e3 * body.gap:.1f} mm",
            ", ".join(body.problems) or "good",
        )
        for engine in report.engines
        for body in engine.bodies
    ]
    if rows:
        columns = ["body", "engine", "drift", "tilt", "overlap before", "after", "gap", ""]
        console.show_table(columns, rows, right=range(2, 7))
    joints = [
        (joint.name, engine.engine, f"{joint.lower:.2f} to {joint.upper:.2f}", f"{100 * joint.reached:.0f} %",
         joint.blocked_by or "", ", ".join(joint.problems) or "good")
        for engine in report.engines
        for joint in engine.joints
    ]  # fmt: skip
    if joints:
        console.show_table(["joint", "engine", "range", "free", "meets", ""], joints, right=(2, 3))
    for finding in report.findings:
        print(finding)
    if report.agreement is not None:
        print(f"the engines agree on {100 * report.agreement:.0f} % of the free bodies")
    margins = ", ".join(f"{engine.engine} {1e3 * engine.margin:g} mm" for engine in report.engines)
    if margins:
        print(f"margins of the engines, subtracted: {margins}")
    print(report.verdict)
