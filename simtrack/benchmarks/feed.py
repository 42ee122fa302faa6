"""A recorded feed that a process of its own unpacks ahead, as drivers of sensors are other processes on a robot.

Arrays travel through a ring of shared memory, all else through a pipe: whoever takes a frame copies it, and does
nothing else of the work.
"""

import multiprocessing
import pickle
from multiprocessing.connection import Connection
from multiprocessing.shared_memory import SharedMemory
from multiprocessing.synchronize import Event, Semaphore
from pathlib import Path
from types import TracebackType

from simtrack.contracts import SensorFrame
from simtrack.errors import SimtrackError

SLOT = 4 * 2**20
"""Bytes for the arrays of one frame: an image of 640x480 with depth and colour needs half of it."""
SLOTS = 48
"""Frames with arrays that are unpacked ahead: more than a second of them."""


class Feed:
    """Frames of a recording in their order, unpacked ahead; a context manager.

    ::

        with Feed(path) as feed:
            while (frame := feed.take()) is not None:
                ...
    """

    def __init__(self, path: Path) -> None:
        """Start the process and wait until it is ahead, or at the end."""
        context = multiprocessing.get_context("spawn")
        self._memory = SharedMemory(create=True, size=SLOTS * SLOT)
        self._free, ahead = context.Semaphore(SLOTS), context.Event()
        self._pipe, theirs = context.Pipe(duplex=False)
        self._slot = 0
        arguments = (path, self._memory.name, self._free, ahead, theirs)
        self._process = context.Process(target=_unpack, args=arguments, daemon=True)
        self._process.start()
        theirs.close()
        while not ahead.wait(0.1) and self._process.is_alive():
            pass

    def take(self) -> SensorFrame | None:
        """The next frame; None at the end.

        Raises:
            SimtrackError: the recording cannot be read any further.
            EOFError: the process has ended before its time.
        """
        message, sizes = self._pipe.recv()
        if not sizes:
            frame = pickle.loads(message)  # of our own process
            if isinstance(frame, str):
                raise SimtrackError(frame)
            return frame
        start, copies, shared = self._slot * SLOT, [], _buffer(self._memory)
        for size in sizes:
            copies.append(bytearray(shared[start : start + size]))
            start += size
        self._slot = (self._slot + 1) % SLOTS
        self._free.release()
        return pickle.loads(message, buffers=copies)

    def close(self) -> None:
        """End the process and release the memory."""
        self._process.kill()
        self._process.join()
        self._pipe.close()
        self._memory.close()
        self._memory.unlink()

    def __enter__(self) -> "Feed":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _unpack(path: Path, memory: str, free: Semaphore, ahead: Event, pipe: Connection) -> None:
    """What the process does: send every frame, then None; what goes wrong is told in the place of a frame."""
    from simtrack.recordings import open_recording

    shared, slot = SharedMemory(memory), 0
    room = _buffer(shared)
    try:
        for frame in open_recording(path).sensor_frames():
            buffers: list[pickle.PickleBuffer] = []
            message = pickle.dumps(frame, protocol=5, buffer_callback=buffers.append)
            arrays = [buffer.raw() for buffer in buffers]
            if sum(array.nbytes for array in arrays) > SLOT:
                raise ValueError(f"{type(frame).__name__} of more than {SLOT} bytes")
            if arrays and not free.acquire(block=False):
                ahead.set()
                free.acquire()
            start = slot * SLOT
            for array in arrays:
                room[start : start + array.nbytes] = array
                start += array.nbytes
            slot = (slot + bool(arrays)) % SLOTS
            pipe.send((message, [array.nbytes for array in arrays]))
        pipe.send((pickle.dumps(None), []))
    except Exception as error:
        pipe.send((pickle.dumps(str(error)), []))
    finally:
        ahead.set()
        room.release()
        shared.close()
        pipe.close()


def _buffer(memory: SharedMemory) -> memoryview:
    assert memory.buf is not None, "the memory is closed"
    return memory.buf
