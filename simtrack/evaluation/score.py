"""Scores results that were made elsewhere, from a run's log, against the truth in the run's folder.

Objects in the format of BOP's results (``scene_id,im_id,obj_id,score,R,t,time``; Hodan et al., "BOP: Benchmark for 6D
Object Pose Estimation", ECCV 2018), the robot's pose in TUM's (``stamp x y z qx qy qz qw``; Sturm et al., IROS 2012).
The metrics are those of `simtrack.evaluation.tracking` and `simtrack.evaluation.trajectory`, by the same names; what
such a file does not tell has no value and says why.
"""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simtrack.contracts import Float64, Localization, Status, Track, TrackStatus
from simtrack.errors import FileFormatError
from simtrack.evaluation.evaluator import pose_scorers
from simtrack.evaluation.metrics import Metrics, measured, ratio, unmeasured
from simtrack.evaluation.result_files import (
    BOP_HEADER,
    PoseRow,
    StampedPose,
    read_bop,
    read_tum,
)
from simtrack.evaluation.run_truth import RunTruth, TrueObject, read_truth
from simtrack.evaluation.tracking import TrackingEvaluator
from simtrack.evaluation.trajectory import SETTLED, TrajectoryEvaluator, absolute_errors
from simtrack.geometry.transforms import angle_between, rotation_from_quaternion
from simtrack.objects import load_object
from simtrack.simulation.ground_truth import ObjectTruth, Truth

NEAR = 5_000_000
"""Nanoseconds: a pose of a trajectory belongs to the image that is no farther away."""
IMPLAUSIBLE = 20.0
"""Distances of results that differ by this factor from the true ones are in neither millimetres nor metres."""
_NO_IDENTITY = "results in BOP's format say nothing of identity and status"
_NO_MAP = "results in BOP's format are in the camera's frame"
UNTOLD = {
    "tracking.false_tracks": ("1", _NO_IDENTITY),
    "tracking.id_switches": ("1", _NO_IDENTITY),
    "tracking.reacquisition_time.p95": ("s", _NO_IDENTITY),
    "tracking.reacquisitions": ("1", _NO_IDENTITY),
    "tracking.map.translation_error.median": ("m", _NO_MAP),
    "world.known_share": ("1", _NO_MAP),
}
"""Metrics of tracking that a file of poses without identities cannot give."""


@dataclass(frozen=True, slots=True)
class Score:
    """What a file of results is worth."""

    format: str
    """``BOP`` or ``TUM``."""
    metrics: Metrics
    findings: tuple[str, ...]
    """What was left out or concluded, a sentence each."""


def score(run: Path, results: Path) -> Score:
    """Score a file of results against the truth of a run.

    Args:
        run: folder of `simtrack run`.
        results: BOP or TUM file; which one is found out from its first line.

    Raises:
        FileFormatError: the folder is not that of a run, or nothing of the file can be used.

    """
    truth = read_truth(run)
    try:
        with results.open(encoding="utf-8") as file:
            first = file.readline(10_000)
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(results, "", f"cannot be read: {error}") from error
    if "obj_id" in first:
        return _score_objects(truth, results)
    if "," in first and not first.startswith("#"):
        raise FileFormatError(
            results, "line 1", f"expected the header {','.join(BOP_HEADER)}, found {first.strip()!r:.80}"
        )
    return _score_trajectory(truth, results)


# -------------------------------------------------------------------------------------------------------------- objects


