"""The learned segmenter: a small network that `simtrack train segmenter` made, run by onnxruntime on one thread."""

from pathlib import Path

import numpy as np

from simtrack.contracts import RgbdFrame
from simtrack.errors import FileFormatError
from simtrack.perception.detection.onnx_network import Runtime, open_network
from simtrack.perception.segmentation.frames import reduced_frame
from simtrack.perception.segmentation.panoptic import PanopticSegments
from simtrack.perception.segmentation.panoptic_network import (
    CHANNELS,
    COLUMNS,
    DecodingConfig,
    decoded_segments,
    shown_scene,
)

FILE = "segments.onnx"
SHIPPED = Path(__file__).resolve().parent / "weights" / FILE
"""Trained by `simtrack train segmenter`; see docs/mapping.md. Licence: that of simtrack."""


def network_file(path: Path | None) -> Path:
    """The file of a network: in a folder, itself, or the one that comes along if None."""
    if path is None:
        return SHIPPED
    return path / FILE if path.is_dir() else path


class LearnedSegmenter:
    """Finds floor, walls and things in RGB-D images; implements `simtrack.perception.segmentation.panoptic.Segmenter`.

    The classes are those of the training's rooms.
    """

    def __init__(
        self, path: Path | None = None, config: DecodingConfig | None = None, runtime: Runtime = "auto"
    ) -> None:
        """Open a network: the file, the folder that `simtrack train segmenter` wrote, or the one that comes along.

        Raises:
            FileFormatError: there is none, or it is another's.
        """
        file = network_file(path)
        self._network = open_network(file, runtime)
        about = self._network.about()
        self._network.expect(("shown",), ("classes", "heat", "offsets"))
        names = about.get("classes")
        if about.get("kind") != "segments" or not isinstance(names, list) or about.get("channels") != CHANNELS:
            raise FileFormatError(file, "metadata.simtrack", "expected a network that `simtrack train segmenter` wrote")
        self.classes = tuple(str(name) for name in names)
        self.config = config or DecodingConfig()

    def segment(self, frame: RgbdFrame) -> PanopticSegments:
        """Segments of one image, found in one of about `COLUMNS` columns."""
        small = reduced_frame(frame, max(1, round(frame.intrinsics.width / COLUMNS)))
        shown = shown_scene(small.rgb, small.depth, small.intrinsics)
        logits, heat, offsets = self._network.run({"shown": shown[None]})
        found = decoded_segments(
            frame.stamp, (logits[0], heat[0], offsets[0]), self.classes, small.depth.shape, self.config
        )
        shape = frame.depth.shape
        rows = np.minimum(np.arange(shape[0]) * small.depth.shape[0] // shape[0], small.depth.shape[0] - 1)
        columns = np.minimum(np.arange(shape[1]) * small.depth.shape[1] // shape[1], small.depth.shape[1] - 1)
        return PanopticSegments(frame.stamp, found.image[rows[:, None], columns], found.classes, found.scores)
