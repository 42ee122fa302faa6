"""Turns of a Velodyne VLP-16 (Puck, Puck LITE) from a packet capture.

Decoded after the VLP-16 User Manual 63-9243 Rev. D, chapter 9: data packets of 12 blocks of two firings of 16 lasers,
2 mm a unit of range, a hundredth of a degree of azimuth; azimuths between those that are sent are interpolated to each
laser's own time.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simtrack.contracts import Float64, LidarScan
from simtrack.errors import FileFormatError
from simtrack.recordings.log import PosedFrame, SensorLog
from simtrack.recordings.pcap import udp_payloads
from simtrack.sensors.lidar import VLP16, VLP16_ELEVATIONS

DATA_BYTES = 1206
"""Size of a data packet."""
NOISE = 0.01
"""Metres: the data sheet's typical accuracy of 3 cm is that of three standard deviations."""
_PRODUCTS = {0x21: "HDL-32E", 0x22: "VLP-16", 0x24: "Puck Hi-Res", 0x28: "VLP-32C", 0x31: "Velarray", 0x63: "VLS-128"}
_DUAL, _RETURNS = 0x39, (0x37, 0x38, 0x39)
BEAM_HEIGHTS = (11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2)
"""Millimetres, by laser id: where its beam leaves the sensor, above the centre (manual, table 9-1)."""
_HOUR = 3_600_000_000
"""Microseconds: packets count from the top of the hour."""
_BLOCK = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("returns", [("range", "<u2"), ("intensity", "u1")], 32)])
_PACKET = np.dtype([("blocks", _BLOCK, 12), ("time", "<u4"), ("mode", "u1"), ("product", "u1")])
MAX_FIRINGS = 10_000
"""Of one turn; the slowest setting, five turns a second, has 3617."""
_RINGS = np.argsort(np.argsort(VLP16_ELEVATIONS)).astype(np.uint8)
"""Rank of each laser by elevation."""
JITTER = 0.01
"""Radians."""
_LOWEST_SHARE = 0.5
"""Share of a turn that the end of a recording must hold to count as one."""


@dataclass(frozen=True, slots=True)
class _Firings:
    """K firings of 16 lasers."""

    stamps: np.ndarray
    """(K,) int64, nanoseconds, of the first laser."""
    azimuths: Float64
    """(K, 16), radians clockwise from ahead, of each laser's own time."""
    ranges: Float64
    """(K, 16), metres; 0 = no return."""
    intensities: Float64
    """(K, 16), 0 to 255."""


def open_vlp16(path: Path) -> SensorLog:
    """A capture of VLP-16 packets. Raises `FileFormatError` when read, if it holds none."""
    return SensorLog(path, "VLP-16 packet capture", "lidar", None, lambda: _turns(path), noise=NOISE)


def _turns(path: Path) -> Iterator[PosedFrame]:
    """Whole turns, each of the firings within 360 degrees of its first one, and what is left if it is most of one."""
    pending: list[_Firings] = []
    swept, last, sequence = 0.0, None, 0
    for firings in _firings(path):
        azimuth = firings.azimuths[:, 0]
        previous = azimuth[0] if last is None else last
        # Forwards, by nearly a turn where packets were lost; backwards only by what an encoder may jitter.
        steps = np.mod(np.diff(azimuth, prepend=previous) + JITTER, 2 * np.pi) - JITTER
        angles = np.maximum.accumulate(swept + np.cumsum(steps))
        swept, last = float(angles[-1]), float(azimuth[-1])
        if swept >= 2 * np.pi:
            cut = int(np.searchsorted(angles, 2 * np.pi))
            pending.append(_part(firings, slice(None, cut)))
            yield PosedFrame(_scan(pending, sequence))
            pending, sequence = [_part(firings, slice(cut, None))], sequence + 1
            swept -= float(angles[cut])
        else:
            pending.append(firings)
        if sum(len(part.stamps) for part in pending) > MAX_FIRINGS:
            raise FileFormatError(path, f"turn {sequence}", f"{MAX_FIRINGS} firings within less than 360 degrees")
    if not pending:
        raise FileFormatError(path, "", "holds no data packets of a VLP-16 (UDP datagrams of 1206 bytes)")
    if swept >= _LOWEST_SHARE * 2 * np.pi:
        yield PosedFrame(_scan(pending, sequence))


