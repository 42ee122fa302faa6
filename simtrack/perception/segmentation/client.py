"""Asks a segmentation service; see `wire` for what is sent."""

import http.client
import json
import socket
import threading
from contextlib import suppress
from urllib.parse import urlsplit

from simtrack.contracts import RgbdFrame
from simtrack.errors import InvalidValueError, StageError
from simtrack.perception.segmentation import wire
from simtrack.perception.segmentation.panoptic import PanopticSegments

TIMEOUT = 5.0
MOST_TEXT = 2000


class HttpSegmenter:
    """Implements `simtrack.perception.segmentation.panoptic.Segmenter` by asking a service.

    A service that is down, slow, or answers nonsense, costs the frame: `segment` gives None and counts why.
    """

    def __init__(self, url: str, timeout: float = TIMEOUT) -> None:
        """Ask who answers there.

        Args:
            url: such as http://localhost:8765.
            timeout: seconds from the beginning of a request to the end of its answer.

        Raises:
            InvalidValueError: the address or the time limit cannot be used.
            StageError: nobody answers, or somebody else.
        """
        if not 0.0 < timeout <= 3600.0:
            raise InvalidValueError("timeout", timeout, "above 0, up to 3600 seconds")
        parts = urlsplit(url)
        try:
            host, port = parts.hostname, parts.port or 80
        except ValueError as error:
            raise InvalidValueError("segmenter", url, "http://HOST:PORT") from error
        if parts.scheme != "http" or not host or parts.path not in ("", "/") or parts.query:
            raise InvalidValueError("segmenter", url, "http://HOST:PORT")
        self.url, self.timeout, self._host, self._port = url, timeout, host, port
        self.failures: dict[str, int] = {}
        """Reason -> frames that were lost to it."""
        try:
            code, body = self._ask("GET", "/health", b"", most=MOST_TEXT)
            about = json.loads(body) if code == 200 else None
        except (_Silent, ValueError) as error:
            reason = f"nobody answers as a segmenter ({error}); `simtrack serve segmenter` starts one"
            raise StageError("segmenter", url, reason) from error
        if not isinstance(about, dict) or about.get("service") != wire.SERVICE:
            raise StageError("segmenter", url, "is no segmentation service; `simtrack serve segmenter` starts one")
        if about.get("version") != wire.VERSION:
            raise StageError("segmenter", url, f"speaks version {about.get('version')!r}, not {wire.VERSION}")

    def segment(self, frame: RgbdFrame) -> PanopticSegments | None:
        """Segments of one image, None where the service failed."""
        try:
            code, body = self._ask("POST", "/segment", wire.packed_frame(frame), most=wire.MOST_BYTES)
            if code != 200:
                return self._failed(_told(code, body))
            return wire.unpacked_segments(body, frame.stamp, frame.depth.shape)
        except _Silent as error:
            return self._failed(str(error))
        except InvalidValueError as error:
            return self._failed(f"malformed answer: {error}")

    def _failed(self, reason: str) -> None:
        self.failures[reason] = self.failures.get(reason, 0) + 1

    def _ask(self, method: str, path: str, body: bytes, most: int) -> tuple[int, bytes]:
        """Code and body of the answer to one request, on a connection of its own."""
        connection = http.client.HTTPConnection(self._host, self._port, timeout=self.timeout)
        late = threading.Event()

        def hang_up() -> None:
            """The socket's own limit begins anew with every byte: this one does not."""
            late.set()
            with suppress(OSError, AttributeError):
                connection.sock.shutdown(socket.SHUT_RDWR)

        watch = threading.Timer(self.timeout, hang_up)
        watch.daemon = True
        watch.start()
        try:
            headers = {"Content-Type": wire.CONTENT} if body else {}
            connection.request(method, path, body or None, headers)
            answer = connection.getresponse()
            content = answer.read(most + 1)
            if late.is_set():
                raise TimeoutError
            if len(content) > most:
                raise _Silent(f"the answer has more than {most} bytes")
            if answer.length:
                raise _Silent("the connection broke off")
            return answer.status, content
        except (OSError, http.client.HTTPException) as error:
            if late.is_set() or isinstance(error, TimeoutError):
                raise _Silent(f"no answer within {self.timeout:g} s") from error
            raise _Silent(f"{type(error).__name__}: {error}") from error
        finally:
            watch.cancel()
            connection.close()


class _Silent(Exception):
    """There is no answer, for a reason."""


def _told(code: int, body: bytes) -> str:
    try:
        reason = json.loads(body[:MOST_TEXT])["error"]
    except (ValueError, KeyError, TypeError):
        reason = "no reason given"
    return f"the service answered {code}: {str(reason)[:200]}"
