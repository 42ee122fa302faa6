"""An off-the-shelf COCO panoptic network in the place of the segmenter, behind the service.

    pip install transformers torch scipy
    simtrack serve segmenter --segmenter coco_panoptic:CocoPanoptic
    simtrack map rooms:104 --segmenter http://127.0.0.1:8765

Any model of the Hugging Face hub with panoptic post-processing will do. It sees colour alone and knows COCO's 133
classes; `NAMES` says what they are called in simtrack's rooms. Others keep their names.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from simtrack.contracts import RgbdFrame
from simtrack.perception.segmentation.panoptic import PanopticSegments

MODEL = os.environ.get("COCO_PANOPTIC_MODEL", "facebook/mask2former-swin-tiny-coco-panoptic")
NAMES = {
    "couch": "sofa", "tv": "monitor", "laptop": "monitor", "dining table": "table", "table-merged": "table",
    "refrigerator": "fridge", "potted plant": "plant", "backpack": "bag", "handbag": "bag", "suitcase": "bag",
    "wine glass": "cup", "vase": "bottle", "cabinet-merged": "cabinet", "door-stuff": "wall", "shelf": "shelf",
    "rug-merged": "floor", "floor-wood": "floor", "floor-other-merged": "floor", "carpet": "floor",
    "ceiling-merged": "ceiling", "wall-brick": "wall", "wall-stone": "wall", "wall-tile": "wall", "wall-wood": "wall",
    "wall-other-merged": "wall", "window-blind": "wall", "window-other": "wall", "cardboard": "box",
}  # fmt: skip
"""COCO's name -> simtrack's."""
STUFF = ("floor", "wall", "ceiling")


class CocoPanoptic:
    """Implements `simtrack.perception.segmentation.panoptic.Segmenter`."""

    def __init__(self) -> None:
        from transformers import AutoImageProcessor, AutoModelForUniversalSegmentation

        self._processor = AutoImageProcessor.from_pretrained(MODEL)
        self._model = AutoModelForUniversalSegmentation.from_pretrained(MODEL).eval()

    def segment(self, frame: RgbdFrame) -> PanopticSegments | None:
        import torch

        if frame.rgb is None:
            return None
        with torch.inference_mode():
            answer = self._model(**self._processor(images=frame.rgb, return_tensors="pt"))
        size = [frame.rgb.shape[:2]]
        found = self._processor.post_process_panoptic_segmentation(answer, target_sizes=size)[0]
        labels: Mapping[int, str] = self._model.config.id2label
        return segments_of(frame.stamp, found["segmentation"].cpu().numpy(), found["segments_info"], labels)


def segments_of(
    stamp: int, image: np.ndarray, infos: Sequence[Mapping[str, Any]], labels: Mapping[int, str]
) -> PanopticSegments:
    """What the hub's post-processing answers, with simtrack's names and one segment for each class of stuff.

    image: (H, W) ids of segments; infos: id, label_id and score of each; labels: label_id -> COCO's name.
    """
    numbers = np.zeros(image.shape, np.int32)
    classes: list[str] = []
    scores: list[float] = []
    for info in infos:
        coco = labels[int(info["label_id"])]
        name = NAMES.get(coco, coco)
        if name in STUFF and name in classes:
            number = classes.index(name)
            scores[number] = max(scores[number], float(info["score"]))
        else:
            number = len(classes)
            classes.append(name)
            scores.append(float(info["score"]))
        numbers[image == info["id"]] = number + 1
    return PanopticSegments(stamp, numbers, tuple(classes), np.array(scores, np.float32))
