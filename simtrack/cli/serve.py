"""``simtrack serve``: a stage as a service for other processes and machines."""

from typing import Annotated, Literal

import tyro


def serve(
    what: Annotated[Literal["segmenter"], tyro.conf.Positional],
    segmenter: str,
    host: str = "127.0.0.1",
    port: int = 8765,
) -> int:
    """Segment images that others send over HTTP (docs/mapping.md), until stopped.

    Args:
        what: What answers: segmenter.
        segmenter: A folder or .onnx file that `simtrack train segmenter` wrote, or package.module:Class of yours.
        host: Address to listen on; the default can be reached from this machine alone.
        port: To listen on; 0 takes a free one.
    """
    from simtrack.errors import InvalidValueError
    from simtrack.perception.segmentation.loading import make_segmenter
    from simtrack.perception.segmentation.service import SegmenterServer

    if not 0 <= port < 65536:
        raise InvalidValueError("port", port, "0 to 65535")
    with SegmenterServer(make_segmenter(segmenter), segmenter, host, port) as server:
        print(f"{what} {segmenter} answers at {server.url} (Ctrl-C ends it)", flush=True)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print("stopped")
    return 0
