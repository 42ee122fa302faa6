"""Networks in ONNX files: opened with onnxruntime or OpenVINO on one thread, and checked before they are used."""

import importlib.util
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from simtrack.errors import FileFormatError, InvalidValueError

KEY = "simtrack"
"""Of the metadata that tells what a network of ours was trained to find, a JSON document."""
MAX_BYTES = 2**29

Runtime: TypeAlias = Literal["auto", "onnxruntime", "openvino"]
"""auto: OpenVINO where it is installed."""
RUNTIMES: tuple[Runtime, ...] = ("auto", "onnxruntime", "openvino")


Runner: TypeAlias = Callable[[Mapping[str, np.ndarray]], list[np.ndarray]]
"""Answers inputs by name with all outputs in the order of the file."""


@dataclass(frozen=True, slots=True)
class OnnxNetwork:
    """A network that can be asked."""

    path: Path
    inputs: Mapping[str, tuple[int | str | None, ...]]
    """Name -> shape; sizes that are free have names."""
    outputs: tuple[str, ...]
    metadata: Mapping[str, str]
    run: Runner
    runtime: str
    """Which one it is: onnxruntime or openvino."""

    def about(self) -> dict[str, Any]:
        """What `simtrack train` wrote of it; FileFormatError for another's network."""
        try:
            about = json.loads(self.metadata[KEY])
        except (KeyError, ValueError) as error:
            reason = "tells nothing of what it was trained to find; expected a file that `simtrack train` wrote"
            raise FileFormatError(self.path, f"metadata.{KEY}", reason) from error
        if not isinstance(about, dict):
            raise FileFormatError(self.path, f"metadata.{KEY}", "expected a JSON object")
        return about

    def expect(self, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        """Check the names of inputs and outputs; raises FileFormatError."""
        for kind, there, wanted in (("inputs", tuple(self.inputs), inputs), ("outputs", self.outputs, outputs)):
            if tuple(there) != tuple(wanted):
                raise FileFormatError(self.path, kind, f"are {', '.join(there)}; expected {', '.join(wanted)}")


def open_network(path: Path, runtime: Runtime = "auto") -> OnnxNetwork:
    """Open a network.

    Raises:
        FileFormatError: there is no file, or it is no ONNX network.
        InvalidValueError: the runtime is unknown or not installed.
    """
    if runtime not in RUNTIMES:
        raise InvalidValueError("runtime", runtime, ", ".join(RUNTIMES))
    openvino = importlib.util.find_spec("openvino") is not None
    if runtime == "openvino" and not openvino:
        raise InvalidValueError("runtime", runtime, "onnxruntime, as OpenVINO is not installed (extra openvino)")
    if not path.is_file():
        raise FileFormatError(path, "", "no such file; expected an ONNX network")
    if path.stat().st_size > MAX_BYTES:
        raise FileFormatError(path, "", f"more than {MAX_BYTES} bytes")
    session = _session(path)
    inputs = {i.name: tuple(i.shape) for i in session.get_inputs()}
    outputs = tuple(o.name for o in session.get_outputs())
    metadata = dict(session.get_modelmeta().custom_metadata_map)
    if runtime != "onnxruntime" and openvino:
        return OnnxNetwork(path, inputs, outputs, metadata, _openvino(path), "openvino")
    return OnnxNetwork(path, inputs, outputs, metadata, lambda given: session.run(None, given), "onnxruntime")


def _session(path: Path) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own exceptions have no common base
        raise FileFormatError(path, "", f"no ONNX network that can be used: {str(error).splitlines()[0]}") from error


def _openvino(path: Path) -> Runner:
    import openvino  # type: ignore[import-not-found]

    settings = {"INFERENCE_NUM_THREADS": 1, "PERFORMANCE_HINT": "LATENCY"}
    compiled = openvino.compile_model(openvino.Core().read_model(str(path)), "CPU", settings)

    def run(given: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        answer = compiled(dict(given))
        return [np.asarray(answer[output]) for output in compiled.outputs]

    return run
