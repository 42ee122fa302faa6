"""CAD models on disk: a file of arrays for each class and version."""

import json
import logging
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from simtrack import paths
from simtrack.objects.cache import UNUSABLE, mesh_arrays, open_arrays, read_mesh, write_arrays
from simtrack.objects.cad.model import CadBox, CadJoint, CadModel, CadPart, CadPlane, CadSupport

_log = logging.getLogger("simtrack.cache")


def cached_models(label: str, key: str, build: Callable[[], tuple[CadModel, ...]]) -> tuple[CadModel, ...]:
    """The models kept under `label` and `key`, else built and kept; a cache that cannot be used is no error."""
    path = paths.cache_dir() / "cad" / f"{label}-{key}.npz"
    with suppress(*UNUSABLE), open_arrays(path) as data:
        return unpacked(data)
    _log.info("building CAD models: %s", label)
    models = build()
    with suppress(OSError):
        write_arrays(path, packed(models))
    return models


def packed(models: tuple[CadModel, ...]) -> dict[str, np.ndarray]:
    """All models as named arrays without pickled objects."""
    arrays: dict[str, np.ndarray] = {}
    texts = []
    for k, model in enumerate(models):
        tag = f"{k}."
        texts.append(
            {
                "name": model.name,
                "semantic_class": model.semantic_class,
                "description": model.description,
                "affordances": sorted(model.affordances),
                "parts": [(p.name, p.mass, p.friction, p.material, len(p.convex)) for p in model.parts],
                "joints": [
                    (j.name, j.kind, j.parent, j.child, j.lower, j.upper, j.friction, j.damping) for j in model.joints
                ],
                "planes": [plane.part for plane in model.planes],
                "supports": [support.part for support in model.supports],
                "hollows": [hollow.part for hollow in model.hollows],
                "handles": [handle.part for handle in model.handles],
            }
        )
        arrays |= {f"{tag}extents": model.extents, f"{tag}yaws": model.yaw_symmetries}
        for i, part in enumerate(model.parts):
            arrays |= {f"{tag}{i}.centre": part.centre_of_mass, f"{tag}{i}.inertia": part.inertia}
            arrays |= mesh_arrays(f"{tag}{i}.mesh", part.mesh)
            for c, convex in enumerate(part.convex):
                arrays |= mesh_arrays(f"{tag}{i}.convex{c}", convex)
        arrays[f"{tag}joints"] = _rows([[*j.anchor, *j.axis] for j in model.joints], 6)
        arrays[f"{tag}planes"] = _rows([[*p.normal, p.offset, p.area, *p.centre] for p in model.planes], 8)
        arrays[f"{tag}supports"] = _rows([[*s.centre, *s.size, s.clearance] for s in model.supports], 6)
        for label, boxes in (("hollows", model.hollows), ("handles", model.handles)):
            arrays[tag + label] = _rows([[*box.centre, *box.extents] for box in boxes], 6)
    arrays["text"] = np.frombuffer(json.dumps(texts).encode(), np.uint8)
    return arrays


def unpacked(data: Mapping[str, np.ndarray]) -> tuple[CadModel, ...]:
    """The inverse of `packed`."""
    return tuple(_model(data, f"{k}.", text) for k, text in enumerate(json.loads(data["text"].tobytes())))


def _model(data: Mapping[str, np.ndarray], tag: str, text: dict[str, Any]) -> CadModel:
    parts = tuple(
        CadPart(
            name=name,
            mesh=read_mesh(data, f"{tag}{i}.mesh"),
            convex=tuple(read_mesh(data, f"{tag}{i}.convex{c}") for c in range(count)),
            mass=mass,
            centre_of_mass=data[f"{tag}{i}.centre"],
            inertia=data[f"{tag}{i}.inertia"],
            friction=friction,
            material=material,
        )
        for i, (name, mass, friction, material, count) in enumerate(text["parts"])
    )
    joints = tuple(
        CadJoint(name, kind, on, child, row[:3], row[3:], lower, upper, friction, damping)
        for (name, kind, on, child, lower, upper, friction, damping), row in zip(
            text["joints"], data[f"{tag}joints"], strict=True
        )
    )

    def rows(label: str) -> list[tuple[str, np.ndarray]]:
        return list(zip(text[label], data[tag + label], strict=True))

    return CadModel(
        name=text["name"],
        semantic_class=text["semantic_class"],
        parts=parts,
        joints=joints,
        extents=data[f"{tag}extents"],
        planes=tuple(CadPlane(p, r[:3], float(r[3]), float(r[4]), r[5:]) for p, r in rows("planes")),
        supports=tuple(CadSupport(p, r[:3], r[3:5], float(r[5])) for p, r in rows("supports")),
        hollows=tuple(CadBox(p, r[:3], r[3:]) for p, r in rows("hollows")),
        handles=tuple(CadBox(p, r[:3], r[3:]) for p, r in rows("handles")),
        affordances=frozenset(text["affordances"]),
        yaw_symmetries=data[f"{tag}yaws"],
        description=text["description"],
    )


def _rows(values: list[list[float]], width: int) -> np.ndarray:
    return np.array(values, float).reshape(-1, width)
