"""What lies where in simtrack's MCAP logs: topics, frames and attachments.

==============================  ============================  =========================================================
topic                           type                          content
==============================  ============================  =========================================================
``/camera/depth/image_rect``    ``sensor_msgs/Image``         32FC1, metres, 0 = no reading
``/camera/depth/camera_info``   ``sensor_msgs/CameraInfo``    one a depth image
``/camera/color/image_rect``    ``sensor_msgs/Image``         rgb8, registered to the depth image; only where rendered
``/camera/color/camera_info``   ``sensor_msgs/CameraInfo``    one a colour image
``/camera/frame``               ``simtrack_msgs/Frame``       closes one RGB-D frame; pose = T_base_camera, exact
``/lidar/points``               ``sensor_msgs/PointCloud2``   XYZIRT and the exact range and direction (`ros2`)
``/lidar/frame``                ``simtrack_msgs/Frame``       closes one scan; pose = T_base_lidar, exact
``/odom``                       ``nav_msgs/Odometry``         wheel odometry
``/odom/frame``                 ``simtrack_msgs/Frame``       closes one reading; pose = T_odom_base, exact
``/joint_states``               ``sensor_msgs/JointState``    encoders
``/detections``                 ``simtrack_msgs/Detections``  a detector's answers, logged when they were given
``/tf``, ``/tf_static``         ``tf2_msgs/TFMessage``        the same poses as quaternions, for other ROS tools
``/ground_truth/tf``            ``tf2_msgs/TFMessage``        labels: map -> base and objects; nothing else reads them
==============================  ============================  =========================================================

Stamps of the data stand in the headers. ``log_time`` is the time of arrival, made strictly increasing by nanoseconds,
so that every reader sees the messages in the order in which they arrived, late and duplicated ones included.

Attachments at the start of the file hold what a perception stack needs beside the feed: ``static_map.npz``,
``models.npz`` (the estimator's object models), ``robot.npz`` (kinematic tree), ``metadata.json``. Labels are all that
is named ``ground_truth``: topics by prefix, keys of the metadata by name.
"""

DEPTH = "/camera/depth/image_rect"
DEPTH_INFO = "/camera/depth/camera_info"
COLOR = "/camera/color/image_rect"
COLOR_INFO = "/camera/color/camera_info"
CAMERA_FRAME = "/camera/frame"
POINTS = "/lidar/points"
LIDAR_FRAME = "/lidar/frame"
ODOMETRY = "/odom"
ODOMETRY_FRAME = "/odom/frame"
JOINTS = "/joint_states"
DETECTIONS = "/detections"
TF = "/tf"
TF_STATIC = "/tf_static"
LABELS = "/ground_truth/tf"

LABEL_TOPICS = "/ground_truth/"
LABEL_KEY = "ground_truth"

MESSAGES = {
    DEPTH: "sensor_msgs/Image",
    DEPTH_INFO: "sensor_msgs/CameraInfo",
    COLOR: "sensor_msgs/Image",
    COLOR_INFO: "sensor_msgs/CameraInfo",
    CAMERA_FRAME: "simtrack_msgs/Frame",
    POINTS: "sensor_msgs/PointCloud2",
    LIDAR_FRAME: "simtrack_msgs/Frame",
    ODOMETRY: "nav_msgs/Odometry",
    ODOMETRY_FRAME: "simtrack_msgs/Frame",
    JOINTS: "sensor_msgs/JointState",
    DETECTIONS: "simtrack_msgs/Detections",
    TF: "tf2_msgs/TFMessage",
    TF_STATIC: "tf2_msgs/TFMessage",
    LABELS: "tf2_msgs/TFMessage",
}
"""Topic -> type of its messages."""

MAP_FRAME = "map"
ODOM_FRAME = "odom"
BASE_FRAME = "base_link"
CAMERA_OPTICAL_FRAME = "camera_optical_frame"
LIDAR_SENSOR_FRAME = "lidar"

STATIC_MAP = "static_map.npz"
MODELS = "models.npz"
ROBOT = "robot.npz"
METADATA = "metadata.json"
MEDIA_TYPES = {".npz": "application/zip", ".json": "application/json"}
"""Suffix of an attachment's name -> its media type."""

TRANSIENT_LOCAL = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n"
    "  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  liveliness: 1\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  avoid_ros_namespace_conventions: false"
)
"""``offered_qos_profiles`` of ``/tf_static`` as rosbag2 writes it: keep last 1, reliable, transient local."""
