"""What a segmentation service is asked and answers: NumPy's .npz files, whose sizes are checked before they are read.

POST /segment, the request
    depth       (H, W) float32, metres along the optical axis, 0 = no reading
    rgb         (H, W, 3) uint8; may be missing
    intrinsics  (4,) float64: fx, fy, cx, cy, pixels
    stamp       () int64, nanoseconds
200, the answer
    image       (H, W), any integers: number of the segment that a pixel belongs to, from 1; 0 = none
    classes     (N,) text
    scores      (N,) float32, 0 to 1
    stamp       () int64, that of the request
Other codes carry a JSON object with the field ``error``: 400 the request is malformed, 413 it is too large, 500 the
segmenter failed, 503 too many are waiting. GET /health answers {"service": "simtrack-segmenter", "version": 1,
"segmenter": NAME}.
"""

import ast
import io
import struct
import zipfile
import zlib
from collections.abc import Mapping

import numpy as np

from simtrack.contracts import CameraIntrinsics, RgbdFrame
from simtrack.errors import InvalidValueError
from simtrack.perception.segmentation.panoptic import MOST_SEGMENTS, PanopticSegments

CONTENT = "application/x-npz"
SERVICE, VERSION = "simtrack-segmenter", 1
MOST_PIXELS = 16_000_000
MOST_BYTES = 8 * MOST_PIXELS + 1_000_000
"""Of a request or an answer, packed or not."""
_ARRAYS = 16
_HEADER = 4096
_BROKEN = (
    zipfile.BadZipFile, OSError, EOFError, ValueError, NotImplementedError, RuntimeError, struct.error, zlib.error,
)  # fmt: skip


def packed_frame(frame: RgbdFrame) -> bytes:
    """The request about a frame."""
    K = frame.intrinsics
    arrays = {
        "depth": frame.depth.astype(np.float32, copy=False),
        "intrinsics": np.array([K.fx, K.fy, K.cx, K.cy]),
        "stamp": np.int64(frame.stamp),
    }
    return _packed(arrays if frame.rgb is None else {**arrays, "rgb": frame.rgb})


def unpacked_frame(data: bytes) -> RgbdFrame:
    """The frame that a request tells of; raises InvalidValueError that names the array."""
    arrays = _unpacked(data)
    depth = _array(arrays, "depth", np.float32, 2)
    if not 0 < depth.size <= MOST_PIXELS:
        raise InvalidValueError("depth", depth.shape, f"1 to {MOST_PIXELS} pixels")
    intrinsics = _array(arrays, "intrinsics", np.float64, 1)
    if intrinsics.shape != (4,) or not np.isfinite(intrinsics).all() or not (intrinsics[:2] > 0.0).all():
        raise InvalidValueError("intrinsics", intrinsics.tolist(), "fx, fy, cx, cy in pixels, finite, fx and fy > 0")
    rgb = None
    if "rgb" in arrays:
        rgb = _array(arrays, "rgb", np.uint8, 3)
        if rgb.shape != (*depth.shape, 3):
            raise InvalidValueError("rgb", rgb.shape, f"{(*depth.shape, 3)}, as depth has")
    fx, fy, cx, cy = intrinsics.tolist()
    camera = CameraIntrinsics(depth.shape[1], depth.shape[0], fx, fy, cx, cy)
    return RgbdFrame(_stamp(arrays), depth, rgb, camera, np.eye(4))


def packed_segments(segments: PanopticSegments) -> bytes:
    """The answer with segments."""
    image = segments.image.astype(np.uint8 if len(segments) < 256 else np.uint16)
    names = np.array(segments.classes, dtype=np.str_) if segments.classes else np.empty(0, "<U1")
    return _packed({"image": image, "classes": names, "scores": segments.scores, "stamp": np.int64(segments.stamp)})


