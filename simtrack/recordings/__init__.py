"""Sensor logs: a recording feeds a perception stack as a simulation does.

`McapWriter` logs the feed as ROS 2 messages in MCAP, `open_recording` reads it back frame by frame and bit by bit, in
the order of arrival, together with the map, the models and the robot's body that a stack needs. `RecordedDetector`
answers what the recorded detector answered. Labels, if any, lie apart; `strip_labels` removes them.

`open_log` reads what others record: folders of RGB-D images, of lidar scans, packet captures; see
`simtrack.recordings.source` for the formats, which it tells apart by itself.
"""

from simtrack.recordings.log import LabelledObject, PosedFrame, RecordingWarning, SensorLog
from simtrack.recordings.reader import RecordedDetector, Recording, open_recording, strip_labels
from simtrack.recordings.rgbd_folders import CameraOptions
from simtrack.recordings.source import find_source, is_mcap, open_log
from simtrack.recordings.writer import McapWriter

__all__ = [
    "CameraOptions",
    "LabelledObject",
    "McapWriter",
    "PosedFrame",
    "RecordedDetector",
    "Recording",
    "RecordingWarning",
    "SensorLog",
    "find_source",
    "is_mcap",
    "open_log",
    "open_recording",
    "strip_labels",
]
