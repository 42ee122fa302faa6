"""What holds for all writers: bytes depend on frames alone, images are shared, options are checked."""

import gc
import pickle
import tracemalloc
from dataclasses import replace
from pathlib import Path

import pytest

from simtrack.datasets.folder import scene_units
from simtrack.datasets.frame import SceneInfo
from simtrack.datasets.writer import DatasetWriter
from simtrack.datasets.writers import WRITERS, make_writer
from simtrack.errors import FileFormatError, UnknownNameError
from tests.datasets.writers.labelled import INFO, Small, contents, made, write


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("all"), [make_writer(name) for name in WRITERS], Small(), 3)


def test_the_order_of_scenes_and_of_writers_changes_no_byte(root: Path, tmp_path: Path) -> None:
    """Neither does a writer that went through another process, nor whose images are encoded by another one."""
    writers: list[DatasetWriter] = pickle.loads(
        pickle.dumps([make_writer(name) for name in sorted(WRITERS, reverse=True)])
    )
    write(tmp_path, writers, Small(), [2, 0, 1])
    for writer in writers:
        writer.finish(tmp_path, INFO, 3)
        writer.finish(tmp_path, INFO, 3)
    assert contents(tmp_path) == contents(root)


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_a_format_alone_is_the_same_as_among_others(root: Path, tmp_path: Path, name: str) -> None:
    alone = contents(made(tmp_path, [make_writer(name)], Small(), 3))
    assert alone == {path: data for path, data in contents(root).items() if path.startswith(f"{name}/")}
    assert alone


def test_a_scene_leaves_only_what_carries_its_number(tmp_path: Path) -> None:
    """And nothing open or half-written."""
    writers = [make_writer(name) for name in WRITERS]
    staging = tmp_path / "staging"
    staging.mkdir()
    opened = [writer.open_scene(staging, INFO, Small().scene_info(1)) for writer in writers]
    for frame in Small().scene(1):
        for one in opened:
            one.write(frame)
    for one in opened:
        one.close()
    units = scene_units(staging, 1)
    assert {unit.split("/")[0] for unit in units} == set(WRITERS)
    names = [path.name for path in staging.rglob("*") if path.is_file()]
    assert not [name for name in names if name.startswith(".") or name.endswith(".part")]


def test_formats_share_their_images(root: Path) -> None:
    image = "000002/000001"
    same = [
        root / "coco" / "images" / f"{image}.jpg",
        root / "dope" / f"{image}.jpg",
        root / "yolo" / "pose" / "images" / "train" / f"{image}.jpg",
        root / "yolo" / "segment" / "images" / "train" / f"{image}.jpg",
    ]
    first = root / "bop" / "train_pbr" / "000002" / "rgb" / "000001.jpg"
    assert all(path.samefile(first) for path in same)


def test_where_links_fail_there_are_copies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, root: Path) -> None:
    def refuse(source: object, target: object) -> None:
        raise OSError(1, "no links here")

    monkeypatch.setattr("os.link", refuse)
    made(tmp_path, [make_writer(name) for name in WRITERS], Small(), 3)
    assert contents(tmp_path) == contents(root)
    assert all(path.stat().st_nlink == 1 for path in tmp_path.rglob("*.jpg"))


@pytest.mark.parametrize("name", sorted(set(WRITERS) - {"mcap"}))  # whose chunks come and go: see `McapWriter`
def test_memory_does_not_grow_with_the_frames(tmp_path: Path, name: str) -> None:
    frame = next(iter(Small().scene(0)))
    tracemalloc.start()
    try:
        scene = make_writer(name).open_scene(tmp_path, INFO, SceneInfo(0, 500))
        held = []
        for index in range(60):
            scene.write(replace(frame, index=index, stamp=frame.stamp + index * 10_000_000))
            if index in (9, 59):
                gc.collect()
                held.append(tracemalloc.get_traced_memory()[0])
        scene.close()
    finally:
        tracemalloc.stop()
    # A webdataset keeps the keys, and files their buffers; the labels of a frame are above 4 kB.
    assert held[1] - held[0] < 50 * 500


@pytest.mark.parametrize(
    ("name", "options", "field"),
    [
        ("bop", {"split_typ": "pbr"}, "split_type"),
        ("bop", {"depth_scale": 0}, "depth_scale"),
        ("bop_webdataset", {"images_per_shard": 1001}, "images_per_shard"),
        ("coco", {"parts": ["stuff"]}, "parts"),
        ("coco", {"parts": []}, "parts"),
        ("yolo", {"image": "bmp"}, "image"),
        ("kitti", {"anything": 1}, "anything"),
    ],
)
def test_wrong_options_are_refused(name: str, options: dict[str, object], field: str) -> None:
    with pytest.raises(FileFormatError, match=field) as caught:
        make_writer(name, options, Path("recipe.yaml"))
    assert "recipe.yaml" in str(caught.value)


def test_unknown_formats_are_refused_with_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match="bop, bop_webdataset, coco"):
        make_writer("cocoa")
