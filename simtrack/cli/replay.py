"""``simtrack replay``: feed the stack, or the stages that need no robot, from a recording."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from simtrack.evaluation.metrics import Metrics

HEADLINE = (
    "localization.located", "localization.residual.median", "localization.residual.p95",
    "localization.translation_error.median", "localization.rotation_error.median", "map.residual.median",
    "map.residual.p95", "depth.difference.median", "map.covered", "map.explained", "presegmentation.unknown",
    "objects.depth_difference.median", "tracking.recall", "tracking.translation_error.median",
    "tracking.rotation_error.median", "run.frames",
)  # fmt: skip
"""Metrics of a replay without a robot that are printed."""


def replay(
    source: Annotated[Path, tyro.conf.Positional],
    out: Path | None = None,
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    intrinsics: tuple[float, float, float, float] | None = None,
    depth_unit: float | None = None,
    view: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    rrd: Path | None = None,
    threads: int | None = None,
) -> int:
    """Feed the perception stack from a recording, whose format is found out by itself.

    An MCAP file that `simtrack run --log` wrote feeds the whole stack: the same estimates as when it was made, or those
    of a changed stack. A VLP-16 capture (.pcap), a KITTI velodyne folder or a folder of PLY scans, and an RGB-D folder
    (TUM, 7-Scenes, Open3D, BOP scene) feed the stages that need no robot: the first frame becomes a mesh map, in which
    later ones are localized, compared and pre-segmented.

    Args:
        source: File or folder to replay.
        out: Folder for the results; runs/NAME-replay if not given.
        overwrite: Replace the results in an existing folder.
        intrinsics: fx fy cx cy in pixels, of RGB-D folders that do not say them.
        depth_unit: Metres that 1 stands for in depth images, where it is not what the format says.
        view: Show the replay of an MCAP file live in rerun (needs the extra viz).
        rrd: Save the replay of an MCAP file for rerun in this file (needs the extra viz).
        threads: Threads of the compiled kernels; all cores if not given.
    """
    from simtrack.recordings import find_source, is_mcap

    folder = out if out is not None else Path("runs") / f"{source.resolve().stem}-replay"
    source = source if is_mcap(source) else find_source(source)
    if is_mcap(source):
        return _replay_stack(source, folder, overwrite, view, rrd, threads)
    from simtrack.cli import console
    from simtrack.errors import InvalidValueError
    from simtrack.evaluation.sensor_replay import SensorReplay
    from simtrack.recordings import CameraOptions, open_log

    if view or rrd is not None:
        raise InvalidValueError("view, rrd", str(source), "only with an MCAP file")
    log = open_log(source, CameraOptions(intrinsics, depth_unit))
    with console.ProgressLine(f"replay of {log.path.name}", log.format) as line:
        metrics, stopped = SensorReplay(log, folder, overwrite, threads, line.update).run()
    _summarise(metrics)
    console.show_written(folder, ["estimates.csv", "frames.csv", "metrics.json", "map.ply"])
    if stopped:
        console.show_error(f"stopped after {metrics['run.frames'].value} frames: the results are partial")
    return 130 if stopped else 0


def _replay_stack(
    recording: Path, folder: Path, overwrite: bool, view: bool, rrd: Path | None, threads: int | None
) -> int:
    from simtrack.cli import console
    from simtrack.cli.run import _observers
    from simtrack.evaluation.replay import Replay

    with console.ProgressLine(f"replay of {recording.name}") as line:
        partial = Replay(recording, folder, overwrite, threads, line.update, _observers(view, rrd)).run()
    console.show_written(folder, ["estimates.csv", "tracks.csv", "graph.json"])
    return 130 if partial else 0


def _summarise(metrics: "Metrics") -> None:
    """Print what was measured."""
    from simtrack.cli import console
    from simtrack.report.headline import format_metric

    rows = [
        (name, format_metric(metrics[name])) for name in HEADLINE if name in metrics and metrics[name].value is not None
    ]
    console.show_table(("metric", "value"), rows, right=(1,))
