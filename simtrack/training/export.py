"""Networks as ONNX: 16-bit weights, and in the file's metadata what they were trained to find."""

import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch  # pyright: ignore[reportMissingImports] - extra `train`
from torch import nn  # pyright: ignore[reportMissingImports] - extra `train`

from simtrack.objects import ObjectModel
from simtrack.perception.detection.bins import BEFORE, BINS
from simtrack.perception.detection.views import CHANNELS, WINDOW
from simtrack.perception.segmentation.panoptic_network import CHANNELS as SCENE_CHANNELS
from simtrack.perception.segmentation.panoptic_network import MULTIPLE
from simtrack.training.networks import BoxNetwork, KeypointNetwork
from simtrack.training.segment_network import Answering
from simtrack.training.shards import IMAGE_HEIGHT, IMAGE_WIDTH

KEY = "simtrack"
"""Of the metadata, a JSON document."""
OPSET = 18


def export_boxes(network: nn.Module, models: tuple[ObjectModel, ...], path: Path) -> None:
    """Write a box network: ``image`` (1, 5, H, W) to ``heat`` (1, classes, H / 8, W / 8) and ``sides`` (1, 4, ...)."""
    image = torch.zeros(1, CHANNELS, IMAGE_HEIGHT, IMAGE_WIDTH)
    about = {"kind": "boxes", "stride": BoxNetwork.stride, "width": IMAGE_WIDTH, "height": IMAGE_HEIGHT}
    _export(network, (image,), ["image"], ["heat", "sides"], {}, about | _classes(models), path)


def export_keypoints(network: nn.Module, models: tuple[ObjectModel, ...], sigma_scale: float, path: Path) -> None:
    """Write a keypoint network: ``window`` (N, 5, S, S), ``told`` (N, classes + 2) to ``coordinates``, ``present``.

    Args:
        network: that was trained.
        models: of the classes.
        sigma_scale: standard deviation of its errors over the one that it tells.
        path: of the file.
    """
    size = KeypointNetwork.size
    inputs = torch.zeros(2, CHANNELS, size, size), torch.zeros(2, len(models) + 2)
    names = ["window", "told", "coordinates", "present"]
    about = {"kind": "keypoints", "size": size, "window": WINDOW, "bins": BINS, "before": BEFORE}
    about["sigma_scale"] = round(sigma_scale, 3)
    _export(network, inputs, names[:2], names[2:], {name: {0: "n"} for name in names}, about | _classes(models), path)


def export_segments(network: nn.Module, classes: Sequence[str], path: Path) -> None:
    """Write a panoptic network: ``shown`` (1, 10, H, W) to ``classes``, ``heat`` and ``offsets`` (1, ..., H/4, W/4)."""
    shown = torch.zeros(1, SCENE_CHANNELS, 2 * MULTIPLE, 2 * MULTIPLE)
    about = {"kind": "segments", "channels": SCENE_CHANNELS, "classes": list(classes)}
    names = ["shown", "classes", "heat", "offsets"]
    free = {"shown": {2: "height", 3: "width"}, **{name: {2: "rows", 3: "columns"} for name in names[1:]}}
    _export(Answering(network), (shown,), names[:1], names[1:], free, about, path)


def _classes(models: tuple[ObjectModel, ...]) -> dict[str, Any]:
    return {"classes": [m.name for m in models], "extents": [[round(float(e), 6) for e in m.extents] for m in models]}


def _export(
    network: nn.Module,
    inputs: tuple[torch.Tensor, ...],
    names_in: list[str],
    names_out: list[str],
    free: dict[str, dict[int, str]],
    about: dict[str, Any],
    path: Path,
) -> None:
    import onnx  # pyright: ignore[reportMissingImports] - extra `train`

    part = path.with_suffix(".part.onnx")
    with warnings.catch_warnings():
        # The exporter that is to follow needs another package, and its graphs are larger.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            network.eval().to(memory_format=torch.contiguous_format),  # type: ignore[call-overload]
            inputs, str(part), input_names=names_in, output_names=names_out, dynamic_axes=free, opset_version=OPSET,
            dynamo=False,
        )  # fmt: skip
    model = onnx.load(str(part))
    halve_weights(model)
    entry = model.metadata_props.add()
    entry.key, entry.value = KEY, json.dumps(about, sort_keys=True)
    onnx.checker.check_model(model)
    part.write_bytes(model.SerializeToString())
    part.replace(path)


def halve_weights(model: Any) -> None:
    """Keep a model's large weights as 16-bit numbers that are widened when it is loaded; the arithmetic stays."""
    from onnx import TensorProto, helper, numpy_helper  # pyright: ignore[reportMissingImports] - extra `train`

    graph, casts = model.graph, []
    for weight in graph.initializer:
        values = numpy_helper.to_array(weight)
        if values.dtype == np.float32 and values.size > 64:
            name = weight.name
            weight.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}_16"))
            casts.append(helper.make_node("Cast", [f"{name}_16"], [name], to=TensorProto.FLOAT))
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
