"""Generation on a real Ray cluster on this machine: the same bytes as elsewhere, also when a worker is killed."""

import io
import os
import subprocess
import sys
import tarfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from simtrack.datasets import distributed
from simtrack.datasets.distributed import RayPool
from simtrack.datasets.engine import generate, ray_pool
from simtrack.datasets.folder import SceneMarker, read_markers
from simtrack.datasets.scene_maker import SceneReady, SourceFactory
from simtrack.datasets.writer import DatasetWriter
from simtrack.errors import DatasetError
from tests.datasets.tiny import FRAMES_PER_SCENE, InlinePool, PlainWriter, TinyFactory, tree

ray = pytest.importorskip("ray", reason="the extra distributed is not installed")

ROOT = Path(__file__).parents[2]
WRITERS: Sequence[DatasetWriter] = (PlainWriter(),)
SCENES = 5
COUNT = SCENES * FRAMES_PER_SCENE


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    out = tmp_path_factory.mktemp("reference") / "set"
    generate(TinyFactory(), WRITERS, out, COUNT, InlinePool)
    return tree(out)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """One cluster for all tests: starting one takes seconds."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    environment = {"env_vars": {"PYTHONPATH": str(ROOT)}}
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="error", runtime_env=environment)
    yield ray
    ray.shutdown()


def test_the_same_bytes(cluster: Any, reference: dict[str, bytes], tmp_path: Path) -> None:
    generate(TinyFactory(), WRITERS, tmp_path / "set", COUNT, ray_pool(2))
    assert tree(tmp_path / "set") == reference


def test_a_worker_killed_midway_is_replaced(cluster: Any, reference: dict[str, bytes], tmp_path: Path) -> None:
    factory = TinyFactory(trouble={1: "die once", 2: "die once"}, scratch=tmp_path)
    generate(factory, WRITERS, tmp_path / "set", COUNT, ray_pool(2))
    assert (tmp_path / "tries-1").stat().st_size == 2
    assert tree(tmp_path / "set") == reference


def test_a_scene_that_always_kills_its_worker_is_named(cluster: Any, tmp_path: Path) -> None:
    factory = TinyFactory(trouble={1: "die"}, scratch=tmp_path)
    with pytest.raises(DatasetError, match=r"scene 1: its worker was lost: .*3 times"):
        generate(factory, WRITERS, tmp_path / "set", COUNT, ray_pool(1))
    assert set(read_markers(tmp_path / "set")) == {0, 2, 3, 4}


def test_workers_without_the_folder_send_archives(cluster: Any, reference: dict[str, bytes], tmp_path: Path) -> None:
    factory = TinyFactory(trouble={3: "die once"}, scratch=tmp_path)

    def pool(factory: SourceFactory, writers: Sequence[DatasetWriter], staging: Path) -> RayPool:
        return RayPool(factory, writers, 2, staging, shared=False)

    generate(factory, WRITERS, tmp_path / "set", COUNT, pool)
    assert tree(tmp_path / "set") == reference
    links = (tmp_path / "set" / "plain" / "images" / "000003").iterdir()
    assert {path.stat().st_nlink for path in links} == {2}, "hard links stay hard links"


def test_archives_come_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distributed, "CHUNK", 10_000)
    actor = distributed.SceneActor(TinyFactory(), WRITERS, tmp_path / "nowhere")
    *frames, ready = list(actor.make(0, tmp_path / "unused"))
    parts = [event.data for event in frames if isinstance(event, distributed.ArchivePart)]
    assert isinstance(ready, SceneReady)
    assert len(parts) > 2
    assert max(map(len, parts)) <= 10_000
    assert not (tmp_path / "unused").exists()
    with tarfile.open(fileobj=io.BytesIO(b"".join(parts))) as archive:
        archive.extractall(tmp_path / "scene", filter="data")
    assert SceneMarker.of(tmp_path / "scene", 0, FRAMES_PER_SCENE, ready.marker.units) == ready.marker


def test_wrong_addresses_are_told_soon(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from simtrack.datasets.engine import generate, ray_pool\n"
        "from simtrack.errors import InvalidValueError; from tests.datasets.tiny import PlainWriter, TinyFactory\n"
        "for address in sys.argv[2:]:\n"
        "    try: generate(TinyFactory(), (PlainWriter(),), Path(sys.argv[1]), 4, ray_pool(1, address))\n"
        "    except InvalidValueError as error: print(error)\n"
    )
    arguments = [sys.executable, "-c", code, str(tmp_path / "set"), "127.0.0.1:9", "nonsense"]
    run = subprocess.run(arguments, capture_output=True, text=True, cwd=ROOT, timeout=100, check=True)
    first, second = run.stdout.splitlines()
    assert "127.0.0.1:9" in first
    assert "running Ray cluster" in first
    assert "nonsense" in second
