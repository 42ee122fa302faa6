"""A segmenter as a service over HTTP, as the reconstruction paper has one on a server; see `wire` for what is sent."""

import json
import logging
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from simtrack.errors import InvalidValueError, StageError
from simtrack.perception.segmentation import wire
from simtrack.perception.segmentation.panoptic import Segmenter

PORT = 8765
WAITING = 8
"""Requests that may wait for their turn; more are refused."""
IDLE = 30.0
"""Seconds after which a connection on which nothing comes is closed."""
_log = logging.getLogger("simtrack.segmentation")


class SegmenterServer(ThreadingHTTPServer):
    """Answers one request after the other with a segmenter; a context manager."""

    daemon_threads = True

    def __init__(self, segmenter: Segmenter, name: str, host: str = "127.0.0.1", port: int = PORT) -> None:
        """Listen, on this machine alone unless another `host` is given; port 0 takes one that is free.

        Raises:
            StageError: the port is taken, or there is no such host.
        """
        self.segmenter, self.name = segmenter, name
        self.turn, self.waiting = threading.Lock(), threading.BoundedSemaphore(WAITING)
        try:
            super().__init__((host, port), _Handler)
        except (OSError, OverflowError) as error:
            raise StageError("segmenter service", f"{host}:{port}", f"cannot listen there: {error}") from error

    @property
    def url(self) -> str:
        """Where it can be asked."""
        host, port = self.server_address[:2]
        return f"http://{host!s}:{port}"


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = IDLE
    server: SegmenterServer  # pyright: ignore[reportIncompatibleVariableOverride]

    def do_GET(self) -> None:
        """Tell who answers here."""
        if self.path != "/health":
            return self._refuse(404, f"{self.path[:80]} is not here; GET /health, POST /segment")
        about = {"service": wire.SERVICE, "version": wire.VERSION, "segmenter": self.server.name}
        return self._answer(200, json.dumps(about).encode(), "application/json")

    def do_POST(self) -> None:
        """Segment an image."""
        if self.path != "/segment":
            return self._refuse(404, f"{self.path[:80]} is not here; GET /health, POST /segment")
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal():
            return self._refuse(411, "the length of the request is missing")
        if int(length) > wire.MOST_BYTES:
            return self._refuse(413, f"more than {wire.MOST_BYTES} bytes")
        body = self.rfile.read(int(length))
        if len(body) < int(length):
            return self._refuse(400, f"{len(body)} bytes of {length}")
        if not self.server.waiting.acquire(blocking=False):
            return self._refuse(503, f"{WAITING} requests are waiting already")
        try:
            return self._segment(body)
        finally:
            self.server.waiting.release()

    def _segment(self, body: bytes) -> None:
        try:
            frame = wire.unpacked_frame(body)
        except InvalidValueError as error:
            return self._refuse(400, str(error))
        try:
            with self.server.turn:
                segments = self.server.segmenter.segment(frame)
        except Exception as error:  # of somebody else's code: the service goes on
            _log.exception("the segmenter failed")
            return self._refuse(500, f"the segmenter raised {type(error).__name__}: {error}")
        if segments is None:
            return self._refuse(500, "the segmenter failed on this image")
        return self._answer(200, wire.packed_segments(segments), wire.CONTENT)

    def _answer(self, code: int, body: bytes, kind: str) -> None:
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        if code >= 400:  # what was not read of the request would be taken for the next one
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(body)

    def _refuse(self, code: int, reason: str) -> None:
        self._answer(code, json.dumps({"error": reason}).encode(), "application/json")

    def log_message(self, format: str, *args: object) -> None:
        """Quietly."""
        _log.debug(format, *args)
