"""Generation: the same bytes whatever happens on the way, and clear words when it cannot go on."""

import fcntl
import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from simtrack.datasets import engine, folder
from simtrack.datasets.engine import GenerationProgress, generate, local_pool
from simtrack.datasets.local import LocalPool
from simtrack.errors import DatasetError, InvalidValueError
from tests.datasets.tiny import FRAMES_PER_SCENE, InlinePool, PlainWriter, TinyFactory, tree

ROOT = Path(__file__).parents[2]
WRITERS = (PlainWriter(),)
SCENES = 6
COUNT = SCENES * FRAMES_PER_SCENE


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The tree of a run that nothing disturbed."""
    out = tmp_path_factory.mktemp("reference") / "set"
    summary = generate(TinyFactory(), WRITERS, out, COUNT, local_pool(1))
    assert (summary.scenes, summary.frames, summary.made) == (SCENES, COUNT, COUNT)
    return tree(out)


def test_a_data_set_is_all_of_its_parts(reference: dict[str, bytes]) -> None:
    assert {name.split("/")[0] for name in reference} == {"recipe.yaml", "dataset.json", "scenes", "plain"}
    about = json.loads(reference["dataset.json"])
    assert about["complete"] is True
    assert (about["scenes"], about["frames"], about["seed"]) == (SCENES, COUNT, 0)
    assert reference["recipe.yaml"].decode() == TinyFactory().recipe
    markers = [json.loads(reference[f"scenes/{scene:06d}.json"]) for scene in range(SCENES)]
    assert [marker["frames"] for marker in markers] == [FRAMES_PER_SCENE] * SCENES
    assert markers[3]["units"] == ["plain/images/000003", "plain/logs/000003.json"]
    assert markers[3]["files"] == 2 * FRAMES_PER_SCENE + 1
    # hard links are one file on the disk
    images = [reference[f"plain/images/000003/{k:06d}.bin"] for k in range(FRAMES_PER_SCENE)]
    assert markers[3]["bytes"] == sum(map(len, images)) + len(reference["plain/logs/000003.json"])
    assert len(json.loads(reference["plain/index.json"])) == SCENES


def test_workers_do_not_change_a_byte(reference: dict[str, bytes], tmp_path: Path) -> None:
    generate(TinyFactory(), WRITERS, tmp_path / "set", COUNT, local_pool(2))
    assert tree(tmp_path / "set") == reference


def test_seeds_do_change_bytes(reference: dict[str, bytes], tmp_path: Path) -> None:
    generate(TinyFactory(seed=1), WRITERS, tmp_path / "set", FRAMES_PER_SCENE, InlinePool)
    assert tree(tmp_path / "set")["plain/logs/000000.json"] != reference["plain/logs/000000.json"]


def test_larger_count_extends_and_smaller_is_refused(reference: dict[str, bytes], tmp_path: Path) -> None:
    out = tmp_path / "set"
    generate(TinyFactory(), WRITERS, out, 3, InlinePool)
    summary = generate(TinyFactory(), WRITERS, out, COUNT, InlinePool)
    assert summary.made == COUNT - FRAMES_PER_SCENE
    assert tree(out) == reference
    with pytest.raises(DatasetError, match=r"holds 6 scenes already, and 2 are asked for.*\(24\)"):
        generate(TinyFactory(), WRITERS, out, 8, InlinePool)
    assert tree(out) == reference


def test_nothing_is_made_twice(reference: dict[str, bytes], tmp_path: Path) -> None:
    out = tmp_path / "set"
    generate(TinyFactory(), WRITERS, out, COUNT, InlinePool)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    assert generate(TinyFactory(), WRITERS, out, COUNT, InlinePool).made == 0
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.bin")} == {
        path: stamp for path, stamp in before.items() if path.suffix == ".bin"
    }
    assert tree(out) == reference


GENERATE = """
import sys
from pathlib import Path
from simtrack.datasets.engine import generate, local_pool
from tests.datasets.tiny import PlainWriter, TinyFactory
if __name__ == "__main__":
    generate(TinyFactory(delay=0.02), (PlainWriter(),), Path(sys.argv[1]), int(sys.argv[2]), local_pool(2))
