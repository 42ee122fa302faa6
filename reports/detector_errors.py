"""How a detector errs, in the terms of the oracle detector: ``python reports/detector_errors.py DATA... > FILE.json``.

Each DATA is a folder of labelled images that the networks were not trained on (`simtrack generate
workbench_keypoints`).
Objects in the middle of the range (visible by more than 0.9, nearer than 1.5 m) tell the keypoints' error and how much
of it is common to a detection; the others how errors and misses grow.
"""

import json
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

from simtrack.contracts import Detection, Float64, RgbdFrame
from simtrack.evaluation.detector import nearest_alike
from simtrack.perception.detection.boxes import overlap
from simtrack.perception.detection.keypoint_detector import KeypointDetector
from simtrack.perception.detection.pnp import project_points
from simtrack.training.source import images, open_source

SAME = 0.5
"""Overlap of boxes from which on a detection is of an object."""
SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0001)
SIZES = (0.0, 14.0, 20.0, 30.0, 45.0, 70.0, 1e4)
"""Limits of the bins: visible share; diameter in the image, pixels."""


def common_share(errors: Float64, arms: Float64) -> float:
    """Share of the variance of keypoint errors (N, 9, 2) that is a shift, scale and turn of each detection.

    Four of the 18 numbers of a detection are explained by chance in 4/18 of the variance of independent errors.
    """
    explained, total = 0.0, 0.0
    for error, arm in zip(errors, arms, strict=True):
        centred = arm - arm.mean(axis=0)
        turned = np.stack([-centred[:, 1], centred[:, 0]], axis=1)
        basis = [np.tile([1.0, 0.0], 9), np.tile([0.0, 1.0], 9), centred.ravel(), turned.ravel()]
        unit = [vector / np.linalg.norm(vector) for vector in basis]
        scale = float(np.mean(error**2))
        explained += sum(float(vector @ error.ravel()) ** 2 for vector in unit) / scale
        total += error.size
    chance = 4.0 / 18.0
    return float(np.clip((explained / total - chance) / (1.0 - chance), 0.0, 1.0))


def measure(folders: list[Path]) -> dict[str, object]:
    """All figures of the detector that comes along."""
    rows, errors, arms, false, wrong, found = [], [], [], 0, 0, 0
    for folder in folders:
        source = open_source(folder)
        detector = KeypointDetector({model.name: model for model in source.models})
        for scene in source.scenes:
            for image in images(source, scene):
                frame = RgbdFrame(0, image.depth, image.rgb, image.intrinsics, np.eye(4))
                free = list(detector.detect(frame).detections)
                found += len(free)
                for label in sorted(image.labels, key=lambda label: -label.visible):
                    model = source.models[label.class_index]
                    z = float(label.T_camera_object[2, 3])
                    size = image.intrinsics.fx * model.diameter / z
                    match = _taken(free, label.box, model.name)
                    error, score = np.nan, np.nan
                    if match is not None:
                        T = nearest_alike(match.keypoints, label.T_camera_object, model, image.intrinsics)
                        pixels = project_points(T, model.keypoints, image.intrinsics)
                        off = (match.keypoints - pixels) / size
                        error, score = float(np.nanmedian(np.linalg.norm(off, axis=1))), match.score
                        if label.visible > 0.9 and z < 1.5 and np.isfinite(off).all():
                            errors.append(off)
                            arms.append(pixels)
                    rows.append((label.visible, size, z, match is not None, error, score))
                for detection in free:
                    beside = any(overlap(detection.box, label.box) >= SAME for label in image.labels)
                    wrong, false = wrong + beside, false + (not beside)
    return _figures(np.array(rows, float), np.array(errors), np.array(arms), false, wrong, found)


def _taken(free: list[Detection], box: Float64, name: str) -> Detection | None:
    """The detection of a class that overlaps a box most, which is taken out of the list."""
    near = [d for d in free if d.class_name == name and overlap(d.box, box) >= SAME]
    best = max(near, key=lambda d: overlap(d.box, box), default=None)
    if best is not None:
        free[:] = [d for d in free if d is not best]
    return best


def _figures(rows: Float64, errors: Float64, arms: Float64, false: int, wrong: int, found: int) -> dict[str, object]:
    visible, size, z, hit, error, score = rows.T
    clear = (visible > 0.9) & (z < 1.5) & (hit > 0)
    distances = np.linalg.norm(errors, axis=2)
    medians = np.median(distances, axis=1)
    # Of a two-dimensional normal the 90th percentile of the distance is 1.82 times the median.
    out: dict[str, object] = {
        "objects": len(rows),
        "detections": found,
        "keypoint_error": round(float(np.median(distances)), 4),
        "keypoint_error.p90_over_median": round(float(np.quantile(distances, 0.9) / np.median(distances)), 2),
        "keypoint_error.spread": round(float(np.std(np.log(medians))), 2),
        "correlation": round(common_share(errors, arms), 2),
        "miss_rate": round(float(np.mean(hit[(visible > 0.9) & (size > 45.0)] == 0)), 4),
        "false_positive_rate": round(false / found, 4),
        "wrong_class_rate": round(wrong / found, 4),
    }
    known = np.isfinite(error)
    for limits, values, name in ((SHARES, visible, "visible"), (SIZES, size, "size")):
        kept = np.ones(len(rows), bool) if name == "visible" else visible > 0.9
        for low, high in pairwise(limits):
            chosen = kept & (values >= low) & (values < high)
            if chosen.sum() >= 20:
                told = {"objects": int(chosen.sum()), "missed": round(float(np.mean(hit[chosen] == 0)), 3)}
                if (chosen & known).any():
                    told["error"] = round(float(np.median(error[chosen & known])), 4)
                    told["score"] = round(float(np.median(score[chosen & known])), 3)
                out[f"{name}.{low:g}-{min(high, 1e4):g}"] = told
    far = (visible > 0.9) & known & (z > 1.5)
    out["error.beyond_1.5m"] = round(float(np.median(error[far])), 4) if far.any() else None
    out["error.within_1.5m"] = round(float(np.median(error[clear])), 4)
    out["score.sd"] = round(float(np.std(score[clear])), 3)
    return out


if __name__ == "__main__":
    json.dump(measure([Path(argument) for argument in sys.argv[1:]]), sys.stdout, indent=1)
    print()
