"""Logs that were cut off, damaged or made up: what can be read is read, the rest is one named error."""

import io
import os
import signal
import struct
import subprocess
import sys
import tracemalloc
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk
from mcap.writer import MCAP0_MAGIC, Writer

from simtrack.contracts import JointState, StaticMap
from simtrack.errors import FileFormatError
from simtrack.recordings import (
    McapWriter,
    RecordingWarning,
    archive,
    container,
    layout,
    open_recording,
    ros2,
    strip_labels,
    writer,
)
from tests.recordings.feeds import feed, rgbd_frame, same

Record = Callable[..., Path]


class Log:
    """No dataclass: hypothesis would print all of it."""

    def __init__(self, data: bytes, entries: list[object]) -> None:
        self.data, self.entries = data, entries


def read_all(path: Path) -> list[object]:
    recording = open_recording(path)
    list(recording.labels())
    list(recording.detections())
    return list(recording.frames())


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """A log of several (small) chunks, and what is in it."""
    entries = feed(np.random.default_rng(0), 8, size=(30, 40))
    path = tmp_path_factory.mktemp("damage") / "log.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "CHUNK_BYTES", 10_000)
        with McapWriter(path) as log:
            for entry in entries:
                log.write(entry)
                log.write_labels(entry.stamp, {"base": np.eye(4)})
    return Log(path.read_bytes(), list(entries))


def test_a_log_cut_anywhere_is_read_up_to_the_cut(whole: Log, tmp_path: Path) -> None:
    data, entries = whole.data, whole.entries
    assert len(container.Container(write(tmp_path / "whole.mcap", data)).chunks) > 3
    lengths = []
    for cut in [*np.linspace(0, len(data) - 1, 60).astype(int), len(data) - 9, len(data) - 30]:
        path = write(tmp_path / "cut.mcap", data[:cut])
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                read = read_all(path)
            except FileFormatError:
                assert cut < 400, "only the attachments at the start are indispensable"
                continue
        assert [warning.category for warning in caught] == [RecordingWarning]
        assert all(same(a, b) for a, b in zip(read, entries, strict=False))
        lengths.append(len(read))
    assert lengths == sorted(lengths) and lengths[-1] == len(entries)
    assert len(set(lengths)) > 3


def head() -> bytes:
    """The bytes of a recording before its first chunk."""
    stream = io.BytesIO()
    forger = Writer(stream)
    forger.start(profile="ros2")
    forger.add_attachment(0, 0, layout.METADATA, "application/json", b"{}")
    return stream.getvalue()


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def test_a_killed_writer_leaves_all_whole_chunks(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    code = (
        "import sys, numpy as np\n"
        "from simtrack.recordings import McapWriter\n"
        "from tests.recordings.feeds import rgbd_frame\n"
        "rng = np.random.default_rng(0)\n"
        "log = McapWriter(sys.argv[1])\n"
        "for index in range(12):\n"
        "    log.write(rgbd_frame(rng, index, size=(480, 640)))\n"
        "print('written', flush=True)\n"
        "sys.stdin.read()\n"
    )
    repository = Path(__file__).resolve().parents[2]
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": str(repository)},
    )
    with process:
        assert process.stdout is not None and process.stdout.readline() == b"written\n"
        process.send_signal(signal.SIGKILL)
    with pytest.warns(RecordingWarning, match="not finished"):
        recording = open_recording(path)
    rng = np.random.default_rng(0)
    read = list(recording.frames())
    assert not recording.complete and len(read) >= 11
    assert all(same(frame, rgbd_frame(rng, index, size=(480, 640))) for index, frame in enumerate(read))


@settings(max_examples=100)
@given(index=st.integers(0, 3000) | st.integers(0, 2**32), flip=st.integers(1, 255))
def test_a_flipped_byte_is_found_or_harmless(
    whole: Log, tmp_path_factory: pytest.TempPathFactory, index: int, flip: int
) -> None:
    damaged = bytearray(whole.data)
    damaged[index % len(damaged)] ^= flip
    path = write(tmp_path_factory.getbasetemp() / "flipped.mcap", bytes(damaged))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RecordingWarning)
        try:
            read = read_all(path)
        except FileFormatError as error:
            assert str(path) in str(error)
        else:
            assert all(same(a, b) for a, b in zip(read, whole.entries, strict=False))


@settings(max_examples=60)
@given(content=st.binary(max_size=300))
def test_noise_is_refused(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = write(tmp_path_factory.getbasetemp() / "noise.mcap", MCAP0_MAGIC + content)
    with warnings.catch_warnings(), pytest.raises(FileFormatError):
        warnings.simplefilter("ignore", RecordingWarning)
        open_recording(path)


def test_what_is_no_recording_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"missing\.mcap.*No such file"):
        open_recording(tmp_path / "missing.mcap")
    with pytest.raises(FileFormatError, match="cannot be read"):
        open_recording(tmp_path)
    with pytest.raises(FileFormatError, match="not an MCAP file"):
        open_recording(write(tmp_path / "a.mcap", b"bag" * 100))
    with (tmp_path / "other.mcap").open("wb") as stream:
        other = Writer(stream)
        other.start()
        other.finish()
    with pytest.raises(FileFormatError, match=r"metadata\.json: missing"):
        open_recording(tmp_path / "other.mcap")


