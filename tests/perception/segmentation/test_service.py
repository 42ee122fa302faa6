"""Segmentation over HTTP: segments come back as they were, and what is down, slow or nonsense costs a frame."""

import json
import runpy
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.client import HTTPConnection
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.contracts import CameraIntrinsics, RgbdFrame
from simtrack.errors import InvalidValueError, StageError
from simtrack.perception.segmentation import wire
from simtrack.perception.segmentation.client import HttpSegmenter
from simtrack.perception.segmentation.loading import make_segmenter
from simtrack.perception.segmentation.panoptic import PanopticSegments, Segmenter
from simtrack.perception.segmentation.service import SegmenterServer

CAMERA = CameraIntrinsics(8, 6, 7.0, 7.5, 3.5, 2.5)


def frame(stamp: int = 5) -> RgbdFrame:
    rng = np.random.default_rng(stamp)
    depth = rng.uniform(0.5, 3.0, (6, 8)).astype(np.float32)
    return RgbdFrame(stamp, depth, rng.integers(0, 255, (6, 8, 3), np.uint8), CAMERA, np.eye(4))


class ByColour:
    """Bright pixels are a lamp; it remembers what it saw."""

    def __init__(self) -> None:
        self.seen: list[RgbdFrame] = []

    def segment(self, frame: RgbdFrame) -> PanopticSegments | None:
        self.seen.append(frame)
        assert frame.rgb is not None
        if not frame.depth.any():
            return None
        image = (frame.rgb[:, :, 0] > 100).astype(np.int32)
        return PanopticSegments(frame.stamp, image, ("lamp",), np.array([0.75], np.float32))


@contextmanager
def served(segmenter: Segmenter) -> Iterator[SegmenterServer]:
    with SegmenterServer(segmenter, "test", port=0) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def answering(reply: Callable[[socket.socket], None]) -> Iterator[str]:
    """A service that says who it is, and then does something else."""
    listener = socket.create_server(("127.0.0.1", 0))
    about = json.dumps({"service": wire.SERVICE, "version": wire.VERSION}).encode()
    health = b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n%s" % (len(about), about)

    def run() -> None:
        for what in (lambda s: s.sendall(health), reply):
            accepted, _ = listener.accept()
            with accepted:
                accepted.settimeout(2.0)
                accepted.recv(100_000)
                with suppress(OSError):
                    what(accepted)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    with listener:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        thread.join(5.0)


def test_segments_come_back_as_they_were() -> None:
    own, asked = ByColour(), frame()
    with served(own) as server:
        client = make_segmenter(server.url)
        assert isinstance(client, HttpSegmenter) and isinstance(client, Segmenter)
        found, direct = client.segment(asked), ByColour().segment(asked)
        assert client.segment(RgbdFrame(6, np.zeros((6, 8), np.float32), asked.rgb, CAMERA, np.eye(4))) is None
    assert found is not None and direct is not None
    np.testing.assert_array_equal(found.image, direct.image)
    assert (found.stamp, found.classes, found.scores.tolist()) == (5, ("lamp",), [0.75])
    np.testing.assert_array_equal(own.seen[0].depth, asked.depth)
    assert own.seen[0].intrinsics == CAMERA
    assert list(client.failures) == ["the service answered 500: the segmenter failed on this image"]


def test_a_segmenter_that_raises_costs_a_frame_and_the_service_goes_on(caplog: pytest.LogCaptureFixture) -> None:
    class Moody(ByColour):
        def segment(self, frame: RgbdFrame) -> PanopticSegments | None:
            if frame.stamp == 1:
                raise RuntimeError("not today")
            return super().segment(frame)

    with served(Moody()) as server:
        client = HttpSegmenter(server.url)
        assert client.segment(frame(1)) is None and client.segment(frame(2)) is not None
    assert "not today" in next(iter(client.failures)) and client.segment(frame(3)) is None
    assert len(client.failures) == 2  # nobody is there any more


def test_nobody_and_somebody_else_are_told_at_the_start() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        free = listener.getsockname()[1]
    with pytest.raises(StageError, match="simtrack serve segmenter"):
        HttpSegmenter(f"http://127.0.0.1:{free}", 1.0)
    for wrong in ("https://localhost:1", "http://", "http://localhost:99999", "http://localhost:1/there"):
        with pytest.raises(InvalidValueError, match="http://HOST:PORT"):
            HttpSegmenter(wrong)
    with pytest.raises(StageError, match="allowed: learned, a folder"):
        make_segmenter("mine")
    with served(ByColour()) as server, pytest.raises(StageError, match="cannot listen"):
        SegmenterServer(ByColour(), "second", port=server.server_address[1])


