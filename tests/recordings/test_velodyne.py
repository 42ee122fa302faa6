"""VLP-16 packet captures: what was fired comes back; what is damaged is refused by name, or left out."""

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from simtrack.contracts import LidarScan
from simtrack.errors import FileFormatError
from simtrack.recordings import open_log
from simtrack.sensors.lidar import VLP16
from tests.recordings.samples import LIDAR_START, World, beam_ranges, pcap, udp, vlp16_packets

HOUR = 3_600_000_000


def scans_of(path: Path) -> list[LidarScan]:
    scans = list(open_log(path).sensor_frames())
    assert all(isinstance(scan, LidarScan) for scan in scans)
    return [scan for scan in scans if isinstance(scan, LidarScan)]


def capture(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


@pytest.fixture(scope="module")
def packets() -> list[bytes]:
    """Two turns and most of a third of a sensor at rest in a room, across the turn of an hour."""
    world, shots = World(), VLP16.shots(columns=24 * 200)
    return vlp16_packets(beam_ranges(world, shots, LIDAR_START), stamp=HOUR - 120_000)


@pytest.mark.parametrize(("order", "nanoseconds", "vlan"), [("<", False, False), (">", True, True)])
def test_turns_come_back(packets: list[bytes], tmp_path: Path, order: str, nanoseconds: bool, vlan: bool) -> None:
    other = [udp(b"hello"), b"\x00" * 60, udp(bytes(512))]
    frames = [udp(packet, vlan) for packet in packets]
    path = capture(tmp_path / "a.pcap", pcap([*other[:2], *frames[:80], *other, *frames[80:]], order, nanoseconds))
    scans = scans_of(path)
    assert len(scans) == 3, "two turns, and most of one at the end"
    shots = VLP16.shots(columns=1809)
    world = World()
    for scan in scans[:2]:
        assert len(scan.ranges) == len(shots.directions) or abs(len(scan.ranges) // 16 - 1808) <= 1
        assert scan.times.min() == 0.0 and scan.times.max() == pytest.approx(0.1, abs=1e-4)
        # A shot ends where a ray from the sensor's centre in its direction meets the room.
        origins = np.tile(LIDAR_START[:3, 3].astype(np.float32), (len(scan.ranges), 1))
        expected = world.scene.cast_rays(origins, scan.directions @ LIDAR_START[:3, :3].T.astype(np.float32)).distances
        difference = np.abs(expected - scan.ranges)
        assert np.median(difference) < 0.001 and np.quantile(difference, 0.99) < 0.02
        np.testing.assert_array_equal(scan.rings[:16], VLP16.shots(columns=1).rings)
        np.testing.assert_allclose(np.linalg.norm(scan.directions, axis=1), 1.0, atol=1e-6)
        assert (scan.intensities == 99.0).all()
    gaps = np.diff([scan.stamp for scan in scans])
    assert np.allclose(gaps, 1e8, atol=1e5), "the hour turns without a jump"


def test_shots_without_return_are_kept_as_such(packets: list[bytes], tmp_path: Path) -> None:
    silent = bytearray(packets[0])
    silent[4:7] = bytes(3)  # the first laser of the first firing
    path = capture(tmp_path / "a.pcap", pcap([udp(p) for p in [bytes(silent), *packets[1:120]]]))
    scan = scans_of(path)[0]
    assert np.isinf(scan.ranges[0]) and np.isfinite(scan.ranges[1:]).all()
    np.testing.assert_allclose(scan.directions[0], VLP16.shots(columns=1).directions[0], atol=1e-3)


def test_of_dual_returns_one_each_is_taken(packets: list[bytes], tmp_path: Path) -> None:
    """Blocks come in pairs of one azimuth: the last return, then the strongest."""
    dual = []
    for packet in packets:
        blocks = [packet[100 * k : 100 * k + 100] for k in range(12)]
        microseconds = struct.unpack_from("<I", packet, 1200)[0]
        weak = bytes(b if k % 100 < 4 else 1 for k, b in enumerate(blocks[0]))
        for half in (0, 6):
            pairs = b"".join(blocks[k][:4] + weak[4:] + blocks[k] for k in range(half, half + 6))
            late = (microseconds + round(55.296 * 2 * half)) % HOUR
            dual.append(pairs + struct.pack("<IBB", late, 0x39, 0x22))
    single = scans_of(capture(tmp_path / "a.pcap", pcap([udp(p) for p in packets])))[0]
    both = scans_of(capture(tmp_path / "b.pcap", pcap([udp(p) for p in dual])))[0]
    count = min(len(single.ranges), len(both.ranges))
    assert count > 0.99 * len(single.ranges)
    np.testing.assert_allclose(both.ranges[:count], single.ranges[:count], atol=1e-3)
    np.testing.assert_allclose(both.times[:count], single.times[:count], atol=2e-6)


def test_the_real_capture_agrees_with_another_decoder(real_data: Path) -> None:
    decoder = pytest.importorskip("velodyne_decoder", reason="needs the package velodyne-decoder")
    file = real_data / "mrpt_vlp16.pcap"
    if not file.is_file():
        pytest.skip(f"no {file}")
    scans, turns = scans_of(file), list(decoder.read_pcap(str(file)))
    assert len(scans) == len(turns) == 4
    points, stamps = [], []
    for scan in scans:
        hit = np.isfinite(scan.ranges)
        points.append(np.column_stack([scan.directions * scan.ranges[:, None], scan.rings])[hit])
        stamps.append(scan.stamp / 1e9 - scans[0].stamp / 1e9 + scan.times[hit].astype(float))
    ours, times = np.concatenate(points), np.concatenate(stamps)
    theirs = np.concatenate([turn[:, [0, 1, 2, 6]] for _, turn in turns]).astype(float)
    host = np.concatenate([float(stamp.host) + turn[:, 4].astype(float) for stamp, turn in turns])
    assert abs(len(ours) - len(theirs)) < 5
    # Where a turn begins is each decoder's own choice; the points are not.
    offset = np.median(np.sort(times) - np.sort(host)[: len(times)])
    scale = np.array([1.0, 1.0, 1.0, 10.0, 10.0])
    a, b = np.column_stack([ours, times - offset]) * scale, np.column_stack([theirs, host]) * scale
    distances, _ = KDTree(a).query(b)
    assert np.median(distances) < 0.005 and np.quantile(distances, 0.99) < 0.02


# ---------------------------------------------------------------------------------------------------------------- harm


def test_what_is_no_vlp16_is_named(packets: list[bytes], tmp_path: Path) -> None:
    path = tmp_path / "a.pcap"
    with pytest.raises(FileFormatError, match="no data packets"):
        scans_of(capture(path, pcap([udp(b"hello")])))
    with pytest.raises(FileFormatError, match=r"HDL-32E.*VLP-16"):
        scans_of(capture(path, pcap([udp(packets[0][:-1] + b"\x21")])))
    with pytest.raises(FileFormatError, match="editcap"):
        scans_of(capture(path, b"\x0a\x0d\x0d\x0a" + bytes(40)))
    with pytest.raises(FileFormatError, match="link type"):
        scans_of(capture(path, pcap([])[:20] + struct.pack("<I", 147)))
    with pytest.raises(FileFormatError, match="not a pcap"):
        scans_of(capture(path, pcap([])[:10]))


def test_a_capture_cut_anywhere_is_read_up_to_the_cut(packets: list[bytes], tmp_path: Path) -> None:
    data = pcap([udp(packet) for packet in packets])
    whole = scans_of(capture(tmp_path / "whole.pcap", data))
    counts = []
    for cut in np.linspace(24 + 2000, len(data) - 1, 12).astype(int):
        scans = scans_of(capture(tmp_path / "cut.pcap", data[:cut]))
        for a, b in zip(scans[:-1], whole, strict=False):
            assert a.ranges.tobytes() == b.ranges.tobytes()
        counts.append(len(scans))
    assert counts == sorted(counts) and counts[-1] == len(whole)


def test_a_packet_that_claims_gigabytes_takes_no_memory(packets: list[bytes], tmp_path: Path) -> None:
    claim = struct.pack("<IIII", 1, 0, 2**31, 2**31)
    path = capture(tmp_path / "a.pcap", pcap([udp(packets[0])]) + claim)
    tracemalloc.start()
    with pytest.raises(FileFormatError, match=r"packet at byte \d+: damaged header"):
        scans_of(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20_000_000


def test_a_sensor_that_does_not_turn_is_named(packets: list[bytes], tmp_path: Path) -> None:
    stuck = b"".join(packets[0][:4] + packets[0][k + 4 : k + 100] for k in range(0, 1200, 100)) + packets[0][1200:]
    path = capture(tmp_path / "a.pcap", pcap([udp(stuck)] * 420))
    with pytest.raises(FileFormatError, match="turn 0: 10000 firings"):
        scans_of(path)


@settings(max_examples=30)
@given(flips=st.lists(st.tuples(st.integers(0, 2**20), st.integers(1, 255)), min_size=1, max_size=8))
def test_flipped_bytes_are_refused_or_harmless(
    packets: list[bytes], tmp_path_factory: pytest.TempPathFactory, flips: list[tuple[int, int]]
) -> None:
    data = bytearray(pcap([udp(packet) for packet in packets[:80]]))
    for at, flip in flips:
        data[at % 4000] ^= flip  # the file's header and the first packets
    path = capture(tmp_path_factory.getbasetemp() / "flipped.pcap", bytes(data))
    try:
        scans = scans_of(path)
    except FileFormatError as error:
        assert str(path) in str(error)
    else:
        for scan in scans:
            assert not np.isnan(scan.ranges).any() and np.isfinite(scan.directions).all()
            assert np.isfinite(scan.times).all() and len(scan.times) == len(scan.ranges)


@settings(max_examples=60)
@given(content=st.binary(max_size=400))
def test_noise_behind_a_header_is_refused_or_harmless(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = capture(tmp_path_factory.getbasetemp() / "noise.pcap", pcap([])[:24] + content)
    with pytest.raises(FileFormatError):
        scans_of(path)
