"""Sensor logs: a recording feeds a perception stack as a simulation does.

`McapWriter` logs the feed as ROS 2 messages in MCAP, `open_recording` reads it back frame by frame and bit by bit, in
the order of arrival, together with the map, the models and the robot's body that a stack needs. `RecordedDetector`
answers what the recorded detector answered. Labels, if any, lie apart; `strip_labels` removes them.
"""

from simtrack.recordings.reader import RecordedDetector, Recording, RecordingWarning, open_recording, strip_labels
from simtrack.recordings.writer import McapWriter

__all__ = [
    "McapWriter",
    "RecordedDetector",
    "Recording",
    "RecordingWarning",
    "open_recording",
    "strip_labels",
]