def _score_objects(truth: RunTruth, path: Path) -> Score:
    rows, findings = read_bop(path)
    numbers = {stamp: image for image, stamp in enumerate(truth.stamps)}
    ids = {number: name for name, number in truth.object_ids.items()}
    strange, images, objects = Counter[str](), Counter[int](), Counter[int]()
    by_image: defaultdict[int, list[PoseRow]] = defaultdict(list)
    seen: set[tuple[object, ...]] = set()
    for row in rows:
        # Who works from the log may number images by their stamps.
        image = row.image if row.image < len(truth.stamps) else numbers.get(row.image, -1)
        key = (image, row.object_id, row.T_camera_object.tobytes())
        if not 0 <= image < len(truth.stamps):
            images[row.image] += 1
        elif row.object_id not in ids:
            objects[row.object_id] += 1
        elif key in seen:
            strange["duplicate"] += 1
        else:
            seen.add(key)
            by_image[image].append(row)
    if images:
        allowed = f"0 to {len(truth.stamps) - 1}, or the stamps in nanoseconds"
        findings.append(f"{sum(images.values())} rows of unknown images ({_few(images)}) left out; im_id: {allowed}")
    if objects:
        known = ", ".join(f"{number} {name}" for number, name in sorted(ids.items()))
        findings.append(f"{sum(objects.values())} rows of unknown objects ({_few(objects)}) left out; obj_id: {known}")
    if strange["duplicate"]:
        findings.append(f"{strange['duplicate']} duplicate rows left out")
    kept = [row for group in by_image.values() for row in group]
    if not kept:
        raise FileFormatError(path, "rows", "; ".join(["no row can be scored", *findings]))
    unit, said = _unit(kept, truth, path)
    findings.append(said)
    answered = len(by_image)
    evaluator = TrackingEvaluator(pose_scorers({name: load_object(name) for name in truth.scored_classes}))
    for image, stamp in enumerate(truth.stamps):
        tracks = [_as_track(row, unit, ids, stamp, n) for n, row in enumerate(by_image.get(image, ()), start=1)]
        things = truth.objects[stamp]
        evaluator.observe(tracks, _as_truth(stamp, things), {thing.name: thing.visible_fraction for thing in things})
    metrics = evaluator.metrics() | {name: unmeasured(*why) for name, why in UNTOLD.items()}
    matched = sum(frame.track is not None for frame in evaluator.frames)
    metrics["score.rows"] = measured(len(kept), "1")
    metrics["score.rows_left_out"] = measured(len(rows) - len(kept), "1")
    metrics["score.rows_matched_share"] = ratio(matched, len(kept), "no row")
    metrics["score.images_with_results"] = ratio(answered, len(truth.stamps), "no image")
    return Score("BOP", metrics, tuple(findings))


def _unit(rows: Sequence[PoseRow], truth: RunTruth, path: Path) -> tuple[float, str]:
    """Metres that 1 stands for: millimetres or metres, whichever makes distances from the camera like the true ones."""
    found = float(np.median([np.linalg.norm(row.T_camera_object[:3, 3]) for row in rows]))
    true = float(
        np.median([np.linalg.norm(o.T_camera_object[:3, 3]) for things in truth.objects.values() for o in things])
    )
    unit = min((0.001, 1.0), key=lambda u: abs(np.log(max(u * found, 1e-12) / true)))
    if not 1.0 / IMPLAUSIBLE < unit * found / true < IMPLAUSIBLE:
        reason = f"distances of {found:.3g} are neither millimetres nor metres; true ones are {true:.2f} m"
        raise FileFormatError(path, "t", reason)
    name = "metres" if unit == 1.0 else "millimetres"
    return (
        unit,
        f"translations are taken for {name}: the median distance is {unit * found:.2f} m, the true one {true:.2f} m",
    )


def _as_track(row: PoseRow, unit: float, ids: dict[int, str], stamp: int, number: int) -> Track:
    T = row.T_camera_object.copy()
    T[:3, 3] *= unit
    return Track(
        id=number, class_name=ids[row.object_id], status=TrackStatus.CONFIRMED, stamp=stamp, T_map_object=T,
        covariance=np.eye(6), T_camera_object=T, velocity=np.zeros(6), last_seen=stamp, visible_fraction=1.0,
        moving=False, residual=0.0, score=row.score,
    )  # fmt: skip


def _as_truth(stamp: int, things: Sequence[TrueObject]) -> Truth:
    """The truth as far as the folder has it, in the camera's frame, which stands for the map."""
    speeds = {moving: np.array([float(moving), 0.0, 0.0, 0.0, 0.0, 0.0]) for moving in (False, True)}
    objects = {
        thing.name: ObjectTruth(thing.name, thing.class_name, "catalogue", thing.T_camera_object, speeds[thing.moving])
        for thing in things
    }
    return Truth(stamp, np.eye(4), np.eye(4), np.eye(4), objects, frozenset(), frozenset())


