"""A tracker that is a program: JSON lines over its standard input and output (``docs/bring_your_own.md``).

A line each way for every frame. Matrices are lists of numbers, row-major; metres, nanoseconds; depth images are raw
little-endian float32 files, whose path the line names.
"""

import json
import shutil
import signal
import subprocess
import tempfile
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO

import numpy as np

from simtrack.contracts import Float64, PoseHypothesis, RgbdFrame, Status, Track, TrackerResult, TrackStatus
from simtrack.objects import ObjectModel
from simtrack.perception.foreign.answers import track_at
from simtrack.perception.foreign.watch import WrongAnswerError

PROTOCOL = "simtrack-tracker-1"
MAX_LINE = 10_000_000
"""Characters of one answer."""
START_LIMIT = 60.0
"""Seconds that a program may take until it is ready, before the run."""
MAX_STARTS = 4
"""How often a program is started in a run, the first time included; one that ends more often stays away."""


class ProcessTracker:
    """Starts a program and asks it frame by frame; implements `simtrack.contracts.Tracker`.

    Whoever calls sets the time limit (see `GuardedTracker`). A program that ended is started again, from nothing.
    """

    def __init__(self, command: Sequence[str], models: Mapping[str, ObjectModel]) -> None:
        """`command`: program and arguments; `models`: class name -> model of every object that can be tracked."""
        self._command, self._models = list(command), models
        self._folder: Path | None = None
        self._process: subprocess.Popen[str] | None = None
        self._starts = 0
        self._closed = False
        self._asking = False
        """An answer is being waited for, by another thread perhaps."""

    def update(
        self,
        frame: RgbdFrame,
        T_map_camera: Float64,
        covariance: Float64,
        hypotheses: Sequence[PoseHypothesis] = (),
    ) -> TrackerResult:
        """See `Tracker.update`.

        Raises:
            OSError: the program cannot be started, has ended, or does not read.
            WrongAnswerError: its answer is not what the protocol asks for; says which field.

        """
        self._asking = True
        try:
            answer = self._ask(frame, T_map_camera, covariance, hypotheses)
        finally:
            self._asking = False
        return _result(answer, frame, T_map_camera)

    def start(self, limit: float = START_LIMIT) -> None:
        """Start the program and wait until it is ready: what it loads at first shall not cost it images.

        Raises:
            OSError: it cannot be started, has ended, or has not said that it is ready within `limit` seconds.
            WrongAnswerError: it said something else.
        """
        late = threading.Event()

        def stop() -> None:
            late.set()
            if self._process is not None:
                self._process.kill()

        timer = threading.Timer(limit, stop)
        timer.start()
        try:
            self._running()
        except OSError as error:
            if late.is_set():
                raise TimeoutError(f'it did not say {{"type": "ready"}} within {limit:g} s') from error
            raise
        finally:
            timer.cancel()

    def _ask(
        self, frame: RgbdFrame, T_map_camera: Float64, covariance: Float64, hypotheses: Sequence[PoseHypothesis]
    ) -> dict[str, object]:
        """The answer to a frame."""
        process = self._running()
        assert self._folder is not None
        K, depth = frame.intrinsics, self._folder / "depth.f32"
        frame.depth.astype("<f4").tofile(depth)
        asked = {
            "type": "frame", "stamp": frame.stamp, "width": K.width, "height": K.height,
            "fx": K.fx, "fy": K.fy, "cx": K.cx, "cy": K.cy, "depth": str(depth),
            "T_map_camera": T_map_camera.ravel().tolist(), "covariance": covariance.ravel().tolist(),
            "hypotheses": [_hypothesis(h) for h in hypotheses],
        }  # fmt: skip
        _say(process, asked)
        answer = self._hear(process)
        # What it said to an earlier frame, which nobody waited for, comes first.
        while isinstance(stamp := answer.get("stamp"), int) and stamp < frame.stamp:
            answer = self._hear(process)
        return answer

    def close(self) -> None:
        """End the program: by the end of its input, or by force if it is at work or does not end within a second."""
        self._closed = True
        self._end()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        if self._asking:  # its streams are in use, and are free only when it is gone
            process.kill()
        _close(process.stdin)
        try:
            process.wait(1.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        _close(process.stdout)

    def _running(self) -> subprocess.Popen[str]:
        """The program, started if it does not run; it is told of the models and has to say that it is ready."""
        if self._process is not None and self._process.poll() is None:
            return self._process
        if self._closed or self._starts >= MAX_STARTS:
            raise ChildProcessError(f"the program has ended {self._starts} times and is not started again")
        self._end()
        self._starts += 1
        folder = self._models_folder()
        self._process = process = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, encoding="utf-8", bufsize=1
        )
        models = [
            {"name": name, "mesh": str(folder / f"{number}.ply"), "diameter": model.diameter,
             "extents": model.extents.tolist()}
            for number, (name, model) in enumerate(sorted(self._models.items()))
        ]  # fmt: skip
        _say(process, {"type": "models", "protocol": PROTOCOL, "models": models})
        if (answer := self._hear(process)).get("type") != "ready":
            raise WrongAnswerError(f'the answer to the models has to be {{"type": "ready"}}, not {answer!r:.200}')
        return process

    def _models_folder(self) -> Path:
        from simtrack.objects.export import write_ply

        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="simtrack-tracker-"))
            for number, (_, model) in enumerate(sorted(self._models.items())):
                write_ply(self._folder / f"{number}.ply", model.mesh)
        return self._folder

    def _hear(self, process: subprocess.Popen[str]) -> dict[str, object]:
        """One line, as an object."""
        assert process.stdout is not None
        line = process.stdout.readline(MAX_LINE)
        if not line:
            raise ChildProcessError(f"the program has ended with {_ending(process.wait())}")
        try:
            answer = json.loads(line)
        except ValueError as error:
            raise WrongAnswerError(f"the answer is not JSON: {line[:120]!r}") from error
        if not isinstance(answer, dict):
            raise WrongAnswerError(f"the answer is not a JSON object: {line[:120]!r}")
        return answer


