"""The models of a BOP data set: files, and what ``models_info.json`` says of them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from simtrack.datasets.validation.findings import Entry, Report
from simtrack.geometry.meshes import Mesh, diameter, load_mesh

MILLIMETRES = 1000.0
ROUNDING = 0.01
"""Millimetres by which models and what is said of them may differ."""
SHAPE_TOLERANCE = 0.02
"""Of the diameter: how far a symmetry may move a vertex off the vertices' hull box."""


class ContinuousSymmetry(Entry):
    """Any turn about an axis."""

    axis: tuple[float, float, float]
    offset: tuple[float, float, float]


class ModelInfo(Entry):
    """An entry of ``models_info.json``."""

    min_x: float
    min_y: float
    min_z: float
    size_x: float
    size_y: float
    size_z: float
    diameter: Annotated[float, Field(gt=0.0)]
    symmetries_discrete: tuple[Annotated[list[float], Field(min_length=16, max_length=16)], ...] = ()
    symmetries_continuous: tuple[ContinuousSymmetry, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Models:
    """What poses refer to."""

    folder: Path
    info: dict[int, ModelInfo]
    meshes: dict[int, Mesh]
    """Metres, in the models' own frames."""


def read_models(report: Report, folder: Path) -> Models | None:
    """Read and check a folder of models; None if it cannot be used."""
    path = folder / "models_info.json"
    info: dict[int, ModelInfo] | None = report.document(path, dict[Annotated[int, Field(ge=1)], ModelInfo])
    if info is None:
        return None
    files = {int(file.stem.removeprefix("obj_")): file for file in folder.glob("obj_[0-9]*.ply")}
    for number in sorted(files.keys() - info.keys()):
        report.add(files[number], "", "a model", f"an entry {number} in models_info.json")
    loaded: dict[int, Mesh] = {}
    for number in sorted(info):
        mesh = report.read(folder / f"obj_{number:06d}.ply", load_mesh)
        if mesh is not None:
            loaded[number] = Mesh(mesh.vertices / MILLIMETRES, mesh.faces)
            _check(report, path, number, info[number], mesh)
    return Models(folder, info, loaded)


def _check(report: Report, path: Path, number: int, info: ModelInfo, mesh: Mesh) -> None:
    low, size = mesh.bounds[0], mesh.extents
    for k, axis in enumerate("xyz"):
        report.near(path, f"{number}.min_{axis}", getattr(info, f"min_{axis}"), float(low[k]), ROUNDING)
        report.near(path, f"{number}.size_{axis}", getattr(info, f"size_{axis}"), float(size[k]), ROUNDING)
    report.near(path, f"{number}.diameter", info.diameter, diameter(mesh), ROUNDING)
    for k, numbers in enumerate(info.symmetries_discrete):
        S = np.reshape(numbers, (4, 4))
        name = f"{number}.symmetries_discrete.{k}"
        if report.rigid(path, name, S):
            report.holds(not np.allclose(S, np.eye(4)), path, name, "the identity", "another rigid motion")
            _check_symmetry(report, path, name, mesh, S)
    for k, symmetry in enumerate(info.symmetries_continuous):
        length = float(np.linalg.norm(symmetry.axis))
        report.near(path, f"{number}.symmetries_continuous.{k}.axis", length, 1.0, 1e-6)


def _check_symmetry(report: Report, path: Path, name: str, mesh: Mesh, S: np.ndarray) -> None:
    """The moved model has to fill the same box."""
    moved = mesh.vertices @ S[:3, :3].T + S[:3, 3]
    off = max(np.abs(moved.min(0) - mesh.bounds[0]).max(), np.abs(moved.max(0) - mesh.bounds[1]).max())
    limit = SHAPE_TOLERANCE * float(np.linalg.norm(mesh.extents))
    report.holds(off <= limit, path, name, f"a motion that moves the model's box by {off:.2f} mm", "a symmetry")
