"""Colours of classes: all different, and the plain hues as long as they suffice."""

from simtrack.report.colors import PALETTE, SHADES, class_colors


def test_classes_have_colours_of_their_own() -> None:
    names = [f"class-{number:02d}" for number in range(len(PALETTE) * len(SHADES))]
    colors = class_colors([*reversed(names), names[0]])
    assert list(colors) == names
    assert len(set(colors.values())) == len(names)
    assert tuple(colors.values())[: len(PALETTE)] == PALETTE
    assert all(len(color) == 7 and int(color[1:], 16) >= 0 for color in colors.values())
