"""Who may import whom, what an import may cost, and what the files of the repository may name."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGE = REPOSITORY / "simtrack"

ROOMS = (
    "contracts",
    "errors",
    "paths",
    "geometry",
    "sensors",
    "raycast",
    "objects",
    "perception",
    "plausibility",
    "simulation",
    "recordings",
    "datasets",
    "training",
    "evaluation",
    "envs",
    "report",
    "testing",
    "benchmarks",
    "cli",
)
"""From top to bottom: a room imports only from itself and from rooms above it."""

HIDDEN_FROM_PERCEPTION = set(ROOMS[ROOMS.index("simulation") :])
HEAVY = {"numba", "scipy", "trimesh", "cv2", "mujoco", "skimage", "shapely", "pyoxigraph", "matplotlib", "embreex"}
HEAVY |= {"pydantic", "manifold3d", "mcap", "rerun", "tyro", "rich", "ray", "torch", "onnx", "onnxruntime"}
IMPORT_NAMES = {
    "opencv-python-headless": "cv2",
    "scikit-image": "skimage",
    "pyyaml": "yaml",
    "rerun-sdk": "rerun",
    "mcap-ros2-support": "mcap_ros2",
    "pyrender-maintained": "pyrender",
    "pyopengl": "OpenGL",
}
"""Packages that are imported by another name."""
MODULES = sorted(PACKAGE.rglob("*.py"))


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(REPOSITORY).with_suffix("").parts).removesuffix(".__init__")


def imported(path: Path) -> Iterator[tuple[int, str]]:
    """(line, absolute dotted name) of everything that a module imports, inside functions and by name too."""
    package = module_name(path).split(".")
    if path.name != "__init__.py":
        package = package[:-1]
    for node in ast.walk(ast.parse(path.read_text(), filename=str(path))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            source = ".".join(part for part in (base, node.module or "") if part)
            yield from ((node.lineno, f"{source}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if called in ("import_module", "__import__") and isinstance(node.args[0].value, str):
                yield node.lineno, node.args[0].value


def room_of(dotted: str) -> str | None:
    """Room of a dotted name inside the package; None for the package itself and for everything outside."""
    parts = dotted.split(".")
    return parts[1] if parts[0] == "simtrack" and len(parts) > 1 and parts[1] != "__version__" else None


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_a_room_imports_only_from_rooms_above_it(path: Path) -> None:
    room = room_of(module_name(path))
    if room in (None, "__main__"):
        room = ROOMS[-1] if room else ROOMS[0]
    assert room in ROOMS, f"{path}: a new room? Give it its place in ROOMS"
    for line, name in imported(path):
        source = room_of(name)
        if source is not None and source != room:
            assert source in ROOMS[: ROOMS.index(room)], f"{path}:{line}: {room} must not import {name}"


@pytest.mark.parametrize("path", sorted((PACKAGE / "perception").rglob("*.py")), ids=module_name)
def test_perception_sees_no_truth(path: Path) -> None:
    for line, name in imported(path):
        assert room_of(name) not in HIDDEN_FROM_PERCEPTION, f"{path}:{line} imports {name}"
    for node in ast.walk(ast.parse(path.read_text())):
        for identifier in (getattr(node, key, None) for key in ("id", "attr", "arg", "name", "asname")):
            if isinstance(identifier, str):
                found = re.search(r"ground_?truth|(^|_)truth(_|$)|^Truth|Truth$", identifier, re.IGNORECASE)
                assert not found, f"{path}:{getattr(node, 'lineno', 0)}: the name {identifier}"


def test_every_package_that_is_imported_is_a_declared_dependency() -> None:
    """A machine that has more installed would hide a missing one."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    lines = [
        *project["dependencies"],
        *extras["viz"],
        *extras["bench"],
        *extras["distributed"],
        *extras["train"],
        *extras["openvino"],
        *extras["rl"],
    ]
    declared = {re.split(r"[\[<>=~!; ]", line)[0] for line in lines}
    modules = {IMPORT_NAMES.get(name, name.replace("-", "_")) for name in declared} | {"simtrack"}
    modules |= {"llvmlite", "markupsafe", "pydantic_core", "pybullet_utils"}  # of numba, jinja2, pydantic, pybullet
    modules |= {"pytest"}  # whose plugin only pytest itself imports
    modules |= {"ultralytics"}  # AGPL-3.0: installed by those who choose it, in no extra
    modules |= set(sys.stdlib_module_names)
    found = [(path, line, name.split(".")[0]) for path in MODULES for line, name in imported(path)]
    assert [f"{path}:{line}: {top}" for path, line, top in found if top not in modules] == []


def test_the_contracts_need_numpy_only() -> None:
    outside = {name.split(".")[0] for _, name in imported(PACKAGE / "contracts.py")} - set(sys.stdlib_module_names)
    assert outside == {"numpy"}


@pytest.mark.parametrize("module", ["simtrack", "simtrack.contracts", "simtrack.errors", "simtrack.paths"])
def test_importing_is_light(module: str) -> None:
    code = f"import sys, {module}; print(*{{name.split('.')[0] for name in sys.modules}})"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=REPOSITORY)
    assert HEAVY.isdisjoint(run.stdout.split())


def repository_files() -> list[Path]:
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True)
    if listing.returncode == 0:
        names = [REPOSITORY / name for name in listing.stdout.decode().split("\0") if name]
    else:  # not a clone: an unpacked source archive
        names = [
            path for folder in ("simtrack", "tests", "scenes", "docs") for path in (REPOSITORY / folder).rglob("*")
        ]
    return [path for path in names if path.is_file() and path != Path(__file__).resolve()]


def test_files_name_no_machine() -> None:
    """Neither absolute paths of one machine nor hosts of package indexes: a checkout works anywhere."""
    forbidden = re.compile(
        rb"(?<![\w.$}/])/(?:work|opt|root|home|tmp|mnt)/\w|pypi\.org|pythonhosted|npmjs|deb\.debian\.org|\bfile:///"
    )
    for path in repository_files():
        content = path.read_bytes()
        if b"\0" not in content:
            found = forbidden.search(content)
            where = f"{path}:{content[: found.start()].count(10) + 1}" if found else ""
            assert not found, f"{where}: {found[0].decode() if found else ''}"


def test_every_package_says_what_it_is_for() -> None:
    for path in MODULES:
        if path.name == "__init__.py":
            assert ast.get_docstring(ast.parse(path.read_text())), f"{path} has no docstring"


def compiled_functions() -> dict[str, tuple[ast.FunctionDef, dict[str, ast.expr]]]:
    """Name -> definition of every compiled function, and the arguments of its decorator."""
    found = {}
    for path in MODULES:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if not isinstance(node, ast.FunctionDef):
                continue
            for decorator in node.decorator_list:
                if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) in ("njit", "nb.njit"):
                    found[node.name] = node, {str(k.arg): k.value for k in decorator.keywords}
    return found


def test_kernels_that_may_round_in_several_ways_are_inlined_in_others() -> None:
    """Otherwise results depend on which kernels a process has compiled before (see `normal_equations`)."""
    functions = compiled_functions()
    calls = {
        name: {ast.unparse(call.func) for call in ast.walk(node) if isinstance(call, ast.Call)} & functions.keys()
        for name, (node, _) in functions.items()
    }
    loose = {name for name, (_, arguments) in functions.items() if "fastmath" in arguments}
    assert loose
    while more := {name for name, called in calls.items() if called & loose} - loose:
        loose |= more
    called = set.union(*calls.values())
    assert sorted(name for name in loose & called if "forceinline" not in functions[name][1]) == []
