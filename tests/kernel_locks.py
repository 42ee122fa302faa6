"""Kernels are compiled once for all processes that run the tests at the same time.

numba keeps compiled kernels on disk, but processes that come to need one at the same time each compile it; with cold
caches that is a large part of what the tests cost.
"""

import fcntl
import os
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def compile_kernels_once() -> None:
    """Have this process wait for a kernel that another one is compiling, and load it then."""
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.dispatcher import Dispatcher

    file = (Path(tempfile.gettempdir()) / f"simtrack-kernels-{os.getuid()}.lock").open("w")
    compile_now = Dispatcher.compile

    def compile_alone(self: Any, sig: Any) -> Any:
        # One lock a kernel: a kernel asks for those that it calls while it holds its own, so that none can wait for
        # another in a circle. Threads of this process stand in numba's own line first, for the same reason.
        kernel = zlib.crc32(f"{self.py_func.__code__.co_filename} {self.py_func.__qualname__}".encode())
        with global_compiler_lock, _locked(file.fileno(), kernel):
            return compile_now(self, sig)

    Dispatcher.compile = compile_alone


@contextmanager
def _locked(file: int, byte: int) -> Iterator[None]:
    """Hold the lock of one byte of a file; a process that has it already gets it again."""
    fcntl.lockf(file, fcntl.LOCK_EX, 1, byte)
    try:
        yield
    finally:
        fcntl.lockf(file, fcntl.LOCK_UN, 1, byte)