def _ending(code: int) -> str:
    """An exit code in words; negative ones are signals."""
    with suppress(ValueError):
        return f"signal {signal.Signals(-code).name}"
    return f"exit code {code}"


def _say(process: subprocess.Popen[str], message: Mapping[str, object]) -> None:
    assert process.stdin is not None
    process.stdin.write(json.dumps(message) + "\n")
    process.stdin.flush()


def _close(stream: IO[str] | None) -> None:
    try:
        if stream is not None:
            stream.close()
    except OSError:  # what was still to be written has no reader any more
        return


def _hypothesis(h: PoseHypothesis) -> dict[str, object]:
    return {
        "class": h.class_name, "stamp": h.stamp, "T_camera_object": h.T_camera_object.ravel().tolist(),
        "covariance": h.covariance.ravel().tolist(), "score": h.score,
    }  # fmt: skip


def _result(answer: Mapping[str, object], frame: RgbdFrame, T_map_camera: Float64) -> TrackerResult:
    stamp, tracks = answer.get("stamp"), answer.get("tracks")
    if not isinstance(stamp, int) or not isinstance(tracks, list):
        raise WrongAnswerError("an answer needs an integer 'stamp' and a list 'tracks'")
    return TrackerResult(stamp, tuple(_track(entry, frame, T_map_camera) for entry in tracks), Status.OK)


def _track(entry: object, frame: RgbdFrame, T_map_camera: Float64) -> Track:
    if not isinstance(entry, dict):
        raise WrongAnswerError(f"an entry of 'tracks' is not an object: {entry!r:.100}")
    for field in ("id", "class", "T_camera_object"):
        if field not in entry:
            raise WrongAnswerError(f"a track has no '{field}'; it needs id, class, T_camera_object")
    status = entry.get("status", TrackStatus.CONFIRMED.value)
    if status not in set(TrackStatus):
        raise WrongAnswerError(f"a track's status is {status!r}; allowed: {', '.join(TrackStatus)}")
    return track_at(
        frame, T_map_camera, entry["id"], str(entry["class"]), _matrix(entry["T_camera_object"]),
        status=TrackStatus(status),
        translation_sigma=_number(entry, "translation_sigma", 0.005),
        rotation_sigma=_number(entry, "rotation_sigma", 0.05),
        score=_number(entry, "score", 0.9),
    )  # fmt: skip


def _matrix(value: object) -> Float64:
    """(4, 4) of 16 numbers, row by row."""
    with suppress(TypeError, ValueError):
        found = np.array(value, dtype=float)
        if found.size == 16 and np.isfinite(found).all():
            return found.reshape(4, 4)
    raise WrongAnswerError(f"a track's T_camera_object is not 16 finite numbers: {value!r:.100}")


def _number(entry: Mapping[str, object], field: str, default: float) -> float:
    value = entry.get(field, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise WrongAnswerError(f"a track's {field} is no number: {value!r:.100}")
    return float(value)
