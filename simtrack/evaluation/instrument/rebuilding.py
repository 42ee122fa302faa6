"""The tracker's models of a run, made again from what its folder says."""

from pathlib import Path

from simtrack.errors import FileFormatError
from simtrack.objects import ObjectModel
from simtrack.simulation.scene_file import load_scene, parse_scene
from simtrack.simulation.simulation import Simulation


def rebuilt_models(run: Path) -> dict[str, ObjectModel]:
    """Class name -> model, as the stack of a run had them.

    Raises:
        FileFormatError: the folder has no configuration of a run.
    """
    import yaml

    file = run / "config.yaml"
    try:
        config = yaml.safe_load(file.read_text(encoding="utf-8"))
        document, seed, name = config["scene_file"], int(config["seed"]), str(config["scene"])
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise FileFormatError(file, "", "not the folder of a run: no scene and seed in config.yaml") from error
    scene = parse_scene(document, load_scene(name).path)
    with Simulation(scene, seed, renderer="embree", sensors=()) as simulation:
        return simulation.models
