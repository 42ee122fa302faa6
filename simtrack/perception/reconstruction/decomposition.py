"""Approximate convex decomposition (coacd) of meshes that no CAD model stands for.

coacd is native code that can take minutes and crash: it runs in a child process with a time limit, on a decimated
mesh, and its answer is kept in the disk cache. ``python -m simtrack.perception.reconstruction.decomposition IN OUT``
is the child.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

import simtrack
from simtrack import paths
from simtrack.geometry.meshes import Mesh, convex_hull, decimate
from simtrack.objects.cache import UNUSABLE, digest, mesh_arrays, read_mesh, write_arrays

FACES = 2000
"""Faces that are left before coacd starts: it needs 25 s for 10,000."""
TIME_LIMIT = 240.0
"""Seconds that the child may take."""
MAX_PARTS = 24


def decomposed(mesh: Mesh, label: str = "entity", time_limit: float = TIME_LIMIT) -> tuple[tuple[Mesh, ...], str]:
    """Closed convex parts of any mesh, and why it is only the convex hull (empty if it is not).

    Raises:
        MeshError: the mesh is flat; it spans no volume.
    """
    light = decimate(mesh, FACES)
    path = paths.cache_dir() / "convex" / f"{_file_name(label)}-{digest(*_content(light))}.npz"
    with suppress(*UNUSABLE), path.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
        return _parts(data), ""
    hull = convex_hull(light.vertices)
    failure = ""
    with tempfile.TemporaryDirectory(prefix="simtrack-convex-") as work:
        given, made = Path(work) / "mesh.npz", Path(work) / "parts.npz"
        write_arrays(given, mesh_arrays("mesh", light))
        command = [sys.executable, "-m", __name__, str(given), str(made)]
        try:
            search = os.pathsep.join([str(Path(simtrack.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
            environment = {**os.environ, "PYTHONPATH": search.strip(os.pathsep)}
            run = subprocess.run(command, capture_output=True, timeout=time_limit, check=False, env=environment)
            failure = f"the decomposition ended with code {run.returncode}" if run.returncode else ""
        except subprocess.TimeoutExpired:
            failure = f"the decomposition took over {time_limit:g} s"
        if failure:
            return (hull,), failure
        with np.load(made, allow_pickle=False) as data:
            parts = _parts(data)
            with suppress(OSError):
                write_arrays(path, dict(data))
    return parts, ""


def _content(mesh: Mesh) -> tuple[bytes, bytes]:
    return mesh.vertices.tobytes(), mesh.faces.tobytes()


def _file_name(label: str) -> str:
    return "".join(letter if letter.isascii() and letter.isalnum() else "_" for letter in label)[:40]


def _parts(data: "np.lib.npyio.NpzFile") -> tuple[Mesh, ...]:
    count = sum(1 for key in data.files if key.endswith(".faces"))
    return tuple(read_mesh(data, f"part{k}") for k in range(count))


def main(arguments: Sequence[str]) -> None:
    """The child: read a mesh, write its convex parts."""
    import coacd

    given, made = arguments
    with np.load(given, allow_pickle=False) as data:
        mesh = read_mesh(data, "mesh")
    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces),
        threshold=0.06,
        max_convex_hull=MAX_PARTS,
        preprocess_resolution=40,
        resolution=1000,
        mcts_nodes=12,
        mcts_iterations=60,
        mcts_max_depth=2,
        seed=0,
    )
    hulls = [convex_hull(np.asarray(vertices)) for vertices, _ in parts]
    arrays: dict[str, np.ndarray] = {}
    for k, hull in enumerate(hulls):
        arrays |= mesh_arrays(f"part{k}", hull)
    write_arrays(Path(made), arrays)


if __name__ == "__main__":
    main(sys.argv[1:])
