from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simtrack.contracts import StaticMap
from simtrack.simulation.building.cache import cached_map, cached_world, digest, world_digest
from simtrack.simulation.building.lab_room import lab_room
from simtrack.simulation.building.parts import StaticWorld
from simtrack.simulation.survey import survey


def same(a: Any, b: Any) -> bool:
    """Whether two trees of dataclasses, tuples and arrays are equal to the bit."""
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if hasattr(a, "__dataclass_fields__"):
        return all(same(getattr(a, field.name), getattr(b, field.name)) for field in fields(a))
    return a == b


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StaticWorld:
    monkeypatch.setenv("SIMTRACK_CACHE", str(tmp_path))
    return lab_room(np.random.default_rng(0))


def fail() -> Any:
    raise AssertionError("made again")


def test_what_is_kept_comes_back_to_the_bit(world: StaticWorld) -> None:
    assert same(cached_world("key", lambda: world), world)
    assert same(cached_world("key", fail), world)
    static_map: StaticMap = survey(world, None, np.random.default_rng(1))
    assert same(cached_map("key", lambda: static_map), static_map)
    assert same(cached_map("key", fail), static_map)


def test_broken_files_are_made_again(world: StaticWorld, tmp_path: Path) -> None:
    cached_world("key", lambda: world)
    (file,) = (tmp_path / "buildings").iterdir()
    file.write_bytes(file.read_bytes()[:1000])
    assert same(cached_world("key", lambda: world), world)
    assert same(cached_world("key", fail), world)


def test_keys_tell_contents_apart(world: StaticWorld) -> None:
    other = lab_room(np.random.default_rng(1))
    assert world_digest(world, 1) == world_digest(lab_room(np.random.default_rng(0)), 1)
    assert len({world_digest(world, 1), world_digest(world, 2), world_digest(other, 1), digest(1)}) == 4
