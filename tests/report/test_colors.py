"""Colours of classes: all different, and the plain hues as long as they suffice."""

import numpy as np
from skimage.color import deltaE_ciede2000, rgb2lab

from simtrack.report.colors import PALETTE, SHADES, class_colors


def test_classes_have_colours_of_their_own() -> None:
    names = [f"class-{number:02d}" for number in range(len(PALETTE) * len(SHADES))]
    colors = class_colors([*reversed(names), names[0]])
    assert list(colors) == names
    assert len(set(colors.values())) == len(names)
    assert tuple(colors.values())[: len(PALETTE)] == PALETTE
    assert all(len(color) == 7 and int(color[1:], 16) >= 0 for color in colors.values())


def test_hues_are_told_apart_and_seen_on_light_and_dark_ground() -> None:
    rgb = np.array([[int(color[k : k + 2], 16) / 255 for k in (1, 3, 5)] for color in PALETTE])
    lab = rgb2lab(rgb)
    apart = deltaE_ciede2000(lab[:, None], lab[None])
    assert apart[~np.eye(len(PALETTE), dtype=bool)].min() > 20.0
    assert (lab[:, 0] > 40.0).all()
    assert (lab[:, 0] < 75.0).all()
