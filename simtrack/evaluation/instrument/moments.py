"""The worst moments of a run: what the tracker's registration was given then, kept so that it can be done again."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from simtrack.contracts import NANOSECONDS, CameraIntrinsics, Float64
from simtrack.errors import FileFormatError
from simtrack.evaluation.tracking import ObjectFrame
from simtrack.perception.tracking.registration import RegistrationResult
from simtrack.perception.tracking.trace import RegistrationTrace

FOLDER, KEPT = "moments", 10
APART = NANOSECONDS // 2
"""Nanoseconds between two of them."""
UNTRACKED = 0.1
"""Metres: an object that should be tracked and is not counts as an error of that much."""
_RESULT = (
    "constrained", "rays", "supported", "occluded", "missing", "invalid", "stride", "residual", "misfit", "edges",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class TrueObject:
    """An object as it was."""

    name: str
    class_name: str
    track: int | None
    T_camera_object: Float64
    """(4, 4)."""
    visible_fraction: float


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One camera frame of a run."""

    frame: int
    """Number of the image, from 0."""
    error: float
    """Metres, the largest of an object that should be tracked."""
    worst: str
    """Name of that object."""
    trace: RegistrationTrace
    objects: tuple[TrueObject, ...]


class MomentKeeper:
    """Keeps the worst moments while a run goes on; a frame costs nothing unless it is one of them."""

    def __init__(self, after: int = NANOSECONDS) -> None:
        """`after`: nanoseconds; what is earlier does not count, no detection can have come by then."""
        self._after = after
        self.moments: list[Moment] = []

    def see(self, frame: int, trace: RegistrationTrace | None, objects: Sequence[ObjectFrame]) -> None:
        """Take one frame's registration and the truth."""
        scored = [thing for thing in objects if thing.scored]
        if trace is None or not scored or trace.stamp < self._after:
            return
        worst = max(scored, key=_error)
        error = _error(worst)
        near = [m for m in self.moments if abs(m.trace.stamp - trace.stamp) < APART]
        if any(m.error >= error for m in near) or (
            not near and len(self.moments) == KEPT and self.moments[-1].error >= error
        ):
            return
        true = tuple(
            TrueObject(
                o.name, o.class_name, o.track.id if o.track is not None else None, o.T_camera_object, o.visible_fraction
            )
            for o in objects
        )
        kept = [m for m in self.moments if all(m is not other for other in near)]
        found = Moment(frame, error, worst.name, trace, true)
        self.moments = sorted([*kept, found], key=lambda m: -m.error)[:KEPT]

    def save(self, folder: Path) -> None:
        """Write ``moments/FRAME.npz``; older files there go. Without moments no folder is made."""
        place = folder / FOLDER
        if self.moments:
            place.mkdir(exist_ok=True)
        names = {f"{moment.frame}.npz" for moment in self.moments}
        for old in place.glob("*.npz"):
            if old.name not in names:
                old.unlink()
        for moment in self.moments:
            path = place / f"{moment.frame}.npz"
            if not path.exists():
                _write(path, moment)


def _error(thing: ObjectFrame) -> float:
    return UNTRACKED if thing.track is None else min(thing.translation_error, UNTRACKED)


def _number(value: int | float) -> int | float:
    return value.item() if isinstance(value, np.generic) else value


def _write(path: Path, moment: Moment) -> None:
    trace = moment.trace
    document = {
        "frame": moment.frame, "error": moment.error, "worst": moment.worst, "stamp": trace.stamp,
        "intrinsics": asdict(trace.intrinsics), "classes": {str(k): v for k, v in trace.classes.items()},
        "results": {str(k): {name: _number(getattr(r, name)) for name in _RESULT} for k, r in trace.results.items()},
        "hypotheses": [{"class": h.class_name, "stamp": h.stamp, "score": h.score} for h in trace.hypotheses],
        "objects": [
            {"name": o.name, "class": o.class_name, "track": o.track, "visible": o.visible_fraction}
            for o in moment.objects
        ],
    }  # fmt: skip
    empty = np.zeros((0, 4, 4))
    arrays = {
        "depth": trace.depth, "T_map_camera": trace.T_map_camera,
        "predicted": np.array(list(trace.predicted.values())) if trace.predicted else empty,
        "registered": np.array([r.T_camera_object for r in trace.results.values()]) if trace.results else empty,
        "covariances": np.array([r.covariance for r in trace.results.values()]) if trace.results else empty,
        "hypotheses": np.array([h.T_camera_object for h in trace.hypotheses]) if trace.hypotheses else empty,
        "true": np.array([o.T_camera_object for o in moment.objects]),
    }  # fmt: skip
    temporary = path.with_name(f".{path.name}.part")
    with temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, document=np.str_(json.dumps(document)), **arrays)
    temporary.replace(path)


