"""A panoptic map as one file, ``map.npz``: it can be loaded, looked at and carried on."""

import json
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simtrack.errors import FileFormatError, InvalidValueError
from simtrack.objects.cache import UNUSABLE, open_arrays, write_arrays
from simtrack.perception.mapping.panoptic.panoptic_map import PanopticMap, PanopticMapConfig
from simtrack.perception.mapping.panoptic.regions import SwapConfig
from simtrack.perception.mapping.panoptic.volume import STORED
from simtrack.perception.mapping.panoptic.volume_kernels import VOXELS

FILE = "map.npz"
VERSION = 1
MOST_BYTES = 64 * 2**30
_SHAPES = {"keys": (), "distances": (VOXELS,), "weights": (VOXELS,), "colors": (VOXELS, 3), "labels": (VOXELS,),
           "support": (VOXELS,)}  # fmt: skip
_KINDS = {"keys": np.int64, "distances": np.float32, "weights": np.float32, "colors": np.uint8, "labels": np.int32,
          "support": np.int16}  # fmt: skip


def write_map(panoptic_map: PanopticMap, path: Path) -> None:
    """Write a map, all of it, whole or not at all."""
    panoptic_map.complete()
    document = {
        "version": VERSION,
        "config": _plain(panoptic_map.config),
        "counts": panoptic_map.counts.state(),
        "together": panoptic_map.labels.state(),
        "frames": panoptic_map.frames,
        "agreement": panoptic_map.agreement,
        "skipped": panoptic_map.skipped,
    }
    arrays = {**panoptic_map.volume.blocks(), "canonical": panoptic_map.labels.canonical}
    write_arrays(path, {**arrays, "document": np.array(json.dumps(document))})


def read_map(path: Path) -> PanopticMap:
    """Read a map, to be looked at or carried on.

    Raises:
        FileFormatError: it is no map, or a damaged one.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise FileFormatError(path, "", f"is larger than {MOST_BYTES} bytes")
        with open_arrays(path) as data:
            document = json.loads(str(data["document"]))
            if document["version"] != VERSION:
                raise FileFormatError(path, "version", f"is {document['version']!r}; allowed: {VERSION}")
            panoptic_map = PanopticMap(_config(PanopticMapConfig, document["config"]))
            blocks = {name: data[name] for name in STORED}
            canonical = data["canonical"]
        _check(path, blocks, canonical)
        panoptic_map.volume.add(blocks)
        panoptic_map.labels.canonical = canonical
        panoptic_map.labels.restore(document["together"])
        panoptic_map.counts.restore(document["counts"])
        panoptic_map.frames = int(document["frames"])
        own, whole = document.get("agreement", (0, 0))
        panoptic_map.agreement = int(own), int(whole)
        panoptic_map.skipped = {str(reason): int(n) for reason, n in document["skipped"].items()}
    except FileFormatError:
        raise
    except (*UNUSABLE, KeyError, TypeError, AttributeError, InvalidValueError) as error:
        raise FileFormatError(path, "", f"is no map that can be read: {type(error).__name__}: {error}") from error
    return panoptic_map


def _check(path: Path, blocks: dict[str, np.ndarray], canonical: np.ndarray) -> None:
    count = len(blocks["keys"])
    for name, shape in _SHAPES.items():
        values = blocks[name]
        if values.shape != (count, *shape) or values.dtype != _KINDS[name]:
            reason = f"{values.dtype} {values.shape}; expected {np.dtype(_KINDS[name])} {(count, *shape)}"
            raise FileFormatError(path, name, reason)
    if canonical.ndim != 1 or canonical.dtype != np.int32 or not len(canonical):
        raise FileFormatError(path, "canonical", "expected int32 numbers of labels")
    for name, values in (("labels", blocks["labels"]), ("canonical", canonical)):
        if values.size and not 0 <= int(values.min()) <= int(values.max()) < len(canonical):
            raise FileFormatError(path, name, f"names labels beyond the {len(canonical)} that there are")
    if not (np.isfinite(blocks["distances"]).all() and np.isfinite(blocks["weights"]).all()):
        raise FileFormatError(path, "distances, weights", "are not finite")
    if len(np.unique(blocks["keys"])) != count or (count and int(blocks["keys"].min()) < 0):
        raise FileFormatError(path, "keys", "name a block twice, or none")


def _plain(config: Any) -> Any:
    """A configuration as plain data."""
    return json.loads(json.dumps(asdict(config), default=sorted))


def _config(kind: type, values: Any) -> Any:
    """A configuration from plain data; fields that are not told keep their defaults."""
    default = kind()
    told = {}
    for field in fields(kind):
        if field.name not in values:
            continue
        value, own = values[field.name], getattr(default, field.name)
        if is_dataclass(own):
            value = None if value is None and field.name == "shell" else _config(type(own), value)
        elif isinstance(own, frozenset):
            value = frozenset(map(str, value))
        elif isinstance(own, tuple):
            value = tuple(map(float, value))
        elif field.name == "swap":
            value = None if value is None else SwapConfig(**value)
        told[field.name] = value
    return kind(**told)
