"""The page of a reconstruction: one file, every entity in its table and in its tree."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from simtrack.geometry.meshes import box_mesh, transformed
from simtrack.geometry.transforms import transform
from simtrack.perception.reconstruction.reconstruct import Reconstruction, reconstruct
from simtrack.perception.scene_graph.contact import EntityMesh, build_contact_graph, entity_nodes
from simtrack.plausibility.verdict import CheckConfig, CheckReport, Finding
from simtrack.report.colors import class_colors
from simtrack.report.reconstruction_page import render, tree_svg


def scene() -> Reconstruction:
    def cube(name: str, kind: str, size: tuple[float, float, float], bottom: float) -> EntityMesh:
        mesh = transformed(box_mesh(size, (200, 30, 30)), transform(None, (0.0, 0.0, bottom + size[2] / 2)))
        return EntityMesh(name, kind, mesh)

    given = [cube("floor", "floor", (3.0, 3.0, 0.1), -0.1), cube("case <1>", "case", (0.5, 0.4, 0.3), 0.0)]
    nodes, findings = entity_nodes([*given, cube("tin", "tin", (0.1, 0.1, 0.1), 0.3)], np.random.default_rng(0))
    return reconstruct(build_contact_graph(nodes, findings=findings), name="corner")


def test_the_page_shows_all_that_there_is_and_needs_nothing_else(tmp_path: Path) -> None:
    made = scene()
    problem = Finding("problem", "fell", "tin", "fell 0.70 m in 5 s")
    page = render(made, CheckReport("scene.urdf", "not plausible", (problem,), (), None, CheckConfig()), tmp_path)
    for text in ("case &lt;1&gt;", "tin", "its own mesh", "fell 0.70 m in 5 s", "not plausible", "no-model"):
        assert text in page
    assert "<1>" not in page
    assert 'src="' not in page and "http://" not in page.replace("http://www.w3.org", "")
    assert page.count("data:image/jpeg;base64,") == 2  # there is nothing to open, and no picture of the check


def test_every_node_of_the_tree_has_a_row_of_its_own() -> None:
    graph = scene().graph
    svg = ElementTree.fromstring(tree_svg(graph, class_colors(["case", "tin"])))
    texts = list(svg.iter("text"))
    assert {text.text for text in texts} == {"scene", "floor", "case <1>", "tin"}
    places = {(rect.get("x"), rect.get("y")) for rect in svg.iter("rect")}
    assert len(places) == 4
    assert len(list(svg.iter("path"))) == 3