@dataclass(frozen=True, slots=True, eq=False)
class StoredMoment:
    """A moment as it is read again; hypotheses have class, stamp and pose."""

    frame: int
    error: float
    worst: str
    stamp: int
    depth: np.ndarray
    """(H, W) float32, metres."""
    intrinsics: CameraIntrinsics
    T_map_camera: Float64
    classes: Mapping[int, str]
    predicted: Mapping[int, Float64]
    results: Mapping[int, RegistrationResult]
    """As they were in the run."""
    hypotheses: tuple[tuple[str, int, Float64], ...]
    objects: tuple[TrueObject, ...]


def stored_frames(run: Path) -> list[int]:
    """Numbers of the frames whose moments a run's folder has."""
    return sorted(int(path.stem) for path in (run / FOLDER).glob("*.npz") if path.stem.isdecimal())


def kept_frames(run: Path) -> list[int]:
    """Numbers of the frames whose moments the folder of a run has, at least one.

    Raises:
        FileFormatError: it is not the folder of a run, or the run kept none.
    """
    import yaml

    file = run / "config.yaml"
    try:
        config = yaml.safe_load(file.read_text(encoding="utf-8"))
        scene, tracker = str(config["scene"]), config.get("tracker")
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError, AttributeError) as error:
        raise FileFormatError(run, "", "no such run; expected the folder of a `simtrack run`") from error
    if tracker:
        reason = f"only simtrack's own tracker keeps moments; the tracker of this run was '{tracker}'"
        raise FileFormatError(run, "tracker", reason)
    frames = stored_frames(run)
    if not frames:
        reason = (
            f"this run of {scene} kept no moment: none of the objects to be tracked was in view after the first second"
        )
        raise FileFormatError(run / FOLDER, "", reason)
    return frames


def read_moment(run: Path, frame: int) -> StoredMoment:
    """Read one moment of a run.

    Raises:
        FileFormatError: there is none of this frame, or the file cannot be read.
    """
    path = run / FOLDER / f"{frame}.npz"
    if not path.is_file():
        known = ", ".join(map(str, stored_frames(run))) or "none"
        raise FileFormatError(path, "", f"this frame was not kept; the run kept: {known}")
    try:
        with np.load(path, allow_pickle=False) as data:
            document = json.loads(str(data["document"]))
            arrays = {name: data[name] for name in data.files if name != "document"}
        ids = [int(k) for k in document["classes"]]
        numbers = [int(k) for k in document["results"]]
        results = {
            number: RegistrationResult(arrays["registered"][k], arrays["covariances"][k],
                                       **document["results"][str(number)])
            for k, number in enumerate(numbers)
        }  # fmt: skip
        detected = zip(document["hypotheses"], arrays["hypotheses"], strict=True)
        return StoredMoment(
            int(document["frame"]), float(document["error"]), str(document["worst"]), int(document["stamp"]),
            arrays["depth"], CameraIntrinsics(**document["intrinsics"]), arrays["T_map_camera"],
            {k: str(document["classes"][str(k)]) for k in ids}, dict(zip(ids, arrays["predicted"], strict=True)),
            results,
            tuple((h["class"], h["stamp"], T) for h, T in detected),
            tuple(
                TrueObject(o["name"], o["class"], o["track"], T, o["visible"])
                for o, T in zip(document["objects"], arrays["true"], strict=True)
            ),
        )  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise FileFormatError(path, "", f"no moment of a run: {error}") from error
