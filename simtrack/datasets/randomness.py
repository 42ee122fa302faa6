"""Every frame's randomness follows from the seed, the scene and the frame: never from what was made before."""

from zlib import crc32

import numpy as np


def random_of(seed: int, purpose: str, scene: int, frame: int | None = None) -> np.random.Generator:
    """The generator for one purpose in one scene, or in one frame of it."""
    return np.random.default_rng(_sequence(seed, purpose, scene, frame))


def seed_of(seed: int, purpose: str, scene: int) -> int:
    """A seed, 0 to 2^31 - 1, for something that takes one."""
    return int(_sequence(seed, purpose, scene, None).generate_state(1)[0] >> 1)


def _sequence(seed: int, purpose: str, scene: int, frame: int | None) -> np.random.SeedSequence:
    key = [seed, crc32(purpose.encode()), scene]
    return np.random.SeedSequence(key if frame is None else [*key, frame])
