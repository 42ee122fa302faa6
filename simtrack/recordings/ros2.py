"""ROS 2 messages as bytes: definitions (``ros2msg``), CDR encoding, and the messages that simtrack logs.

Field by field after ros2/common_interfaces, ros2/geometry2 and the driver velodyne_pointcloud; serialised as plain CDR,
little-endian, each value aligned to its own size counted from after the four-byte encapsulation header (OMG DDS-XTypes
7.4.1). Decoders need nothing from here: the definitions travel in the log.
"""

import struct
from collections.abc import Mapping

import numpy as np

from simtrack.contracts import NANOSECONDS, DetectionResult, Float64, JointState, LidarScan, Odometry, RgbdFrame
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import quaternion_from_rotation

_MESSAGES = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
    "geometry_msgs/Transform": "Vector3 translation\nQuaternion rotation\n",
    "geometry_msgs/Pose": "Point position\nQuaternion orientation\n",
    "geometry_msgs/Twist": "Vector3 linear\nVector3 angular\n",
    "geometry_msgs/PoseWithCovariance": "Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/TwistWithCovariance": "Twist twist\nfloat64[36] covariance\n",
    "geometry_msgs/TransformStamped": "std_msgs/Header header\nstring child_frame_id\nTransform transform\n",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "nav_msgs/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
        "geometry_msgs/TwistWithCovariance twist\n"
    ),
    "sensor_msgs/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    ),
    "sensor_msgs/Image": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n"
        "uint8[] data\n"
    ),
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n"
    ),
    "sensor_msgs/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
        "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nRegionOfInterest roi\n"
    ),
    "sensor_msgs/PointField": (
        "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\nuint8 FLOAT32=7\n"
        "uint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n"
    ),
    "sensor_msgs/PointCloud2": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nPointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
    ),
    # What ROS has no field for: the sensor's running number, and the pose to the last bit, which a quaternion loses.
    "simtrack_msgs/Frame": "std_msgs/Header header\nint64 sequence\nfloat64[16] pose\n",
    "simtrack_msgs/Detection": (
        "string class_name\nfloat64[18] keypoints\nfloat64[9] keypoint_sigma\nfloat64[4] box\nfloat64 score\n"
    ),
    "simtrack_msgs/Detections": (
        "std_msgs/Header header\nint64 available\nint64 next_image\nstring status\nDetection[] detections\n"
    ),
}

VELODYNE_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time", "range", "direction_x", "direction_y", "direction_z"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4", "<f4", "<f4", "<f4", "<f4"],
        "offsets": [0, 4, 8, 12, 16, 18, 22, 26, 30, 34],
        "itemsize": 38,
    }
)
"""The 22 packed bytes of velodyne_pointcloud's XYZIRT point, then what x, y, z round away: range and unit direction.

``range`` is inf and x, y, z are NaN where there was no return; ``time`` runs from 0 after the header's stamp, which is
that of the first shot.
"""

POINT_FIELDS = [
    (name, entry[1], {"<f4": 7, "<u2": 4}[entry[0].str], 1) for name, entry in (VELODYNE_POINT.fields or {}).items()
]
"""(name, offset, datatype, count) of each `sensor_msgs/PointField`."""


def schema_name(message: str) -> str:
    """``pkg/msg/Name``, as MCAP's registry wants it, of ``pkg/Name``."""
    package, name = message.split("/")
    return f"{package}/msg/{name}"


def schema_text(message: str) -> bytes:
    """Definition of ``pkg/Name`` followed by those that it needs, as rosbag2 writes them."""
    needed = [message]
    for name in needed:  # grows while it is walked: breadth first
        package = name.split("/")[0]
        for line in _MESSAGES[name].splitlines():
            kind = line.split()[0].split("[")[0]
            for candidate in (kind, f"{package}/{kind}"):
                if candidate in _MESSAGES and candidate not in needed:
                    needed.append(candidate)
    parts = [_MESSAGES[message]] + [f"MSG: {name}\n{_MESSAGES[name]}" for name in needed[1:]]
    return ("=" * 80 + "\n").join(parts).encode()