def _part(firings: _Firings, rows: slice) -> _Firings:
    return _Firings(firings.stamps[rows], firings.azimuths[rows], firings.ranges[rows], firings.intensities[rows])


def _scan(parts: list[_Firings], sequence: int) -> LidarScan:
    stamps = np.concatenate([part.stamps for part in parts])
    azimuths = np.concatenate([part.azimuths for part in parts]).ravel()
    ranges = np.concatenate([part.ranges for part in parts]).ravel()
    intensities = np.concatenate([part.intensities for part in parts]).ravel()
    count = len(stamps)
    elevations = np.tile(np.deg2rad(VLP16_ELEVATIONS), count)
    # The beam leaves the sensor a little above or below its centre: shots are those from the centre to what it met.
    flat = ranges * np.cos(elevations)
    points = np.stack([flat * np.cos(azimuths), -flat * np.sin(azimuths), ranges * np.sin(elevations)], axis=1)
    points[:, 2] += np.tile(BEAM_HEIGHTS, count) / 1000.0
    aimed = np.stack(
        [np.cos(elevations) * np.cos(azimuths), -np.cos(elevations) * np.sin(azimuths), np.sin(elevations)], axis=1
    )
    returned = ranges > 0.0
    distances = np.where(returned, np.linalg.norm(points, axis=1), np.inf)
    directions = np.where(returned[:, None], points / np.where(returned, distances, 1.0)[:, None], aimed)
    times = (stamps - stamps[0])[:, None] / 1e9 + VLP16.laser_period * np.arange(16)
    return LidarScan(
        stamp=int(stamps[0]),
        directions=directions.astype(np.float32),
        ranges=distances.astype(np.float32),
        times=times.ravel().astype(np.float32),
        rings=np.tile(_RINGS, count),
        intensities=intensities.astype(np.float32),
        T_base_lidar=np.eye(4),
        sequence=sequence,
    )


def _firings(path: Path) -> Iterator[_Firings]:
    """The firings of each data packet, stamped by the sensor's clock, which starts at the capture's first stamp."""
    clock: tuple[int, int] | None = None
    for arrival, payload in udp_payloads(path):
        if len(payload) != DATA_BYTES or payload[:2] != b"\xff\xee":
            continue
        packet = np.frombuffer(payload, _PACKET)[0]
        product, mode = int(packet["product"]), int(packet["mode"])
        if product != 0x22 or mode not in _RETURNS:
            name = _PRODUCTS.get(product, "unknown")
            raise FileFormatError(
                path, "factory bytes", f"{mode:#04x} {product:#04x} ({name}); known: a VLP-16 (0x37 to 0x39, 0x22)"
            )
        microseconds = int(packet["time"])
        if microseconds >= _HOUR or (packet["blocks"]["flag"] != 0xEEFF).any():
            continue  # damaged on its way
        if clock is None:
            clock = microseconds, arrival
        # Within half an hour of where the capture's clock puts it: hours pass.
        device = (microseconds - clock[0]) % _HOUR
        hours = round(((arrival - clock[1]) / 1000 - device) / _HOUR)
        yield _decoded(packet, clock[1] + 1000 * (device + hours * _HOUR))


def _decoded(packet: np.void, stamp: int) -> _Firings:
    blocks = packet["blocks"]
    step = 2 if packet["mode"] == _DUAL else 1
    chosen = blocks[step - 1 :: step]  # of two returns the second one: the strongest, or the next to it
    count = len(chosen)
    azimuths = np.deg2rad(chosen["azimuth"] / 100.0)
    turns = np.mod(np.diff(azimuths), 2 * np.pi)
    # The sensor turns evenly: the median step of a packet also serves its last block, and one beside a gap.
    per_block = float(np.median(turns))
    firing, laser = VLP16.firing_period, VLP16.laser_period
    delays = (firing * np.arange(2)[:, None] + laser * np.arange(16)) / (2 * firing)  # in blocks
    within = azimuths[:, None, None] + per_block * delays
    starts = stamp + np.round(1e9 * firing * np.arange(2 * count)).astype(np.int64)
    ranges = 0.002 * chosen["returns"]["range"].reshape(-1, 16)
    return _Firings(starts, within.reshape(-1, 16), ranges, chosen["returns"]["intensity"].reshape(-1, 16))
