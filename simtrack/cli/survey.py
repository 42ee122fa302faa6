"""``simtrack survey``: the map of a scene for localization, made of simulated scans."""

from pathlib import Path
from typing import Annotated

import tyro

FILES = ("survey.npz", "survey.ply")


def survey(
    scene: Annotated[str, tyro.conf.Positional] = "workbench",
    out: Path | None = None,
    seed: int = 0,
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
) -> int:
    """Scan a scene from stations in every room and fuse the scans to the mesh map that `simtrack run --map DIR` takes.

    Args:
        scene: Name of a scene, or path of its folder or YAML file.
        out: Folder for the survey; runs/survey-SCENE-SEED if not given.
        seed: Of the building, of what was moved since the survey, and of the scans.
        overwrite: Replace the results in an existing folder.
    """
    from simtrack.cli import console
    from simtrack.cli.folders import new_folder
    from simtrack.simulation.scene_file import load_scene, surveyed_by
    from simtrack.simulation.simulation import Simulation
    from simtrack.simulation.survey_files import write_survey

    loaded = surveyed_by(load_scene(scene), "scans")
    folder = out if out is not None else Path("runs") / f"survey-{loaded.name}-{seed}"
    with (
        console.ProgressLine(f"survey {loaded.name}", to_stderr=True) as line,
        new_folder(folder, overwrite, FILES) as work,
        Simulation(loaded, seed, renderer="embree", sensors=()) as simulation,
    ):
        line.say("scanning")
        static_map = simulation.static_map
        write_survey(static_map, work)
    print(f"{len(static_map.faces)} triangles of {len(static_map.entities)} entities in {len(static_map.rooms)} rooms")
    console.show_written(folder, FILES)
    return 0