class Forged:
    """A log written message by message, past `McapWriter`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.stream = path.open("wb")
        self.writer = Writer(self.stream)
        self.writer.start(profile="ros2")
        self.attach(layout.METADATA, b"{}")

    def attach(self, name: str, data: bytes) -> None:
        self.writer.add_attachment(0, 0, name, "", data)

    def message(self, topic: str, kind: str, data: bytes, log_time: int = 0) -> None:
        schema = self.writer.register_schema(ros2.schema_name(kind), "ros2msg", ros2.schema_text(kind))
        channel = self.writer.register_channel(topic, "cdr", schema)
        self.writer.add_message(channel, log_time, data, log_time)

    def close(self) -> Path:
        self.writer.finish()
        self.stream.close()
        return self.path


@pytest.fixture
def forged(tmp_path: Path) -> Forged:
    return Forged(tmp_path / "forged.mcap")


def test_a_map_that_claims_more_than_it_holds_takes_no_memory(forged: Forged, static_map: StaticMap) -> None:
    npy = io.BytesIO()
    np.lib.format.write_array_header_1_0(npy, {"descr": "<f4", "fortran_order": False, "shape": (2**40, 3)})
    data = archive.encode(static_map)
    first = archive.encode(StaticMap(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)))
    forged.attach(layout.STATIC_MAP, replace_member(first, "0.npy", npy.getvalue()))
    with pytest.raises(FileFormatError, match=r"static_map\.npz: \.vertices: shape"):
        open_recording(forged.close())
    assert same(archive.decode(StaticMap, data), static_map)


def replace_member(data: bytes, name: str, content: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as source, zipfile.ZipFile(out, "w") as target:
        for member in source.namelist():
            target.writestr(member, content if member == name else source.read(member))
    return out.getvalue()


@pytest.mark.parametrize(
    ("member", "content", "reason"),
    [
        ("tree.json", b"{", r"tree\.json"),
        ("tree.json", b"[" * 100_000, "not a readable archive"),
        ("tree.json", b'{"faces": 1}', "fields"),
        ("tree.json", b'{"vertices": 9, "faces": 1}', "9.npy"),
        ("tree.json", b'{"vertices": true, "faces": 1}', "bool, expected int"),
        ("tree.json", b'{"vertices": 0, "faces": 0}', "array of float32, expected int32"),
        ("tree.json", b'{"vertices": 0, "faces": 1, "noise": "high"}', "str, expected float"),
        ("tree.json", b'{"vertices": 0, "faces": 1, "rooms": [{}]}', r"rooms\[0\]: fields"),
        ("0.npy", b"\x80\x04N.", "vertices"),
        ("0.npy", b"\x93NUMPY\x01\x00\x02\x00[]", "vertices"),
    ],
)
def test_damaged_maps_are_named(
    forged: Forged, static_map: StaticMap, member: str, content: bytes, reason: str
) -> None:
    forged.attach(layout.STATIC_MAP, replace_member(archive.encode(static_map), member, content))
    with pytest.raises(FileFormatError, match=reason):
        open_recording(forged.close())


def test_a_map_whose_members_begin_before_it_is_named(forged: Forged, static_map: StaticMap) -> None:
    data = bytearray(archive.encode(static_map))
    data[-4] += 1  # where the directory is said to begin, 65,536 bytes too far
    forged.attach(layout.STATIC_MAP, bytes(data))
    with pytest.raises(FileFormatError, match="not a readable archive"):
        open_recording(forged.close())


def test_maps_whose_faces_name_no_vertex_are_named(forged: Forged, static_map: StaticMap) -> None:
    wrong = StaticMap(static_map.vertices, static_map.faces + 1)
    forged.attach(layout.STATIC_MAP, archive.encode(wrong))
    with pytest.raises(FileFormatError, match="faces that name none"):
        open_recording(forged.close())


def test_pickled_arrays_are_refused(forged: Forged, static_map: StaticMap) -> None:
    npy = io.BytesIO()
    np.lib.format.write_array(npy, np.array([print], dtype=object), version=(1, 0), allow_pickle=True)
    forged.attach(layout.STATIC_MAP, replace_member(archive.encode(static_map), "0.npy", npy.getvalue()))
    with pytest.raises(FileFormatError, match="expected float32"):
        open_recording(forged.close())


def test_chunks_that_unpack_to_more_than_they_say_are_refused(tmp_path: Path) -> None:
    bomb = zstandard.compress(bytes(2**24), level=1)
    for claimed in (1000, 2**24, 2**40):
        chunk = Chunk("zstd", bomb, 0, 0, 0, claimed)
        builder = RecordBuilder()
        chunk.write(builder)
        path = tmp_path / f"{claimed}.mcap"
        path.write_bytes(head() + builder.end())
        tracemalloc.start()
        with warnings.catch_warnings(), pytest.raises(FileFormatError, match="chunk at byte"):
            warnings.simplefilter("ignore", RecordingWarning)
            read_all(path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert claimed == 2**24 or peak < 2**22


@pytest.mark.parametrize(
    ("topic", "kind", "data", "reason"),
    [
        (layout.DEPTH, "sensor_msgs/PointCloud2", b"\0\1\0\0", r"schema: sensor_msgs/msg/PointCloud2"),
        (layout.DEPTH, "sensor_msgs/Image", b"", "cannot be decoded"),
        (layout.JOINTS, "sensor_msgs/JointState", b"\0\1\0\0" + b"\xff" * 64, "cannot be decoded"),
        (layout.CAMERA_FRAME, "simtrack_msgs/Frame", ros2.frame_record(0, 0, np.eye(4), ""), "cannot be used"),
    ],
)
def test_wrong_messages_are_named(forged: Forged, topic: str, kind: str, data: bytes, reason: str) -> None:
    forged.message(topic, kind, data)
    with pytest.raises(FileFormatError, match=reason) as caught:
        read_all(forged.close())
    assert topic in str(caught.value)


def test_images_must_fill_their_size(forged: Forged) -> None:
    frame = rgbd_frame(np.random.default_rng(0), 5)
    image = bytearray(ros2.depth_image(frame, "c"))
    height = image.index(struct.pack("<I", 6), 16)
    image[height : height + 4] = struct.pack("<I", 7)
    forged.message(layout.DEPTH, "sensor_msgs/Image", bytes(image), 1)
    forged.message(layout.DEPTH_INFO, "sensor_msgs/CameraInfo", ros2.camera_info(frame, "c"), 2)
    forged.message(layout.CAMERA_FRAME, "simtrack_msgs/Frame", ros2.frame_record(5, 0, np.eye(4), "c"), 3)
    with pytest.raises(FileFormatError, match="7 rows of 32 bytes"):
        read_all(forged.close())


def test_messages_out_of_order_are_refused(forged: Forged) -> None:
    for time in (2, 1):
        forged.message(
            layout.JOINTS, "sensor_msgs/JointState", ros2.joint_state(JointState(0, ("a",), np.zeros(1))), time
        )
    with pytest.raises(FileFormatError, match="order of arrival"):
        read_all(forged.close())


def test_a_compression_that_is_not_known_is_named(tmp_path: Path) -> None:
    builder = RecordBuilder()
    Chunk("brotli", b"", 0, 0, zlib.crc32(b""), 0).write(builder)
    path = write(tmp_path / "a.mcap", head() + builder.end())
    with pytest.warns(RecordingWarning), pytest.raises(FileFormatError, match=r"brotli.*known: zstd, none"):
        read_all(path)


def test_a_log_without_chunks_is_refused(tmp_path: Path) -> None:
    with (tmp_path / "a.mcap").open("wb") as stream:
        flat = Writer(stream, use_chunking=False)
        flat.start()
        flat.add_message(flat.register_channel("/a", "cdr", 0), 0, b"", 0)
        flat.finish()
    with pytest.raises(FileFormatError, match="outside a chunk"):
        open_recording(tmp_path / "a.mcap")


def test_broken_metadata_are_named(forged: Forged, tmp_path: Path) -> None:
    for content in (b"{", b"[1]", b"\xff"):
        forged.attach(layout.METADATA, content)
    path = forged.close()
    for attempt in (lambda: open_recording(path), lambda: strip_labels(path, tmp_path / "out.mcap", overwrite=True)):
        with pytest.raises(FileFormatError, match=r"metadata\.json: not"):
            attempt()


def test_stripping_a_cut_log_keeps_what_is_there(whole: Log, tmp_path: Path) -> None:
    cut = write(tmp_path / "cut.mcap", whole.data[: len(whole.data) // 2])
    strip_labels(cut, tmp_path / "out.mcap")
    read = read_all(tmp_path / "out.mcap")
    assert 0 < len(read) < len(whole.entries)


def test_memory_is_flat_in_the_length_of_the_log(tmp_path: Path) -> None:
    def peak(frames: int) -> int:
        rng = np.random.default_rng(0)
        frame = rgbd_frame(rng, 0, size=(240, 320))
        path = tmp_path / f"{frames}.mcap"
        tracemalloc.start()
        with McapWriter(path) as log:
            for _ in range(frames):
                log.write(frame)
        assert sum(1 for _ in open_recording(path).frames()) == frames
        out = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return out

    assert peak(60) < peak(12) + 200_000
