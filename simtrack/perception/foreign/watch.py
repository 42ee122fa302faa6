"""Calls with a time limit: what a foreign stage raises, answers too late or answers wrongly becomes a fault."""

import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from queue import SimpleQueue
from typing import TypeVar

import simtrack
from simtrack.errors import InvalidValueError

T = TypeVar("T")
_TEXT = 300
"""Characters of a message that are kept."""
_PACKAGE = Path(simtrack.__file__).parent


class FaultKind(StrEnum):
    """What was wrong with an answer."""

    RAISED = "raised"
    LATE = "late"
    """No answer within the limit, or the stage was still at work on an earlier frame."""
    INVALID = "invalid"
    """NaN, no rigid transform, an old stamp, an unknown class or the wrong type."""


class WrongAnswerError(ValueError):
    """A stage answered, and its answer cannot be used: says which field, and what it has to be."""


@dataclass(frozen=True, slots=True)
class StageFault:
    """A frame that a stage did not answer."""

    stage: str
    """``tracker``, ``localizer`` or ``detector``."""
    frame: int
    """Running number of the frames that the stage was handed, from 0."""
    stamp: int
    """Nanoseconds, of the frame."""
    kind: FaultKind
    message: str


class Watch:
    """Calls one stage, in a thread of its own: always the same one, since some libraries bind their state to it.

    A call that has not returned within the limit is left alone and its answer is dropped; until it returns, every
    further call is a fault at once, so that a stage that hangs costs its limit once.
    """

    def __init__(self, stage: str, limit: float) -> None:
        """`limit`: seconds of the wall clock for one call; InvalidValueError unless it is positive."""
        if not limit > 0.0:
            raise InvalidValueError("stage_limit", limit, "more than 0 seconds")
        self.stage, self.limit = stage, limit
        self.frames = 0
        """Frames that the stage was handed."""
        self.faults: list[StageFault] = []
        self._calls: SimpleQueue[tuple[Future[object], Callable[[], object]] | None] = SimpleQueue()
        self._pending: Future[object] | None = None
        # A daemon: a stage that hangs must not keep the process from ending.
        threading.Thread(target=self._serve, name=f"simtrack-{stage}", daemon=True).start()

    def call(self, stamp: int, work: Callable[[], T], wrong: Callable[[T], str], *, new_frame: bool = True) -> T | None:
        """The answer of one call, None if there is a fault.

        Args:
            stamp: of the frame, nanoseconds.
            work: asks the stage.
            wrong: what is wrong with an answer, empty if nothing is.
            new_frame: whether this is the first call for a frame.

        """
        self.frames += new_frame
        if self._pending is not None and not self._pending.done():
            self._note(stamp, FaultKind.LATE, "still at work on an earlier frame")
            return None
        future: Future[object] = Future()
        self._pending = future
        answer: list[T] = []
        self._calls.put((future, lambda: answer.append(work())))
        try:
            future.result(self.limit)
            reason = wrong(answer[0])
        except TimeoutError as error:
            if future.done():
                self._note(stamp, FaultKind.RAISED, _told(error))
            else:
                self._note(stamp, FaultKind.LATE, f"no answer within {self.limit:g} s")
            return None
        except WrongAnswerError as error:
            self._note(stamp, FaultKind.INVALID, str(error)[:_TEXT])
            return None
        except KeyboardInterrupt:  # of this thread: the user stops the run
            raise
        except BaseException as error:  # whatever it raises, `sys.exit` included, is its failure and not the run's
            self._note(stamp, FaultKind.RAISED, _told(error))
            return None
        if reason:
            self._note(stamp, FaultKind.INVALID, reason)
            return None
        return answer[0]

    def close(self) -> None:
        """Let the thread end when its last call has returned."""
        self._calls.put(None)

    def _note(self, stamp: int, kind: FaultKind, message: str) -> None:
        self.faults.append(StageFault(self.stage, max(self.frames - 1, 0), stamp, kind, message))

    def _serve(self) -> None:
        while (call := self._calls.get()) is not None:
            future, work = call
            try:
                future.set_result(work())
            except BaseException as error:
                future.set_exception(error)


def _told(error: BaseException) -> str:
    """Type and first line of an error, and where in the stage's code it was raised."""
    text = str(error).strip().partition("\n")[0]
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not Path(frame.filename).is_relative_to(_PACKAGE)]
    place = f" ({Path(own[-1].filename).name}:{own[-1].lineno}, in {own[-1].name})" if own else ""
    told = f"{type(error).__name__}: {text}" if text else type(error).__name__
    return told[: _TEXT - len(place)] + place