class _Cdr:
    """Collects values as little-endian CDR."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def pack(self, code: str, *values: float | int | bool) -> "_Cdr":
        """Append numbers of one `struct` type code, aligned to their size."""
        size = struct.calcsize("<" + code)
        self._buffer += bytes(-len(self._buffer) % size)
        self._buffer += struct.pack(f"<{len(values)}{code}", *values)
        return self

    def string(self, text: str) -> "_Cdr":
        encoded = text.encode() + b"\0"
        self.pack("I", len(encoded))
        self._buffer += encoded
        return self

    def data(self, data: bytes) -> "_Cdr":
        """Append a uint8[]."""
        self.pack("I", len(data))
        self._buffer += data
        return self

    def array(self, values: Float64) -> "_Cdr":
        """Append a float64 array of fixed length, flattened."""
        return self.pack("d", *np.asarray(values, dtype=np.float64).ravel().tolist())

    def header(self, stamp: int, frame_id: str) -> "_Cdr":
        seconds, nanoseconds = divmod(stamp, NANOSECONDS)
        if not -(2**31) <= seconds < 2**31:
            raise InvalidValueError("stamp", stamp, "nanoseconds whose seconds fit 32 bits, as ROS 2 has them")
        return self.pack("i", seconds).pack("I", nanoseconds).string(frame_id)

    def translation_rotation(self, T: Float64) -> "_Cdr":
        w, x, y, z = quaternion_from_rotation(T[:3, :3]).tolist()
        return self.array(T[:3, 3]).pack("d", x, y, z, w)

    def message(self) -> bytes:
        """The encapsulation header (CDR_LE) and the body."""
        return b"\x00\x01\x00\x00" + bytes(self._buffer)


def depth_image(frame: RgbdFrame, frame_id: str) -> bytes:
    """`sensor_msgs/Image`, 32FC1, metres, 0 = no reading (REP 118)."""
    return _image(frame.stamp, frame_id, "32FC1", np.ascontiguousarray(frame.depth, dtype="<f4"))


def color_image(frame: RgbdFrame, frame_id: str) -> bytes:
    """`sensor_msgs/Image`, rgb8, of a frame that has colour."""
    assert frame.rgb is not None
    return _image(frame.stamp, frame_id, "rgb8", np.ascontiguousarray(frame.rgb, dtype=np.uint8))


def _image(stamp: int, frame_id: str, encoding: str, pixels: np.ndarray) -> bytes:
    height, width = pixels.shape[:2]
    cdr = _Cdr().header(stamp, frame_id).pack("I", height, width).string(encoding).pack("B", 0)
    return cdr.pack("I", pixels.nbytes // height if height else 0).data(pixels.tobytes()).message()


def camera_info(frame: RgbdFrame, frame_id: str) -> bytes:
    """`sensor_msgs/CameraInfo` of a camera without distortion."""
    camera = frame.intrinsics
    cdr = _Cdr().header(frame.stamp, frame_id).pack("I", camera.height, camera.width)
    cdr.string("plumb_bob").pack("I", 5).array(np.zeros(5))
    cdr.array(camera.matrix).array(np.eye(3)).array(np.column_stack([camera.matrix, np.zeros(3)]))
    return cdr.pack("I", 0, 0).pack("I", 0, 0, 0, 0).pack("B", 0).message()


def point_cloud(scan: LidarScan, frame_id: str) -> bytes:
    """`sensor_msgs/PointCloud2` of `VELODYNE_POINT`, one row, in the order of the shots."""
    points = np.zeros(len(scan.ranges), dtype=VELODYNE_POINT)
    hit = np.isfinite(scan.ranges)
    for axis, name in enumerate("xyz"):
        points[name] = np.nan
        points[name][hit] = scan.ranges[hit] * scan.directions[hit, axis]
        points[f"direction_{name}"] = scan.directions[:, axis]
    points["range"], points["intensity"] = scan.ranges, scan.intensities
    points["ring"], points["time"] = scan.rings, scan.times
    cdr = _Cdr().header(scan.stamp, frame_id).pack("I", 1, len(points)).pack("I", len(POINT_FIELDS))
    for name, offset, datatype, count in POINT_FIELDS:
        cdr.string(name).pack("I", offset).pack("B", datatype).pack("I", count)
    cdr.pack("B", 0).pack("I", VELODYNE_POINT.itemsize, points.nbytes).data(points.tobytes())
    return cdr.pack("B", bool(hit.all())).message()


def odometry(reading: Odometry, frame_id: str, child_frame_id: str) -> bytes:
    """`nav_msgs/Odometry`; covariances are zero, which ROS reads as unknown."""
    cdr = _Cdr().header(reading.stamp, frame_id).string(child_frame_id)
    cdr.translation_rotation(reading.T_odom_base).array(np.zeros(36))
    return cdr.pack("d", reading.linear, 0, 0, 0, 0, reading.angular).array(np.zeros(36)).message()


def joint_state(reading: JointState) -> bytes:
    """`sensor_msgs/JointState` with names and positions only."""
    cdr = _Cdr().header(reading.stamp, "").pack("I", len(reading.names))
    for name in reading.names:
        cdr.string(name)
    cdr.pack("I", len(reading.positions))
    if len(reading.positions):
        cdr.array(reading.positions)
    return cdr.pack("I", 0).pack("I", 0).message()


def transforms(stamp: int, parent: str, children: Mapping[str, Float64]) -> bytes:
    """`tf2_msgs/TFMessage`: child frame -> (4, 4) T_parent_child."""
    cdr = _Cdr().pack("I", len(children))
    for child, T in children.items():
        cdr.header(stamp, parent).string(child).translation_rotation(T)
    return cdr.message()


def frame_record(stamp: int, sequence: int, pose: Float64, frame_id: str) -> bytes:
    """`simtrack_msgs/Frame`: closes the messages of one sensor frame; `pose` is (4, 4), row-major."""
    return _Cdr().header(stamp, frame_id).pack("q", sequence).array(pose).message()


def detections(result: DetectionResult, frame_id: str) -> bytes:
    """`simtrack_msgs/Detections`: pixels; header = stamp of the image, `available` and `next_image` in nanoseconds."""
    cdr = _Cdr().header(result.stamp, frame_id).pack("q", result.available)
    cdr.pack("q", result.available if result.next_image is None else result.next_image).string(str(result.status))
    cdr.pack("I", len(result.detections))
    for detection in result.detections:
        cdr.string(detection.class_name).array(detection.keypoints).array(detection.keypoint_sigma)
        cdr.array(detection.box).pack("d", detection.score)
    return cdr.message()