# ----------------------------------------------------------------------------------------------------------- trajectory


def _score_trajectory(truth: RunTruth, path: Path) -> Score:
    poses, findings = read_tum(path)
    stamps = np.array(truth.stamps, dtype=np.int64)
    matched: dict[int, StampedPose] = {}
    strangers = 0
    for pose in poses:
        nearest = int(np.argmin(np.abs(stamps - pose.stamp)))
        if abs(int(stamps[nearest]) - pose.stamp) > NEAR:
            strangers += 1
        else:
            matched.setdefault(nearest, pose)
    duplicates = len(poses) - strangers - len(matched)
    span = f"{stamps[0] / 1e9:.3f} to {stamps[-1] / 1e9:.3f} s"
    if strangers:
        findings.append(
            f"{strangers} poses without an image within {NEAR / 1e6:g} ms left out; the run's are at {span}"
        )
    if duplicates:
        findings.append(f"{duplicates} further poses of images that have one already left out")
    if not matched:
        raise FileFormatError(path, "rows", "; ".join(["no pose can be scored", *findings]))
    chosen = sorted(matched)
    estimated = [matched[image].T_map_base for image in chosen]
    true = [truth.T_map_base[image] for image in chosen]
    unit = _trajectory_unit(estimated, true)
    if unit != 1.0:
        findings.append("positions are taken for millimetres: as metres they would be far from the true path")
        estimated = [_scaled(T, unit) for T in estimated]
    findings += _swapped_quaternions([matched[image] for image in chosen], true)
    evaluator = TrajectoryEvaluator(SETTLED)
    for image, T_estimated, T_true in zip(chosen, estimated, true, strict=True):
        found = Localization(truth.stamps[image], T_estimated, np.eye(6), Status.OK)
        evaluator.observe(truth.stamps[image], found, T_true)
    metrics = evaluator.metrics()
    metrics["localization.trusted_share"] = unmeasured("1", "TUM's format says nothing of status")
    metrics["localization.coverage"] = ratio(len(chosen), len(stamps), "no image")
    metrics["score.rows"] = measured(len(chosen), "1")
    metrics["score.rows_left_out"] = measured(strangers + duplicates, "1")
    return Score("TUM", metrics, tuple(findings))


def _trajectory_unit(estimated: Sequence[Float64], true: Sequence[Float64]) -> float:
    """Metres that 1 stands for: millimetres if the path is too long by far and they bring it nearer to the true one."""
    errors = [float(np.median(absolute_errors([_scaled(T, u) for T in estimated], true)[0])) for u in (1.0, 0.001)]
    lengths = [float(np.linalg.norm(np.ptp([T[:3, 3] for T in poses], axis=0))) for poses in (estimated, true)]
    return 0.001 if lengths[0] > IMPLAUSIBLE * lengths[1] and errors[1] < errors[0] / IMPLAUSIBLE else 1.0


def _scaled(T: Float64, unit: float) -> Float64:
    scaled = T.copy()
    scaled[:3, 3] *= unit
    return scaled


def _swapped_quaternions(poses: Sequence[StampedPose], true: Sequence[Float64]) -> list[str]:
    """A finding if the quaternions fit the truth in the order w x y z, and do not as they are defined."""
    as_read = np.median([angle_between(p.T_map_base[:3, :3], T[:3, :3]) for p, T in zip(poses, true, strict=True)])
    swapped = np.median(
        [angle_between(rotation_from_quaternion(p.quaternion), T[:3, :3]) for p, T in zip(poses, true, strict=True)]
    )
    if as_read > 0.2 and swapped < 0.2 * as_read:
        told = f"{np.degrees(as_read):.1f} deg from the truth (median), {np.degrees(swapped):.1f} deg in that order"
        return [f"the quaternions look like qw qx qy qz; TUM's order is qx qy qz qw: {told}"]
    return []


def _few(counter: Counter[int]) -> str:
    """The first few numbers of those that were counted."""
    some = ", ".join(str(number) for number in sorted(counter)[:5])
    return some + (", ..." if len(counter) > 5 else "")
