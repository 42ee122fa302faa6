"""Finds out what a folder holds and has each format checked."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np

from simtrack.datasets.folder import DESCRIPTION, MARKERS, RECIPE, SceneMarker, read_markers
from simtrack.datasets.validation.bop import Expectations, is_bop, validate_bop
from simtrack.datasets.validation.coco import is_coco, validate_coco
from simtrack.datasets.validation.findings import Entry, Finding, Report
from simtrack.datasets.validation.logs import validate_mcap
from simtrack.datasets.validation.plain import is_labels, validate_dope, validate_labels
from simtrack.datasets.validation.rerender import Rerenderer
from simtrack.datasets.validation.sequences import is_kitti, tum_folders, validate_kitti, validate_tum
from simtrack.datasets.validation.yolo import validate_yolo, yolo_folders
from simtrack.errors import DatasetError
from simtrack.sensors.depth_noise import DepthNoiseConfig

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Validation:
    """What was looked at, and what was wrong."""

    findings: tuple[Finding, ...]
    counts: Mapping[str, int]
    """Format -> images, scans or logs that were checked."""
    files: int
    """That were read."""
    images: int
    """Shown again at the stated poses."""
    instances: int
    """In them."""
    depth_error: tuple[float, float] | None
    """Metres by which depth lies off the models: median of the amount, and its 99th percentile; None without any."""
    colour_offset: tuple[int, int] | None
    """(u, v) pixels by which colour edges lie off the masks'; None where no image was shown again."""

    @property
    def good(self) -> bool:
        """Whether nothing is wrong."""
        return not self.findings


class _Description(Entry):
    name: str
    seed: int
    formats: list[str]
    recipe_sha256: str
    scenes: int
    frames: int
    complete: bool


def validate(root: Path, sample: int = 20, say: Say = lambda text: None) -> Validation:
    """Check every file of a data set, made by simtrack or, in a known format, by others.

    Args:
        root: its folder.
        sample: about how many images are shown again at the stated poses, of each BOP data set.
        say: is told what is being checked.

    Raises:
        DatasetError: the folder holds nothing that is known.
    """
    if not root.is_dir():
        raise DatasetError(root, "is no folder")
    report, ours = Report(root), (root / DESCRIPTION).is_file()
    rerenderer = Rerenderer(exact=ours, noise=recipe_noise(root / RECIPE) if ours else None)
    checks = _checks(report, rerenderer, exact=ours, sample=sample)
    if ours:
        formats = _check_folder(report, checks, say)
    else:
        formats = dict.fromkeys(_formats(root), root)
        if not formats:
            raise DatasetError(root, f"holds none of the formats that are known: {', '.join(checks)}")
    counts: dict[str, int] = {}
    for name, folder in formats.items():
        say(f"checking {name}")
        counts[name] = checks[name](folder)
        report.holds(counts[name] > 0, folder, "", f"no {name} data", "at least one image, scan or log")
    _check_colour(report, rerenderer)
    residuals = np.abs(np.concatenate([*rerenderer.residuals, np.zeros(0, np.float32)]))
    error = (float(np.median(residuals)), float(np.quantile(residuals, 0.99))) if len(residuals) else None
    return Validation(
        tuple(report.findings), counts, report.files, rerenderer.images, rerenderer.instances, error,
        rerenderer.colour_offset,
    )  # fmt: skip


def _checks(report: Report, rerenderer: Rerenderer, *, exact: bool, sample: int) -> dict[str, Callable[[Path], int]]:
    expected = Expectations(exact)

    def bop(folder: Path) -> int:
        return validate_bop(report, folder, expected, rerenderer, sample)

    return {
        "bop": bop,
        "bop_webdataset": bop,
        "coco": lambda folder: validate_coco(report, folder, disjoint=exact),
        "yolo": lambda folder: validate_yolo(report, folder),
        "kitti": lambda folder: validate_kitti(report, folder),
        "tum": lambda folder: validate_tum(report, folder),
        "mcap": lambda folder: validate_mcap(report, folder),
        "labels": lambda folder: validate_labels(report, folder),
        "dope": lambda folder: validate_dope(report, folder),
    }


def _formats(root: Path) -> list[str]:
    """The formats of a folder that says nothing of itself."""
    found = {
        "bop": is_bop(root),
        "coco": is_coco(root),
        "yolo": bool(yolo_folders(root)),
        "kitti": is_kitti(root),
        "tum": bool(tum_folders(root)),
        "mcap": any(root.glob("*.mcap")),
        "labels": is_labels(root),
        "dope": (root / "conventions.json").is_file(),
    }
    return [name for name, there in found.items() if there]


def _check_folder(report: Report, checks: Mapping[str, object], say: Say) -> dict[str, Path]:
    """Check what a generation writes beside the formats; returns the formats' folders."""
    root, path = report.root, report.root / DESCRIPTION
    about: _Description | None = report.document(path, _Description)
    if about is None:
        return {}
    report.holds(about.complete, path, "complete", about.complete, "true: run the same simtrack generate again")
    recipe = report.read(root / RECIPE, lambda file: sha256(file.read_bytes()).hexdigest())
    if recipe is not None:
        report.equal(path, "recipe_sha256", about.recipe_sha256, recipe)
    say("checking scenes")
    markers = report.read(root / MARKERS, lambda _: read_markers(root)) or {}
    if about.complete:
        report.equal(root / MARKERS, "", sorted(markers), list(range(about.scenes)))
        report.equal(path, "frames", about.frames, sum(marker.frames for marker in markers.values()))
    for marker in markers.values():
        found = SceneMarker.of(root, marker.scene, marker.frames, marker.units)
        file = root / MARKERS / f"{marker.scene:06d}.json"
        if report.equal(file, "files", found.files, marker.files):
            report.equal(file, "digest", found.digest, marker.digest)
    out: dict[str, Path] = {}
    for name in about.formats:
        if report.holds(name in checks, path, "formats", name, sorted(checks)):
            out[name] = root / name
            report.holds(out[name].is_dir(), out[name], "", "nothing", "a folder")
    return {name: folder for name, folder in out.items() if folder.is_dir()}


def _check_colour(report: Report, rerenderer: Rerenderer) -> None:
    offset = rerenderer.colour_offset
    if offset is not None:
        limit = 0 if rerenderer.exact else 1
        u, v = offset
        report.holds(
            max(abs(u), abs(v)) <= limit, report.root, f"colour images ({rerenderer.images} of them)",
            f"edges {u}, {v} pixels off those of the masks", f"at most {limit}",
        )  # fmt: skip


def recipe_noise(path: Path) -> DepthNoiseConfig | None:
    """The depth camera's errors as the recipe of a data set states them; None if it does not tell."""
    from simtrack.datasets.recipe import DriveViews, parse_recipe
    from simtrack.datasets.stages import depth_noise
    from simtrack.errors import SimtrackError
    from simtrack.simulation.strict_file import read_document

    try:
        recipe = parse_recipe(read_document(path), path)
        if isinstance(recipe.views, DriveViews):  # the scene's own camera
            return None
        return depth_noise(recipe)
    except SimtrackError:  # of another place or version: its folders of objects are not here
        return None