def test_a_slow_answer_is_not_waited_for() -> None:
    def drip(accepted: socket.socket) -> None:
        accepted.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 100000\r\n\r\n")
        for _ in range(200):
            accepted.sendall(b"x")
            time.sleep(0.01)

    with answering(drip) as url:
        client = HttpSegmenter(url, 0.15)
        assert client.segment(frame()) is None
    assert list(client.failures) == ["no answer within 0.15 s"]


@pytest.mark.parametrize(
    "reply", [b"", b"nonsense\r\n\r\n", b"HTTP/1.1 200 OK\r\nContent-Length: 3\r\n\r\nabc",
              b"HTTP/1.1 200 OK\r\nContent-Length: 30\r\n\r\nabc"],
)  # fmt: skip
def test_nonsense_costs_a_frame(reply: bytes) -> None:
    with answering(lambda accepted: accepted.sendall(reply)) as url:
        client = HttpSegmenter(url, 2.0)
        assert client.segment(frame()) is None and sum(client.failures.values()) == 1


@pytest.mark.parametrize(
    ("path", "headers", "body", "code"),
    [
        ("/elsewhere", {}, b"", 404),
        ("/segment", {}, b"no archive", 400),
        ("/segment", {"Content-Length": str(wire.MOST_BYTES + 1)}, b"", 413),
    ],
)
def test_requests_that_cannot_be_answered_are_refused(
    path: str, headers: dict[str, str], body: bytes, code: int
) -> None:
    with served(ByColour()) as server:
        connection = HTTPConnection("127.0.0.1", server.server_address[1], timeout=5.0)
        connection.request("POST", path, body, headers)
        answer = connection.getresponse()
        assert answer.status == code and json.loads(answer.read())["error"]
        connection.close()


def test_answers_about_something_else_are_refused() -> None:
    segments = ByColour().segment(frame())
    assert segments is not None
    packed = wire.packed_segments(segments)
    wire.unpacked_segments(packed, 5, (6, 8))
    with pytest.raises(InvalidValueError, match="stamp"):
        wire.unpacked_segments(packed, 6, (6, 8))
    with pytest.raises(InvalidValueError, match="image"):
        wire.unpacked_segments(packed, 5, (8, 6))


@settings(max_examples=60)
@given(st.data())
def test_whatever_comes_is_read_or_refused(data: st.DataObject) -> None:
    packed = bytearray(wire.packed_frame(frame()))
    for _ in range(data.draw(st.integers(1, 4))):
        packed[data.draw(st.integers(0, len(packed) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(packed[: data.draw(st.integers(0, len(packed)))])
    for body in (bytes(packed), cut):
        with suppress(InvalidValueError):
            assert wire.unpacked_frame(body).depth.ndim == 2


def test_an_archive_whose_members_begin_before_it_is_refused() -> None:
    packed = bytearray(wire.packed_frame(frame()))
    packed[-4] += 1  # where the directory is said to begin, 65,536 bytes too far
    with pytest.raises(InvalidValueError, match="npz"):
        wire.unpacked_frame(bytes(packed))


def test_an_archive_that_unpacks_to_too_much_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    packed = wire.packed_frame(frame())
    monkeypatch.setattr(wire, "MOST_BYTES", 300)
    with pytest.raises(InvalidValueError, match="bytes together"):
        wire.unpacked_frame(packed)


def test_the_example_of_a_coco_network_gives_simtracks_names_and_one_segment_a_stuff() -> None:
    example = runpy.run_path(str(Path(__file__).parents[3] / "docs" / "examples" / "coco_panoptic.py"))
    image = np.array([[1, 2, 3], [4, 4, -1]])
    labels = {0: "floor-wood", 1: "rug-merged", 2: "couch", 3: "cat"}
    infos = [{"id": k + 1, "label_id": k, "score": 0.6 + 0.1 * k} for k in range(4)]
    found = example["segments_of"](7, image, infos, labels)
    assert found.classes == ("floor", "sofa", "cat") and found.stamp == 7
    assert found.image.tolist() == [[1, 1, 2], [3, 3, 0]]
    np.testing.assert_allclose(found.scores, [0.7, 0.8, 0.9], rtol=1e-6)
