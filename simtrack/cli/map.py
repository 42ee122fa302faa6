"""``simtrack map``: from an RGB-D stream to a panoptic map, one mesh an entity."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

FILES = ("entities.json", "surface.ply", "map.npz", "metrics.json", "report.html")
FOLDERS = ("entities",)


def map_command(
    source: Annotated[str, tyro.conf.Positional],
    out: Path | None = None,
    segmenter: str | None = None,
    poses: Literal["true", "estimated", "noisy"] = "true",
    strength: float = 1.0,
    voxel: float = 0.02,
    method: Literal["full", "no-joint-fusion", "voxbloxpp"] = "full",
    frames: int = 300,
    sensor: str = "xtion",
    seed: int = 0,
    swap: float | None = None,
    onto: Path | None = None,
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
) -> int:
    """Map a filmed room, or a recording of an RGB-D camera: objects and layout as meshes with classes.

    Args:
        source: A furnished room such as rooms:7 or kitchen:2, which is filmed, or a recording with poses.
        out: Folder for the results; runs/map-SOURCE if not given.
        segmenter: Who segments the images: oracle (knows the truth, and errs like a network), the default for rooms;
            none, the default for recordings: geometry alone is mapped; learned, the network that comes along; a folder
            that `simtrack train segmenter` wrote, a service at http://HOST:PORT, or package.module:Class.
        poses: Of the camera: true, as the film or the recording states them; estimated, by RGB-D odometry from the
            images alone; noisy, the stated ones with the errors of a SLAM system.
        strength: Of the oracle's errors, 0 to 3; 1 is fixed so that the map without joint fusion is as good as the
            reconstruction paper's.
        voxel: Metres.
        method: full, or one of the methods that it is compared with.
        frames: Of the film; of a recording, the first so many.
        sensor: Camera and noise of the film: xtion or kinect_v2.
        seed: Of a scene whose name fixes none, of the walk, the noise and the errors.
        swap: Metres from the camera from which parts of the map are kept on disk while it runs; none if not given.
        onto: Folder of an earlier map, or its map.npz, that is carried on, with its method and voxels.
        overwrite: Replace the results in an existing folder.
    """
    from simtrack.cli import console
    from simtrack.cli.folders import new_folder
    from simtrack.evaluation.map_sources import map_source
    from simtrack.evaluation.mapping import map_scene, scene_metrics
    from simtrack.evaluation.metrics import write_metrics
    from simtrack.perception.mapping.panoptic.files import write_entities, write_surface
    from simtrack.perception.mapping.panoptic.map_file import FILE, read_map, write_map
    from simtrack.perception.mapping.panoptic.panoptic_map import PanopticMap, PanopticMapConfig
    from simtrack.perception.mapping.panoptic.regions import SwapConfig
    from simtrack.report.headline import format_metric
    from simtrack.report.map_page import HEADLINE, write_map_page
    from simtrack.simulation.building.rooms.film import FilmConfig

    config = PanopticMapConfig.of_method(method, voxel)
    if swap is not None:
        config = replace(config, swap=SwapConfig(swap))
    begun = PanopticMap(config) if onto is None else read_map(onto / FILE if onto.is_dir() else onto)
    film = FilmConfig(frames=frames, sensor=sensor)
    folder = out if out is not None else Path("runs") / f"map-{Path(source).name.replace(':', '-')}"
    with (
        console.ProgressLine(f"map {source}", "looking at the source", to_stderr=True) as line,
        new_folder(folder, overwrite, FILES, FOLDERS) as work,
        begun,
    ):
        given = map_source(source, segmenter, film, strength, seed, poses)
        mapped = map_scene(given, config, lambda k, n: line.show(f"frame {k} of {n}", k / n), begun)
        line.say("comparing with the truth" if mapped.seen is not None else "measuring")
        metrics = scene_metrics(mapped)
        write_entities(mapped.entities, work)
        write_surface(mapped.map, mapped.entities, work / "surface.ply")
        write_map(mapped.map, work / FILE)
        write_metrics(work / "metrics.json", metrics)
        line.say("report")
        write_map_page(mapped, metrics, work / "report.html")
    rows = [(label, format_metric(metrics[key])) for key, label in HEADLINE if key in metrics]
    console.show_table(("figure", "value"), rows, right=(1,))
    for reason, count in sorted(mapped.map.skipped.items()):
        print(f"{count} frames were skipped: {reason}")
    for reason, count in sorted(given.failures.items()):
        print(f"the segmenter failed on {count} frames: {reason}")
    console.show_written(folder, FILES)
    return 0