"""


def start(tmp_path: Path, out: Path, limit: Callable[[], None] | None = None) -> subprocess.Popen[str]:
    """A generation in a process of its own, the leader of its group."""
    script = tmp_path / "generate.py"
    script.write_text(GENERATE)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [sys.executable, str(script), str(out), str(COUNT)],
        env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True, preexec_fn=limit,
    )  # fmt: skip


def test_killed_at_random_moments_and_resumed(reference: dict[str, bytes], tmp_path: Path) -> None:
    """SIGKILL to the parent alone: its workers have to end by themselves, and their half scenes must not matter."""
    out, moments = tmp_path / "set", random.Random(4)
    kills = 0
    while kills < 5:
        process = start(tmp_path, out)
        while not (out / ".staging").exists() and process.poll() is None:
            time.sleep(0.01)
        time.sleep(moments.uniform(0.0, 0.9))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        kills += 1
        if out.exists():
            complete = folder.read_markers(out)
            for scene in complete:  # what is said to be complete is
                assert (out / f"plain/logs/{scene:06d}.json").read_bytes() == reference[f"plain/logs/{scene:06d}.json"]
    generate(TinyFactory(), WRITERS, out, COUNT, InlinePool)
    assert tree(out) == reference


@pytest.mark.parametrize("step", range(8))
def test_killed_in_the_middle_of_a_commit(
    reference: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    """As if the process had ended before each of the commit's steps on the disk."""
    out, left = tmp_path / "set", step
    renamed = Path.rename

    def rename(path: Path, target: Path) -> Path:
        nonlocal left
        left -= 1
        if left < 0:
            raise KeyboardInterrupt
        return renamed(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", rename)
        with pytest.raises(KeyboardInterrupt):
            generate(TinyFactory(), WRITERS, out, COUNT, InlinePool)
    generate(TinyFactory(), WRITERS, out, COUNT, InlinePool)
    assert tree(out) == reference


def test_a_full_disk_ends_the_run_and_the_next_one_carries_on(reference: dict[str, bytes], tmp_path: Path) -> None:
    out = tmp_path / "set"
    factory = TinyFactory(trouble={3: "disk full"}, scratch=tmp_path)
    with pytest.raises(DatasetError, match=r"No space left on device.*run the same command again"):
        generate(factory, WRITERS, out, COUNT, InlinePool)
    assert set(folder.read_markers(out)) == {0, 1, 2}
    assert {path.name for path in out.iterdir()} == {"recipe.yaml", "dataset.json", "scenes", "plain"}
    assert json.loads((out / "dataset.json").read_text())["complete"] is False
    generate(TinyFactory(), WRITERS, out, COUNT, InlinePool)
    assert tree(out) == reference


def test_a_file_that_may_not_grow(reference: dict[str, bytes], tmp_path: Path) -> None:
    """The system refuses to write on, in the worker: the same as a disk that is full."""

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))

    process = start(tmp_path, tmp_path / "set", limit)
    _, message = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "DatasetError" in message
    assert "File too large" in message
    generate(TinyFactory(), WRITERS, tmp_path / "set", COUNT, InlinePool)
    assert tree(tmp_path / "set") == reference


def test_too_little_space_is_told_before_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "set"
    monkeypatch.setattr(engine, "expected_bytes_per_frame", lambda info, formats: 1e15)
    with pytest.raises(DatasetError, match=r"24 frames need about .* GB .* are free"):
        generate(TinyFactory(), WRITERS, out, COUNT, InlinePool)
    assert not list(out.rglob("*.bin"))


def test_sizes_are_known_after_the_first_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "set"
    monkeypatch.setattr(engine, "expected_bytes_per_frame", lambda info, formats: 1.0)

    class Usage:
        free = 3 * FRAMES_PER_SCENE * 32 * 24 * 7

    monkeypatch.setattr(engine.shutil, "disk_usage", lambda path: Usage)
    with pytest.raises(DatasetError, match="20 frames need about"):
        generate(TinyFactory(), WRITERS, out, COUNT, InlinePool)
    assert set(folder.read_markers(out)) == {0}


def test_a_dead_worker_is_replaced(reference: dict[str, bytes], tmp_path: Path) -> None:
    out = tmp_path / "set"
    generate(TinyFactory(trouble={1: "die once", 4: "die once"}, scratch=tmp_path), WRITERS, out, COUNT, local_pool(2))
    assert (tmp_path / "tries-1").stat().st_size == 2
    assert tree(out) == reference


def test_a_scene_that_always_kills_its_worker_is_named(reference: dict[str, bytes], tmp_path: Path) -> None:
    out = tmp_path / "set"
    with pytest.raises(DatasetError, match=r"1 scenes could not be made, 5 of 6 .* scene 2: .*SIGKILL.*3 times"):
        generate(TinyFactory(trouble={2: "die"}, scratch=tmp_path), WRITERS, out, COUNT, local_pool(2))
    assert (tmp_path / "tries-2").stat().st_size == engine.MAX_ATTEMPTS
    assert set(folder.read_markers(out)) == {0, 1, 3, 4, 5}
    generate(TinyFactory(), WRITERS, out, COUNT, InlinePool)
    assert tree(out) == reference


@pytest.mark.parametrize(("trouble", "words"), [("refuse", "mesh brick: cannot be placed"), ("raise", "a mistake")])
def test_what_a_recipe_cannot_do_is_not_tried_again(tmp_path: Path, trouble: str, words: str) -> None:
    out = tmp_path / "set"
    with pytest.raises(DatasetError, match=words) as error:
        generate(
            TinyFactory(trouble=dict.fromkeys(range(SCENES), trouble), scratch=tmp_path),
            WRITERS,
            out,
            COUNT,
            InlinePool,
        )
    assert (tmp_path / "tries-0").stat().st_size == 1
    assert f"{engine.MAX_FAILED_SCENES} scenes could not be made" in str(error.value)
    assert not (tmp_path / "tries-5").exists(), "what fails scene after scene is not tried to the end"


