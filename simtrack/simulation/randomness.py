"""One seed, many independent streams: each purpose draws from its own, so that using one never changes another."""

from zlib import crc32

import numpy as np


def stream(seed: int, purpose: str) -> np.random.Generator:
    """Generator for one purpose (``camera``, ``lidar``, ``hand``, ...) of the run with this seed."""
    return np.random.default_rng(np.random.SeedSequence([seed, crc32(purpose.encode())]))
