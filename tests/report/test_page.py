"""The report: complete, self-contained, the same every time, and usable with next to nothing measured."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics, Relation, StaticMap
from simtrack.evaluation.metrics import Metric, measured, unmeasured
from simtrack.evaluation.record import Interval, RunRecord
from simtrack.evaluation.targets import Target
from simtrack.geometry.meshes import box_mesh
from simtrack.geometry.transforms import transform
from simtrack.report.figures import object_errors, stage_times
from simtrack.report.headline import format_metric, table
from simtrack.report.overlay import box_layer, silhouette
from simtrack.report.page import choose_relations, render, write_report

INTRINSICS = CameraIntrinsics(640, 480, 577.0, 577.0, 319.5, 239.5)


class Balance(HTMLParser):
    """Checks that tags are closed in order."""

    VOID = ("meta", "wbr", "link", "br", "img", "input", "hr", "use", "path", "image")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag, attrs) -> None:
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag) -> None:
        if tag not in self.VOID:
            assert self.open.pop() == tag


@pytest.fixture(scope="module")
def page(record: RunRecord) -> str:
    return render(record)


def test_page_is_well_formed_and_needs_nothing_else(page: str) -> None:
    balance = Balance()
    balance.feed(page)
    assert balance.open == []
    references = re.findall(r'(?:href|src)="([^"]*)"', page)
    assert references
    assert all(r.startswith(("#", "data:")) for r in references)
    assert "<script" not in page
    assert "@import" not in page
    assert len(page) < 6_000_000


def test_page_has_all_its_parts(page: str) -> None:
    for part in ("figures", "path", "objects", "frames", "unknown", "relations", "worst", "speed", "all"):
        assert f'id="{part}"' in page
    assert "Partial" in page
    assert "the fixed gaze was not run" in page
    assert "? left-of multimeter-3" in page
    assert page.count('class="photo"') >= 8


def test_page_follows_the_theme(page: str) -> None:
    assert "prefers-color-scheme" in page
    assert "#010101" not in page, "a placeholder colour was left in a figure"
    assert "var(--ink)" in page


def test_page_is_the_same_every_time(record: RunRecord, page: str) -> None:
    assert render(record) == page


def test_a_run_that_measured_nothing_still_gets_a_page(tmp_path) -> None:
    nothing = StaticMap(np.zeros((0, 3), dtype=np.float32), np.zeros((0, 3), dtype=np.int32))
    write_report(RunRecord("mine", 0, nothing, {}, {}), tmp_path / "report.html")
    assert "mine" in (tmp_path / "report.html").read_text()


def test_a_foreign_stage_and_what_it_missed_stand_on_top(record: RunRecord, page: str) -> None:
    assert "simtrack&#39;s stages" in page
    metrics = record.metrics | {
        "foreign.tracker.frames": Metric(60, "1"),
        "foreign.tracker.missed_frames": Metric(3, "1", "frames 4-6"),
    }
    other = render(replace(record, config={**record.config, "tracker": "mine:Tracker"}, metrics=metrics))
    assert "tracker mine:Tracker" in other
    assert "The tracker missed 3 of 60 frames (frames 4-6)" in other
    assert "The tracker missed" not in page


def test_names_are_escaped(record: RunRecord) -> None:
    page = render(replace(record, scene="<script>alert(1)</script>"))
    assert "<script" not in page


def test_figures_are_xml(page: str) -> None:
    figures = re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL)
    assert figures
    for figure in figures:
        ET.fromstring(figure.replace("<svg ", '<svg xmlns:xlink="http://www.w3.org/1999/xlink" ', 1)
                      if "xmlns:xlink" not in figure else figure)  # fmt: skip


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [(0.0012, "m", "1.20 mm"), (1.5, "m", "1.50 m"), (np.pi / 180, "rad", "1°"), (3, "1", "3"), (0.95, "1", "0.950"),
     (True, "1", "yes"), (0.4, "s", "0.40 s"), (9.12e8, "bytes", "0.91 GB"), (11.3, "Hz", "11.3 Hz")],
)  # fmt: skip
def test_values_as_a_person_reads_them(value, unit: str, text: str) -> None:
    assert format_metric(measured(value, unit)) == text


def test_headline_judges_by_the_bound() -> None:
    metrics = {"a": measured(1.0, "1"), "b": measured(1.0, "1"), "c": unmeasured("1", "why"), "d": measured(0.0, "1")}
    targets = {"a": Target(1.0), "b": Target(2.0, at_most=False), "c": Target(1.0), "d": Target(0.0, False, True)}
    assert [row.verdict for row in table(metrics, list(metrics), targets)] == ["good", "bad", "", "bad"]


def test_silhouette_of_a_box_is_its_projection() -> None:
    (outline,) = silhouette(box_mesh((0.2, 0.1, 0.02)), transform(translation=(0.0, 0.0, 1.01)), INTRINSICS)
    assert np.ptp(outline, axis=0) == pytest.approx([577 * 0.2, 577 * 0.1], abs=0.8)
    assert outline.mean(axis=0) == pytest.approx([319.5, 239.5], abs=0.8)


def test_what_is_behind_the_camera_is_not_drawn() -> None:
    assert silhouette(box_mesh((0.2, 0.1, 0.02)), transform(translation=(0.0, 0.0, -1.0)), INTRINSICS) == []
    assert 'd=""' in box_layer(transform(translation=(0.0, 0.0, -1.0)), np.ones(3) * 0.1, INTRINSICS, "#fff")
    assert "nan" not in box_layer(transform(translation=(0.0, 0.0, 0.0)), np.ones(3), INTRINSICS, "#fff", fill=0.1)


def test_relations_that_changed_come_first() -> None:
    constant = Interval(Relation("a", "left-of", "b"), 0, 10)
    changed = Interval(Relation("b", "near", "c"), 2, 5)
    support = Interval(Relation("a", "on", "b"), 0, 10)
    assert choose_relations([constant, changed, support]) == [support, changed, constant]


def test_large_errors_and_single_frames_are_drawn(record: RunRecord) -> None:
    first = [frame for frame in record.object_frames if frame.name == "materialbox"]
    lone = replace(first[30], translation_error=2.4)
    kept = [replace(f, track=None) if f is first[29] or f is first[31] else f for f in first]
    colors = {"materialbox": "#4c9be8"}
    usual = object_errors(replace(record, object_frames=first), colors)
    figure = object_errors(replace(record, object_frames=[lone if f is first[30] else f for f in kept]), colors)
    assert {label for label in ("0.1", "1", "10", "100", "1000") if f">{label}<" in usual} == {"0.1", "1", "10", "100"}
    assert ">1000<" in figure
    # matplotlib draws markers as <use>; the axes have one a tick
    points = [re.findall(r"<use [^>]*#4c9be8", text) for text in (usual, figure)]
    assert [len(found) for found in points] == [0, 2], "one in each width"


def test_times_of_stages_tell_median_and_percentile(record: RunRecord) -> None:
    times = {"tracking": [0.010] * 90 + [0.030] * 10}
    assert "10.0 (p95 30.0) ms" in stage_times(replace(record, stage_seconds=times))
