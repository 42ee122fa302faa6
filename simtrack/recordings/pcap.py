"""UDP payloads of packet captures (libpcap's file format), read one packet at a time.

Format: https://www.tcpdump.org/manpages/pcap-savefile.5.html. Whatever is not a whole UDP datagram is passed over, as a
capture of a live network holds much else; only a file that is no capture is an error.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from simtrack.errors import FileFormatError

MAX_PACKET = 2**18
"""Largest packet that capture tools write (tcpdump's own limit)."""
_MAGIC = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
"""First bytes -> byte order, and nanoseconds in a unit of the packets' fractions of a second."""
_PCAPNG = b"\x0a\x0d\x0d\x0a"
_ETHERNET, _RAW_IP, _LINUX_COOKED, _NULL = 1, 101, 113, 0
_IPV4, _VLAN = 0x0800, (0x8100, 0x88A8)
_UDP = 17


def is_capture(head: bytes) -> bool:
    """Whether a file that begins so is a packet capture (of either format)."""
    return head[:4] in _MAGIC or head[:4] == _PCAPNG


def udp_payloads(path: Path) -> Iterator[tuple[int, bytes]]:
    """(stamp of the capture in nanoseconds, payload) of each whole UDP datagram over IPv4; a cut-off end is left out.

    Raises:
        FileFormatError: the file is no capture, or is damaged.
    """
    try:
        with path.open("rb") as stream:
            yield from _read(stream, path)
    except OSError as error:
        raise FileFormatError(path, "", f"cannot be read: {error.strerror or error}") from error


def _read(stream: BinaryIO, path: Path) -> Iterator[tuple[int, bytes]]:
    head = stream.read(24)
    if head[:4] == _PCAPNG:
        hint = "is a pcapng capture; convert it with: editcap -F pcap IN OUT"
        raise FileFormatError(path, "", hint)
    if head[:4] not in _MAGIC or len(head) < 24:
        raise FileFormatError(path, "", "is not a pcap capture (it does not begin with the signature of one)")
    order, unit = _MAGIC[head[:4]]
    link = struct.unpack(order + "I", head[20:24])[0] & 0xFFFF
    if link not in (_ETHERNET, _RAW_IP, _LINUX_COOKED, _NULL):
        raise FileFormatError(path, "link type", f"{link}; known: 0 (loopback), 1 (Ethernet), 101 (IP), 113 (Linux)")
    record = struct.Struct(order + "IIII")
    while len(header := stream.read(record.size)) == record.size:
        seconds, fraction, length, _ = record.unpack(header)
        if length > MAX_PACKET or fraction * unit >= 1_000_000_000:
            where = f"packet at byte {stream.tell() - record.size}"
            raise FileFormatError(path, where, f"damaged header ({length} bytes; at most {MAX_PACKET} are valid)")
        packet = stream.read(length)
        if len(packet) < length:
            return
        payload = _udp(packet, link)
        if payload is not None:
            yield seconds * 1_000_000_000 + fraction * unit, payload


def _udp(packet: bytes, link: int) -> bytes | None:
    """The payload, None if it is anything but a whole UDP datagram over IPv4 that was not fragmented."""
    start = {_ETHERNET: 14, _RAW_IP: 0, _LINUX_COOKED: 16, _NULL: 4}[link]
    if link in (_ETHERNET, _LINUX_COOKED):
        kind = int.from_bytes(packet[start - 2 : start], "big")
        while kind in _VLAN:
            kind, start = int.from_bytes(packet[start + 2 : start + 4], "big"), start + 4
        if kind != _IPV4:
            return None
    if len(packet) < start + 20 or packet[start] >> 4 != 4 or packet[start + 9] != _UDP:
        return None
    fragment = int.from_bytes(packet[start + 6 : start + 8], "big") & 0x3FFF  # offset, and "more fragments"
    udp = start + 4 * (packet[start] & 15)
    if fragment or udp < start + 20 or len(packet) < udp + 8:
        return None
    length = int.from_bytes(packet[udp + 4 : udp + 6], "big")
    return packet[udp + 8 : udp + length] if 8 <= length <= len(packet) - udp else None
