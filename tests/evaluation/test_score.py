"""Results of others: a run's own file gives what the run measured, and what is wrong with a file is told."""

import csv
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from simtrack.contracts import Belief, Float64, Localization, Status, Track, TrackStatus
from simtrack.errors import FileFormatError
from simtrack.evaluation.evaluator import pose_scorers
from simtrack.evaluation.metrics import Metrics
from simtrack.evaluation.result_files import read_bop, read_tum
from simtrack.evaluation.run_folder import TruthTables
from simtrack.evaluation.score import UNTOLD, Score, score
from simtrack.evaluation.tracking import TrackingEvaluator
from simtrack.evaluation.trajectory import SETTLED, TrajectoryEvaluator
from simtrack.geometry.transforms import inverse, perturb, quaternion_from_rotation
from simtrack.objects import load_object
from simtrack.simulation.ground_truth import ObjectTruth, Truth
from tests.cli.commands import simtrack_command

CLASSES = ("relay", "screwdriver")
IMAGES = 6
PERIOD = 33_333_333


@dataclass
class Run:
    folder: Path
    metrics: Metrics = field(default_factory=dict)
    estimated: list[tuple[int, Float64]] = field(default_factory=list)

    @property
    def bop(self) -> Path:
        return self.folder / "simtrack_bench-test.csv"

    def rows(self) -> list[dict[str, str]]:
        with self.bop.open() as file:
            return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Two objects, of which one moves and one is missed now and then, in six images of a camera that moves."""
    folder = tmp_path_factory.mktemp("score") / "run"
    folder.mkdir()
    rng = np.random.default_rng(3)
    made = Run(folder)
    objects = [{"model": name} for name in (*CLASSES, "mug")]
    (folder / "config.yaml").write_text(yaml.safe_dump({"scene_file": {"objects": objects}}))
    tracking = TrackingEvaluator(pose_scorers({name: load_object(name) for name in CLASSES}))
    trajectory = TrajectoryEvaluator(SETTLED)
    poses = {name: perturb(np.eye(4), rng.normal(0, [0.2, 0.2, 0.2, 1, 1, 1])) for name in CLASSES}
    with TruthTables(folder, "bench", [*CLASSES, "mug"]) as tables:
        for image in range(IMAGES):
            stamp = SETTLED + (image + 1) * PERIOD
            T_base = perturb(np.eye(4), np.array([0.1 * image, 0.02 * image**2, 0, 0, 0, 0.05 * image]))
            T_camera = T_base @ perturb(np.eye(4), np.array([0, 0, -1.5, 0.01 * image, 0, 0]))
            velocity = {"relay": np.zeros(6), "screwdriver": np.array([0.2, 0, 0, 0, 0, 0])}
            things = {n: ObjectTruth(n, n, "catalogue", T, velocity[n]) for n, T in poses.items()}
            truth = Truth(stamp, T_base, T_camera, T_base, things, frozenset(), frozenset())
            tracks = [
                _track(k, name, stamp, perturb(T, rng.normal(0, 0.003, 6)), T_camera)
                for k, (name, T) in enumerate(poses.items(), start=1)
                if (image, name) != (2, "relay")
            ]
            found = tracking.observe(tracks, truth, {"relay": 0.9, "screwdriver": 0.8 if image else 0.1})
            T_believed = perturb(T_base, rng.normal(0, 0.004, 6))
            localization = Localization(stamp, T_believed, np.eye(6), Status.OK)
            trajectory.observe(stamp, localization, T_base)
            made.estimated.append((stamp, T_believed))
            belief = Belief(stamp, localization, T_camera, tuple(tracks), None, None, frozenset())
            tables.add(image, belief, T_base, found)
    made.metrics = tracking.metrics() | trajectory.metrics()
    return made


def _track(number: int, name: str, stamp: int, T_map_object: Float64, T_map_camera: Float64) -> Track:
    return Track(
        number, name, TrackStatus.CONFIRMED, stamp, T_map_object, np.eye(6), inverse(T_map_camera) @ T_map_object,
        np.zeros(6), stamp, 1.0, False, 0.0, 0.9,
    )  # fmt: skip


def tum(path: Path, poses: list[tuple[int, Float64]], unit: float = 1.0, order: tuple[int, ...] = (1, 2, 3, 0)) -> Path:
    lines = ["# stamp x y z qx qy qz qw"]
    for stamp, T in poses:
        values = [stamp / 1e9, *(unit * T[:3, 3]), *quaternion_from_rotation(T[:3, :3])[list(order)]]
        lines.append(" ".join(f"{value:.9f}" for value in values))
    path.write_text("\n".join(lines) + "\n")
    return path


def write(path: Path, rows: list[dict[str, str]]) -> Path:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    return path


def assert_same(found: Score, run: Run, prefix: str) -> None:
    names = [name for name in found.metrics if name.startswith(prefix)]
    assert len(names) > 5
    for name in names:
        if name in UNTOLD or name == "localization.trusted_share":
            assert found.metrics[name].value is None
            assert found.metrics[name].reason
        else:
            ours, theirs = found.metrics[name].value, run.metrics[name].value
            assert (ours is None) == (theirs is None), name
            assert ours is None or ours == pytest.approx(theirs, rel=1e-3, abs=2e-6), name


def test_own_results_give_what_the_run_measured(run: Run) -> None:
    found = score(run.folder, run.bop)
    assert_same(found, run, "tracking.")
    assert found.metrics["score.rows"].value == 2 * IMAGES - 1
    assert found.metrics["score.rows_left_out"].value == 0
    (unit,) = found.findings
    assert "taken for millimetres" in unit


def test_metres_and_stamps_for_image_numbers_give_the_same(run: Run, tmp_path: Path) -> None:
    rows = run.rows()
    for row in rows:
        row["im_id"] = str(SETTLED + (int(row["im_id"]) + 1) * PERIOD)
        row["t"] = " ".join(str(float(value) / 1000) for value in row["t"].split())
    found = score(run.folder, write(tmp_path / "r.csv", rows))
    assert_same(found, run, "tracking.")
    assert "taken for metres" in found.findings[-1]


def test_rows_that_cannot_be_used_are_told(run: Run, tmp_path: Path) -> None:
    rows = run.rows()
    first = rows[0]
    mirrored = " ".join(str(v) for v in (-np.array([float(x) for x in first["R"].split()])))
    bad = [
        {**first, "im_id": "77"}, {**first, "obj_id": "9"}, dict(first), {**first, "R": "1 0 0"},
        {**first, "R": mirrored}, {**first, "t": "nan 0 0"}, {**first, "im_id": "one"}, {**first, "t": "a b c"},
    ]  # fmt: skip
    found = score(run.folder, write(tmp_path / "r.csv", rows + bad))
    assert_same(found, run, "tracking.")
    told = "\n".join(found.findings)
    for text in (
        "1 rows of unknown images (77) left out; im_id: 0 to 5",
        "1 rows of unknown objects (9) left out; obj_id: 1 mug, 2 relay, 3 screwdriver",
        "1 duplicate rows left out",
        "R does not have 9 numbers (line 16)",
        "R is no rotation (line 17)",
        "t is not finite (line 18)",
        "im_id or obj_id is no integer (line 19)",
        "t holds something else than numbers (line 20)",
    ):
        assert text in told, text


def scaled(run: Run, path: Path) -> Path:
    rows = run.rows()
    for row in rows:
        row["t"] = " ".join(str(1e6 * float(value)) for value in row["t"].split())
    return write(path, rows)


UNUSABLE: dict[str, tuple[Callable[[Run, Path], Path], str]] = {
    "unit": (scaled, "neither millimetres nor metres"),
    "strangers": (lambda run, path: write(path, [{**run.rows()[0], "obj_id": "44"}]), "no row can be scored"),
    "columns": (lambda run, path: write(path, [{"obj_id": "1", "im_id": "0"}]), "no column scene_id, score, R, t"),
    "table": (lambda run, path: write(path, [{"a": "1", "b": "2"}]), "expected the header scene_id,im_id"),
    "missing": (lambda run, path: path, "cannot be read"),
    "other times": (lambda run, path: tum(path, [(10**12, np.eye(4))]), "the run's are at 0.533 to 0.700 s"),
    "no lines": (lambda run, path: tum(path, []), "no pose can be scored"),
}


@pytest.mark.parametrize("name", UNUSABLE)
def test_a_file_of_which_nothing_can_be_used_is_refused(name: str, run: Run, tmp_path: Path) -> None:
    make, message = UNUSABLE[name]
    with pytest.raises(FileFormatError) as error:
        score(run.folder, make(run, tmp_path / "results.csv"))
    assert message in str(error.value)


def test_a_folder_that_is_no_run_is_refused(run: Run, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"trajectory\.csv"):
        score(tmp_path, run.bop)


def test_own_trajectory_gives_what_the_run_measured(run: Run, tmp_path: Path) -> None:
    found = score(run.folder, tum(tmp_path / "t.txt", run.estimated))
    names = [name for name in found.metrics if name.startswith("localization.")]
    assert {"localization.ate_rmse", "localization.coverage"} <= set(names)
    assert found.metrics["localization.coverage"].value == 1.0
    for name in set(names) - {"localization.coverage", "localization.trusted_share"}:
        ours, theirs = found.metrics[name].value, run.metrics[name].value
        assert ours == theirs or ours == pytest.approx(theirs, rel=1e-3, abs=2e-6), name
    assert found.findings == ()


def test_trajectories_with_strange_poses_are_told(run: Run, tmp_path: Path) -> None:
    poses = [*run.estimated[1:], run.estimated[2], (10**12, np.eye(4))]
    path = tum(tmp_path / "t.txt", poses)
    path.write_text(path.read_text() + "1 2 3\n0.1 0 0 0 0 0 0 3\n")
    found = score(run.folder, path)
    assert found.metrics["localization.coverage"].value == pytest.approx(5 / 6)
    told = "\n".join(found.findings)
    assert "1 poses without an image" in told
    assert "1 further poses" in told
    assert "does not have 8 numbers" in told
    assert "not of length 1" in told


def test_swapped_quaternions_and_millimetres_are_told(run: Run, tmp_path: Path) -> None:
    found = score(run.folder, tum(tmp_path / "t.txt", run.estimated, order=(0, 1, 2, 3)))
    assert "look like qw qx qy qz" in found.findings[0]
    thousand = score(run.folder, tum(tmp_path / "mm.txt", run.estimated, unit=1000.0))
    assert "taken for millimetres" in thousand.findings[0]
    assert thousand.metrics["localization.ate_rmse"].value == pytest.approx(run.metrics["localization.ate_rmse"].value)
    moved = [(stamp, perturb(T, np.array([200.0, 0, 0, 0, 0, 0]))) for stamp, T in run.estimated]
    far = score(run.folder, tum(tmp_path / "m.txt", moved))
    assert far.metrics["localization.ate_rmse"].value == pytest.approx(200.0, rel=0.01), "a shift is no unit"


@given(st.text(alphabet='0123456789 .,-enaif#\n"R_t', max_size=200))
def test_any_text_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_text(text)
    read_tum(path)
    path.write_text("scene_id,im_id,obj_id,score,R,t,time\n" + text)
    read_bop(path)


def test_the_command_prints_and_writes(run: Run, tmp_path: Path) -> None:
    done = simtrack_command("score", run.folder, run.bop, "--out", tmp_path / "m.json")
    assert done.returncode == 0, done.stderr
    assert "tracking.recall" in done.stdout
    assert "taken for millimetres" in done.stdout
    assert (tmp_path / "m.json").is_file()
    assert simtrack_command("score", run.folder, tmp_path / "none.csv").returncode == 2