def unpacked_segments(data: bytes, stamp: int, shape: tuple[int, ...]) -> PanopticSegments:
    """The segments that an answer tells of.

    Args:
        data: the answer.
        stamp: of the request.
        shape: (H, W) of the request.

    Raises:
        InvalidValueError: it is malformed, or answers something else; names the array.
    """
    arrays = _unpacked(data)
    image = _array(arrays, "image", None, 2)
    if image.dtype.kind not in "iub" or image.shape != shape:
        raise InvalidValueError("image", (image.dtype.str, image.shape), f"integers of shape {shape}")
    names = _array(arrays, "classes", None, 1)
    if names.dtype.kind != "U" and names.size:
        raise InvalidValueError("classes", names.dtype.str, "text")
    scores = _array(arrays, "scores", np.float32, 1)
    if not ((scores >= 0.0) & (scores <= 1.0)).all():
        raise InvalidValueError("scores", scores.tolist()[:10], "0 to 1")
    if _stamp(arrays) != stamp:
        raise InvalidValueError("stamp", _stamp(arrays), f"{stamp}, that of the request")
    if len(names) > MOST_SEGMENTS:
        raise InvalidValueError("classes", len(names), f"at most {MOST_SEGMENTS}")
    if image.size and not 0 <= int(image.min()) <= int(image.max()) <= len(names):
        raise InvalidValueError(
            "image", (int(image.min()), int(image.max())), f"numbers of segments, 0 to {len(names)}"
        )
    return PanopticSegments(stamp, image.astype(np.int32), tuple(map(str, names.tolist())), scores)


def _packed(arrays: Mapping[str, object]) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def _unpacked(data: bytes) -> dict[str, np.ndarray]:
    """Arrays by name; nothing is read before its size was seen to be allowed."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
            if len(entries) > _ARRAYS or sum(entry.file_size for entry in entries) > MOST_BYTES:
                raise InvalidValueError("arrays", len(entries), f"at most {_ARRAYS}, of {MOST_BYTES} bytes together")
            return {entry.filename.removesuffix(".npy"): _read(archive, entry) for entry in entries}
    except InvalidValueError:
        raise
    except _BROKEN as error:
        raise InvalidValueError("body", f"{len(data)} bytes", f"an .npz file; {error}") from error


def _read(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    """One array, of exactly as many bytes as its header and its shape need."""
    with archive.open(entry) as stream:
        content = stream.read(entry.file_size)
    try:
        if content[:6] != b"\x93NUMPY" or content[6] not in (1, 2):
            raise ValueError("no .npy file")
        wide = content[6] == 2
        length = int.from_bytes(content[8 : 12 if wide else 10], "little")
        start = (12 if wide else 10) + length
        if length > _HEADER:
            raise ValueError("header too long")
        header = ast.literal_eval(content[start - length : start].decode("latin1"))
        dtype, shape = np.dtype(header["descr"]), tuple(int(n) for n in header["shape"])
        if dtype.hasobject or dtype.names is not None or dtype.itemsize == 0:
            raise ValueError(f"dtype {dtype}")
        if any(n < 0 for n in shape) or len(content) - start != dtype.itemsize * int(np.prod(shape, dtype=object)):
            raise ValueError(f"shape {shape} does not fit {len(content) - start} bytes")
        values = np.frombuffer(content, dtype, offset=start)
        return values.reshape(shape, order="F" if header["fortran_order"] else "C").copy()
    except (ValueError, KeyError, TypeError, SyntaxError, IndexError, MemoryError, RecursionError) as error:
        raise InvalidValueError(
            entry.filename[:80], f"{len(content)} bytes", f"a plain NumPy array; {error}"
        ) from error


def _array(arrays: Mapping[str, np.ndarray], name: str, dtype: type[np.generic] | None, dimensions: int) -> np.ndarray:
    if name not in arrays:
        raise InvalidValueError(name, None, f"an array; there are: {', '.join(sorted(arrays)) or 'none'}")
    values = arrays[name]
    if values.ndim != dimensions or (dtype is not None and values.dtype != dtype):
        kind = "an array" if dtype is None else np.dtype(dtype).name
        raise InvalidValueError(name, (values.dtype.str, values.shape), f"{kind} of {dimensions} dimensions")
    return values


def _stamp(arrays: Mapping[str, np.ndarray]) -> int:
    stamp = _array(arrays, "stamp", None, 0)
    if stamp.dtype.kind not in "iu":
        raise InvalidValueError("stamp", stamp.dtype.str, "an integer, nanoseconds")
    return int(stamp)
