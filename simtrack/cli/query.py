"""``simtrack query``: ask the scene graph of a run."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from simtrack.perception.scene_graph import SceneFacts

SPARQL = ("select", "ask", "construct", "describe", "prefix", "base")


def query(
    run_dir: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN_DIR")],
    question: Annotated[str, tyro.conf.Positional],
) -> int:
    """Ask the scene graph of a run, e.g. `simtrack query runs/workbench-0 '? left-of multimeter'`.

    Args:
        run_dir: Folder of a run, or a graph.json.
        question: '[SUBJECT] RELATION[:VARIANT] [REFERENCE] [@ SECONDS]' with ? for anything, or a SPARQL query.
    """
    from simtrack.cli import console
    from simtrack.errors import FileFormatError
    from simtrack.perception.scene_graph import load_graph

    path = run_dir / "graph.json" if run_dir.is_dir() else run_dir
    if not path.is_file():
        raise FileFormatError(path, "", "no such file; give the folder of a run or a graph.json")
    facts = load_graph(path)
    if (question.split() or [""])[0].lower() in SPARQL:
        return _sparql(facts, question)
    answers = facts.ask(question)
    console.show_table(
        ("subject", "relation", "reference"), [(answer.subject, answer.name, answer.reference) for answer in answers]
    )
    return 0


def _sparql(facts: "SceneFacts", question: str) -> int:
    from simtrack.cli import console

    result = facts.sparql(question)
    if isinstance(result, bool):
        print("yes" if result else "no")
    elif result and isinstance(result[0], dict):
        columns = list(result[0])
        console.show_table(columns, [[row[name] for name in columns] for row in result if isinstance(row, dict)])
    else:
        console.show_table(("subject", "predicate", "object"), [row for row in result if isinstance(row, tuple)])
    return 0
