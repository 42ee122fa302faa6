"""simtrack: a closed-loop harness for object trackers and scene graphs of robots, with exact ground truth."""

__version__ = "0.1.0"
