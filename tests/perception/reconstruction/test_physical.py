"""Mass properties follow from size, class and substance."""

import numpy as np
import pytest

from simtrack.errors import MeshError, UnknownNameError
from simtrack.geometry.meshes import box_mesh, transformed
from simtrack.geometry.transforms import transform
from simtrack.perception.reconstruction.physical import CLASSES, SUBSTANCES, physical_properties


def test_a_solid_box_has_the_mass_and_inertia_of_a_box() -> None:
    size = np.array([0.4, 0.3, 0.02])
    found = physical_properties([box_mesh(size)], "table")
    mass = SUBSTANCES["hardwood"].density * size.prod()
    assert found.mass == pytest.approx(mass)
    squares = size**2
    assert np.allclose(found.inertia, mass / 12.0 * np.diag(squares.sum() - squares))


def test_overlap_counts_once_and_mass_grows_with_volume() -> None:
    half = transform(None, (0.05, 0.0, 0.0))
    cube = box_mesh((0.1, 0.1, 0.1))
    joined = physical_properties([cube, transformed(cube, half)], "book")
    whole = physical_properties([transformed(box_mesh((0.15, 0.1, 0.1)), transform(None, (0.025, 0.0, 0.0)))], "book")
    assert joined.mass == pytest.approx(whole.mass)
    assert np.allclose(joined.centre_of_mass, whole.centre_of_mass) and np.allclose(joined.inertia, whole.inertia)
    twice = physical_properties([box_mesh((0.2, 0.2, 0.2))], "book")
    assert twice.mass == pytest.approx(8.0 * physical_properties([cube], "book").mass)
    assert np.allclose(twice.inertia, 32.0 * physical_properties([cube], "book").inertia)


@pytest.mark.parametrize(
    ("name", "size", "low", "high"),
    [("fridge", (0.6, 0.65, 1.8), 50, 90), ("microwave", (0.48, 0.36, 0.28), 9, 16), ("sofa", (2.0, 0.9, 0.5), 40, 90)],
)
def test_common_things_have_common_weights(
    name: str, size: tuple[float, float, float], low: float, high: float
) -> None:
    assert low < physical_properties([box_mesh(size)], name).mass < high


def test_every_class_has_a_known_substance_with_a_source() -> None:
    assert {substance for substance, _ in CLASSES.values()} <= set(SUBSTANCES)
    assert all(substance.source for substance in SUBSTANCES.values())


def test_what_is_unknown_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="ceramic"):
        physical_properties([box_mesh((1, 1, 1))], "cup", "unobtainium")
    with pytest.raises(MeshError, match="no parts"):
        physical_properties([], "cup")
