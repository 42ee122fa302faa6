"""``simtrack reconstruct``: make a functional scene of entities, and check whether it is physically plausible."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from simtrack.cli.console import ProgressLine
    from simtrack.evaluation.entity_sources import SourceEntities
    from simtrack.perception.reconstruction.reconstruct import Reconstruction
    from simtrack.plausibility.verdict import CheckReport

FILES = (
    "graph.json", "reconstruction.json", "scene.urdf", "scene.xml", "scene.glb", "check.json", "before.png",
    "after.png", "report.html",
)  # fmt: skip
FOLDERS = ("meshes",)


def reconstruct(
    source: Annotated[str, tyro.conf.Positional],
    out: Path | None = None,
    entities: Literal["true", "partial", "tracked", "mapped"] | None = None,
    seed: int = 0,
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    time_limit: float = 300.0,
) -> int:
    """Make a functional scene of what was seen: contact graph, CAD models, joints; URDF, MJCF and GLB.

    Ends with exit code 0 if the scene is physically plausible, 1 if not, 2 if it cannot be made or judged.

    Args:
        source: A scene such as rooms:7 or kitchen:3 (see `simtrack scenes`), or the folder of a run or of a map.
        out: Folder for the results; runs/reconstruct-SOURCE if not given.
        entities: Whole meshes (true), partial ones as seen on a walk, tracked ones of a run, or mapped ones of a map;
            the last two are the default for such folders, as true is for scenes.
        seed: Of the scene if its name fixes none, and of the walk.
        overwrite: Replace the results in an existing folder.
        time_limit: Seconds that each engine of the check may take.
    """
    from simtrack.cli import console
    from simtrack.cli.folders import new_folder
    from simtrack.evaluation.entity_sources import source_entities
    from simtrack.plausibility.check import check_urdf
    from simtrack.report.reconstruction_page import write_reconstruction_page

    default = f"reconstruct-{Path(source).name.replace(':', '-')}"
    folder = out if out is not None else Path("runs") / default
    with (
        console.ProgressLine(f"reconstruct {source}", "collecting entities", to_stderr=True) as line,
        new_folder(folder, overwrite, FILES, FOLDERS) as work,
    ):
        given = source_entities(source, entities, seed)
        line.say("planes and contact graph")
        made = _made(given, line)
        files = _written(made, work)
        line.say("settling in both engines")
        report = check_urdf(files, out=work, time_limit=time_limit)
        _name_file(work / "check.json")
        line.say("report")
        write_reconstruction_page(made, report, work, work / "report.html")
    _show(made, report)
    console.show_written(folder, [name for name in FILES if (folder / name).is_file()])
    return report.exit_code


def _made(given: "SourceEntities", line: "ProgressLine") -> "Reconstruction":
    import numpy as np

    from simtrack.perception.reconstruction.known_objects import known_candidates
    from simtrack.perception.reconstruction.reconstruct import reconstruct as reconstructed
    from simtrack.perception.scene_graph.contact import build_contact_graph, entity_nodes

    nodes, findings = entity_nodes(given.entities, np.random.default_rng(0))
    graph = build_contact_graph(nodes, findings=(*given.findings, *findings))
    known = known_candidates({node.name: node for node in nodes}, given.models)
    return reconstructed(graph, name=given.name, known=known, progress=line.show)


def _written(made: "Reconstruction", work: Path) -> Path:
    """Write graph, choices and scene; returns the URDF file."""
    from simtrack.perception.reconstruction.files import write_scene
    from simtrack.perception.reconstruction.record import dump_reconstruction
    from simtrack.perception.scene_graph.contact.serialization import dump_contact_graph

    (work / "graph.json").write_text(dump_contact_graph(made.graph), encoding="utf-8")
    (work / "reconstruction.json").write_text(dump_reconstruction(made), encoding="utf-8")
    return write_scene(made.tree, work).urdf


def _name_file(path: Path) -> None:
    """The check names the file as it lies beside it: the folder it was made in is gone."""
    import json

    document = json.loads(path.read_text(encoding="utf-8"))
    document["file"] = Path(document["file"]).name
    path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


def _show(made: "Reconstruction", report: "CheckReport") -> None:
    """Print what stands for each entity, what is to be said, and the verdict."""
    import numpy as np

    from simtrack.cli import console

    kinds = {body.name: body.joint.kind for body in made.tree.bodies if body.joint is not None}
    rows = [
        (name, choice.candidate.model.name, f"{choice.candidate.scale:.2f}", f"{choice.candidate.matching_error:.3f}",
         f"{1e3 * choice.candidate.alignment_error:.1f} mm", f"{1e3 * np.linalg.norm(choice.shift):.1f} mm",
         made.graph.parent(name), kinds.get(name, ""))
        for name, choice in made.choices.items()
    ]  # fmt: skip
    columns = ["entity", "model", "scale", "ME", "AE", "snapped by", "on", "joint"]
    console.show_table(columns, rows, right=range(2, 6))
    for finding in made.graph.findings:
        print(f"graph: {finding.entity or 'scene'}: {finding.message} [{finding.code}]")
    for note in made.notes:
        print(f"model: {note.entity or 'scene'}: {note.message} [{note.code}]")
    for finding in report.findings:
        print(finding)
    if report.agreement is not None:
        print(f"the engines agree on {100 * report.agreement:.0f} % of the free bodies")
    print(report.verdict)
