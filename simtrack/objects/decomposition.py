"""Approximate convex decomposition of meshes by CoACD, in a process of its own with a time limit.

CoACD is native code that aborts on some meshes and takes very long on others; neither takes along what the user runs.
``python -m simtrack.objects.decomposition GIVEN MADE`` is the child.
"""

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

import simtrack
from simtrack.errors import MeshError
from simtrack.geometry.meshes import Mesh, convex_hull, decimate

_NOT_INSTALLED = 3
"""Exit code of the child."""


@dataclass(frozen=True, slots=True)
class DecompositionConfig:
    """How closely parts follow a mesh; the names are CoACD's.

    Coarse on purpose: a 300 mm crate takes 4 s and keeps its hollow; CoACD's own settings take minutes.
    """

    threshold: float = 0.1
    """Concavity that a part may have, of a mesh of unit size."""
    max_convex_hull: int = 32
    """Parts at most."""
    preprocess_resolution: int = 30
    resolution: int = 500
    mcts_nodes: int = 10
    mcts_iterations: int = 50
    mcts_max_depth: int = 2
    seed: int = 0


def convex_parts(
    mesh: Mesh,
    source: str | Path,
    config: DecompositionConfig | None = None,
    *,
    max_faces: int = 3000,
    time_limit: float = 180.0,
) -> list[Mesh]:
    """Closed convex meshes whose union is about that of a mesh.

    Args:
        mesh: any, hollow or not; colours are dropped.
        source: what an error message calls it, e.g. its file.
        config: how closely.
        max_faces: the mesh is simplified to so many before.
        time_limit: seconds that CoACD may take.

    Raises:
        MeshError: CoACD is not installed, crashes on the mesh, finds nothing, or takes longer.
    """
    light = decimate(mesh, max_faces)
    with tempfile.TemporaryDirectory(prefix="simtrack-") as folder:
        given, made = Path(folder) / "mesh.npz", Path(folder) / "parts.npz"
        np.savez(given, vertices=light.vertices, faces=light.faces, **asdict(config or DecompositionConfig()))
        _run([sys.executable, "-m", __name__, str(given), str(made)], source, time_limit)
        with np.load(made, allow_pickle=False) as data:
            parts = [data[name] for name in data.files]
    if not parts:
        raise MeshError(source, "CoACD finds no convex parts of it")
    return [convex_hull(vertices) for vertices in parts]


def _run(command: Sequence[str], source: str | Path, time_limit: float) -> None:
    """Run the child; raises MeshError with its last words if it does not succeed."""
    search = [str(Path(simtrack.__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(search)}
    try:
        child = subprocess.run(command, capture_output=True, timeout=time_limit, check=False, env=environment)
    except subprocess.TimeoutExpired:
        raise MeshError(source, f"CoACD takes longer than {time_limit:g} s") from None
    if child.returncode == _NOT_INSTALLED:
        raise MeshError(source, "CoACD is not installed (pip install coacd)")
    if child.returncode < 0:
        raise MeshError(source, f"CoACD crashes on it ({signal.Signals(-child.returncode).name})")
    if child.returncode:
        last = (child.stderr.decode(errors="replace").strip().splitlines() or ["no message"])[-1]
        raise MeshError(source, f"CoACD fails on it ({last:.200})")


def _main(given: Path, made: Path) -> None:
    try:
        import coacd
    except ImportError:
        sys.exit(_NOT_INSTALLED)
    with np.load(given, allow_pickle=False) as data:
        arrays = dict(data)
    coacd.set_log_level("error")
    mesh = coacd.Mesh(arrays.pop("vertices"), arrays.pop("faces"))
    parts = coacd.run_coacd(mesh, **{name: value.item() for name, value in arrays.items()})
    np.savez(made, *(np.asarray(vertices, float) for vertices, _ in parts))


if __name__ == "__main__":
    _main(*map(Path, sys.argv[1:]))
