"""``simtrack evaluate``: what a stage achieves over many scenes, against the truth."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from simtrack.perception.mapping.panoptic.panoptic_map import Method


def evaluate(
    what: Annotated[Literal["reconstruction", "panoptic", "detector"], tyro.conf.Positional],
    rooms: str = "all",
    entities: Literal["true", "partial", "both"] = "both",
    stages: Literal["graph", "models", "physics"] = "physics",
    method: Literal["full", "no-joint-fusion", "voxbloxpp", "all"] = "all",
    strength: float = 1.0,
    segmenter: str = "oracle",
    poses: Literal["true", "estimated", "noisy"] = "true",
    frames: int = 300,
    voxel: float = 0.02,
    out: Path = Path("reports"),
    work: Path | None = None,
    workers: int | None = None,
    data: Path | None = None,
    detector: str = "keypoints",
    count: int | None = None,
) -> int:
    """Measure a part against the truth: reconstruction or maps of many rooms, or the detector on labelled images.

    Of rooms, the same command carries on where a stopped one was; those that the same code has done are not done again.

    Args:
        what: reconstruction: contact graph, CAD models, physics; panoptic: maps of filmed rooms; detector: boxes,
            keypoints and poses.
        rooms: all evaluation rooms, or some: 101,102 or 1-20 or kitchen:2.
        entities: Of a reconstruction: complete meshes, partial ones as a camera sees them on a walk, or both.
        stages: Of a reconstruction: the contact graph alone, CAD models too, or the check of physics as well.
        method: Of a map: full, one of those that it is compared with, or all of them.
        strength: Of the errors of the oracle that segments the images, 0 to 3.
        segmenter: Of a map: oracle, learned (the network that comes along), or what `simtrack map` takes.
        poses: Of a map's camera: true, estimated by odometry from the images, or noisy.
        frames: Of each room's film.
        voxel: Metres, of the maps.
        out: Folder for the results, WHAT.json and WHAT.txt.
        work: Folder where rooms are kept as they are done; runs/evaluate-WHAT if not given.
        workers: Processes of a reconstruction; one a core if not given. Maps are made one after the other.
        data: Detector: folder of a generated data set with the format bop that it was not trained on.
        detector: keypoints (the networks that come along), a folder that `simtrack train detector` wrote, or a
            YOLOv8-pose .onnx file.
        count: Detector: images at most.
    """
    from simtrack.errors import InvalidValueError

    if workers is not None and workers < 1:
        raise InvalidValueError("workers", workers, "1 or more")
    if out.exists() and not out.is_dir():
        raise InvalidValueError("out", str(out), "a folder, but this is a file")
    folder = work if work is not None else Path("runs") / f"evaluate-{what}"
    if what == "detector":
        return _detector(data, detector, count, out)
    if what == "panoptic":
        return _panoptic(rooms, method, strength, segmenter, poses, frames, voxel, out, folder)
    return _reconstruction(rooms, entities, stages, out, folder, workers)


def _detector(data: Path | None, detector: str, count: int | None, out: Path) -> int:
    from simtrack.cli import console
    from simtrack.errors import InvalidValueError, MissingValueError
    from simtrack.evaluation.detector import evaluate_detector, write_scores
    from simtrack.perception.detection.loading import make_image_detector
    from simtrack.training.source import open_source

    if data is None:
        raise MissingValueError("--data", "the folder of a data set that `simtrack generate` made with the format bop")
    if count is not None and count < 1:
        raise InvalidValueError("count", count, "1 or more")
    source = open_source(data)
    models = {model.name: model for model in source.models}
    opened = make_image_detector(detector, models)
    with console.ProgressLine("evaluate detector", "compiling") as line:
        scores = evaluate_detector(source, opened, count, lambda done, of: line.show(f"{done}/{of} images", done / of))
    metrics = scores.metrics()
    rows = [(n, f"({m.reason})" if m.value is None else f"{m.value:.4g}", m.unit) for n, m in metrics.items()]
    console.show_table(("figure", "value", "unit"), rows, right=(1,))
    console.show_written(out, write_scores(metrics, len(scores.found), data.name, out))
    return 0


def _panoptic(
    rooms: str,
    method: "Method | Literal['all']",
    strength: float,
    segmenter: str,
    poses: Literal["true", "estimated", "noisy"],
    frames: int,
    voxel: float,
    out: Path,
    work: Path,
) -> int:
    from simtrack.cli import console
    from simtrack.errors import InvalidValueError
    from simtrack.evaluation.panoptic_rooms import RoomMapTask, evaluate_maps, summed, tables_of, write_panoptic
    from simtrack.evaluation.reconstruction_rooms import parse_rooms
    from simtrack.perception.mapping.panoptic.panoptic_map import METHODS
    from simtrack.perception.mapping.panoptic.volume import VolumeConfig
    from simtrack.simulation.building.rooms.film import FilmConfig

    if not 0.0 <= strength <= 3.0:
        raise InvalidValueError("strength", strength, "0 to 3")
    FilmConfig(frames=frames)  # refuse bad values before hours of work
    VolumeConfig(voxel=voxel)
    methods = METHODS if method == "all" else (method,)
    how = {"strength": strength, "frames": frames, "voxel": voxel, "segmenter": segmenter, "poses": poses}
    tasks = [RoomMapTask(seed, kitchen, methods, **how) for seed, kitchen in parse_rooms(rooms)]
    with console.ProgressLine("evaluate panoptic", "looking for rooms that are done") as line:
        try:
            done, failed = evaluate_maps(tasks, work, line.show)
        except KeyboardInterrupt:
            console.show_error("stopped: rooms that are done are kept, and the same command carries on")
            return 130
    for room, reason in failed:
        console.show_error(f"{room} could not be mapped: {reason}")
    if not done:
        return 2
    total = {name: summed([results[name] for results in done.values()]) for name in methods}
    for title, (columns, rows) in tables_of(done, total).items():
        if rows:
            print(title)
            console.show_table(columns, rows, right=range(1, len(columns)))
    console.show_written(out, write_panoptic(done, out))
    return 2 if failed else 0


def _reconstruction(
    rooms: str,
    entities: Literal["true", "partial", "both"],
    stages: Literal["graph", "models", "physics"],
    out: Path,
    work: Path,
    workers: int | None,
) -> int:
    from simtrack.cli import console
    from simtrack.evaluation.reconstruction import ENTITIES
    from simtrack.evaluation.reconstruction_rooms import (
        RoomTask,
        evaluate_rooms,
        figures,
        parse_rooms,
        table_5,
        write_results,
    )

    kinds = ENTITIES if entities == "both" else (entities,)
    tasks = [RoomTask(seed, kitchen, kind, stages) for seed, kitchen in parse_rooms(rooms) for kind in kinds]
    size = min(workers or len(os.sched_getaffinity(0)), len(tasks))
    with console.ProgressLine("evaluate reconstruction", "looking for rooms that are done") as line:
        try:
            results = evaluate_rooms(
                tasks, work, size, lambda done, of, state: line.show(f"{done}/{of} · {state}", done / of)
            )
        except KeyboardInterrupt:
            console.show_error("stopped: rooms that are done are kept, and the same command carries on")
            return 130
    for room, reason in results.failed:
        console.show_error(f"{room} could not be evaluated: {reason}")
    if not results.done:
        return 2
    columns, rows = table_5(results.done)
    console.show_table(columns, rows, right=range(1, len(columns)))
    values = [
        (name, f"({m.reason})" if m.value is None else f"{m.value:.4g}", m.unit)
        for name, m in figures(results.done).items()
    ]
    console.show_table(("figure", "value", "unit"), values, right=(1,))
    console.show_written(out, write_results(results.done, out))
    return 2 if results.failed else 0