def test_other_folders_are_refused_and_untouched(tmp_path: Path) -> None:
    out = tmp_path / "set"
    out.mkdir()
    (out / "mine.txt").write_text("keep")
    with pytest.raises(DatasetError, match="holds other files"):
        generate(TinyFactory(), WRITERS, out, 4, InlinePool)
    assert tree(out) == {"mine.txt": b"keep"}
    (out / "mine.txt").rename(out / "recipe.yaml")
    with pytest.raises(DatasetError, match="holds other files"):
        generate(TinyFactory(), WRITERS, out, 4, InlinePool)
    assert tree(out) == {"recipe.yaml": b"keep"}
    (tmp_path / "file").write_text("")
    with pytest.raises(DatasetError, match="is a file"):
        generate(TinyFactory(), WRITERS, tmp_path / "file", 4)


def test_other_data_sets_are_refused_with_the_difference(tmp_path: Path) -> None:
    out = tmp_path / "set"
    generate(TinyFactory(), WRITERS, out, 4, InlinePool)
    before = tree(out)
    with pytest.raises(DatasetError, match="seed is 0 there and 7 here"):
        generate(TinyFactory(seed=7), WRITERS, out, 4, InlinePool)
    with pytest.raises(DatasetError, match=r"recipe field objects\.count is 3 there and 5 here"):
        generate(TinyFactory(recipe="name: tiny\nobjects: {count: 5}\n"), WRITERS, out, 4, InlinePool)
    with pytest.raises(DatasetError, match=r'formats is \["plain"\] there and \["other", "plain"\] here'):
        generate(TinyFactory(), (*WRITERS, PlainWriter("other")), out, 4, InlinePool)
    assert tree(out) == before


def test_one_run_at_a_time(tmp_path: Path) -> None:
    out = tmp_path / "set"
    out.mkdir()
    with (out / ".lock").open("w+") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        lock.write("process 123 on somewhere")
        lock.flush()
        with pytest.raises(DatasetError, match=r"written to by another run.*process 123 on somewhere"):
            generate(TinyFactory(), WRITERS, out, 4, InlinePool)
    generate(TinyFactory(), WRITERS, out, 4, InlinePool)  # a lock that nobody holds is no lock
    assert not (out / ".lock").exists()


def test_counts_are_checked(tmp_path: Path) -> None:
    for count in (0, -5, 1 + 4 * engine.MAX_SCENES):
        with pytest.raises(InvalidValueError, match="count"):
            generate(TinyFactory(), WRITERS, tmp_path / "set", count)
    assert not (tmp_path / "set").exists()


def test_progress_runs_to_the_end(tmp_path: Path) -> None:
    seen: list[GenerationProgress] = []
    generate(TinyFactory(), WRITERS, tmp_path / "set", COUNT, InlinePool, report=seen.append)
    assert [p.frames for p in seen] == sorted(p.frames for p in seen)
    last = seen[-1]
    assert (last.frames, last.total_frames, last.scenes, last.total_scenes) == (COUNT, COUNT, SCENES, SCENES)
    assert last.seconds_left == 0.0


def test_writers_must_name_the_scene(tmp_path: Path) -> None:
    staged = tmp_path / "staged"
    (staged / "a" / "000012").mkdir(parents=True)
    (staged / "a" / "000012" / "000003.png").touch()
    (staged / "b").mkdir()
    (staged / "b" / "log_000012.bin").touch()
    assert folder.scene_units(staged, 12) == ["a/000012", "b/log_000012.bin"]
    (staged / "b" / "notes.txt").touch()
    with pytest.raises(DatasetError, match=r"b/notes\.txt, which does not carry the number of scene 000012"):
        folder.scene_units(staged, 12)


def test_a_closed_pool_leaves_no_process(tmp_path: Path) -> None:
    pool = LocalPool(TinyFactory(delay=5.0), WRITERS, 2)
    pool.start(0, tmp_path / "a")
    pool.start(1, tmp_path / "b")
    processes = [worker.process for worker in pool._workers]
    pool.close()
    assert [process.exitcode for process in processes] == [-signal.SIGKILL] * 2


RAISES = """
import sys
from pathlib import Path
from simtrack.datasets.local import LocalPool
from tests.datasets.tiny import PlainWriter, TinyFactory
if __name__ == "__main__":
    pool = LocalPool(TinyFactory(delay=600.0), (PlainWriter(),), 1)
    pool.start(0, Path(sys.argv[1]))
    raise RuntimeError("in the middle")
"""


def test_a_script_that_raises_does_not_wait_for_its_workers(tmp_path: Path) -> None:
    script = tmp_path / "raises.py"
    script.write_text(RAISES)
    command = [sys.executable, str(script), str(tmp_path / "a")]
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=90
    )
    assert done.returncode == 1
    assert done.stderr.endswith("RuntimeError: in the middle\n")
