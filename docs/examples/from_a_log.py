"""Works from a recording and writes BOP results: the pose that PnP gives of each detection, one line each.

python from_a_log.py feed.mcap results.csv
"""

import csv
import sys
from pathlib import Path

from simtrack.contracts import RgbdFrame
from simtrack.perception.detection.pnp import solve_pose
from simtrack.recordings import RecordedDetector, open_recording


def main(log: str, results: str) -> None:
    recording = open_recording(log)
    detector = RecordedDetector(recording)
    numbers = {name: k for k, name in enumerate(sorted(recording.models), start=1)}
    with Path(results).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["scene_id", "im_id", "obj_id", "score", "R", "t", "time"])
        for frame in recording.sensor_frames():
            if not isinstance(frame, RgbdFrame):
                continue
            for detection in detector.detect(frame).detections:
                model = recording.models[detection.class_name]
                for pose in solve_pose(detection, model, frame.intrinsics, frame.stamp)[:1]:
                    T = pose.T_camera_object
                    R = " ".join(f"{value:.8f}" for value in T[:3, :3].ravel())
                    t = " ".join(f"{1000 * value:.5f}" for value in T[:3, 3])
                    number = numbers[detection.class_name]
                    writer.writerow([1, frame.stamp, number, f"{detection.score:.4f}", R, t, -1])


if __name__ == "__main__":
    main(*sys.argv[1:3])
