"""Colours of the report: one for each object class, legible on light and dark ground and over photographs."""

from collections.abc import Iterable, Mapping

PALETTE = ("#4c9be8", "#acaf15", "#c23b80", "#0d8164", "#946945", "#de94a2", "#ec9500", "#1abbbf", "#706d9f", "#c990fc")
"""Each differs from the others by 22 at least (CIEDE2000); legible on light and dark ground."""
SHADES = (("#000000", 0.0), ("#000000", 0.38), ("#ffffff", 0.5))
"""What the hues are mixed with, and its share, once they are used up."""
ON, LEFT_OF, REFERENCE = "#ff3b30", "#20d5e8", "#ffd60a"
"""`on` red and `left-of` cyan as in the tracking paper's Fig. 4, and their reference."""
UNKNOWN = "#ff3b30"
"""What nothing explains, as in the tracking paper's Fig. 3."""
INK, MUTED, GRID, FACE, ACCENT, GOOD, BAD = (
    "#010101", "#020202", "#030303", "#040404", "#050505", "#060606", "#070707",
)  # fmt: skip
"""Placeholders in figures: they become CSS variables, so that figures follow the page's light or dark theme."""
CSS_VARIABLES = {
    INK: "var(--ink)", MUTED: "var(--muted)", GRID: "var(--grid)", FACE: "var(--face)", ACCENT: "var(--accent)",
    GOOD: "var(--good)", BAD: "var(--bad)",
}  # fmt: skip


def class_colors(names: Iterable[str]) -> Mapping[str, str]:
    """Class name -> colour, stable for the same set of names; the first 30 differ."""
    return {name: _color(i) for i, name in enumerate(sorted(set(names)))}


def _color(number: int) -> str:
    """The hues of `PALETTE` one after the other, then darker, then lighter."""
    ground, share = SHADES[number // len(PALETTE) % len(SHADES)]
    hue = PALETTE[number % len(PALETTE)]
    mixed = ((1.0 - share) * _channel(hue, k) + share * _channel(ground, k) for k in range(3))
    return "#" + "".join(f"{round(value):02x}" for value in mixed)


def _channel(color: str, k: int) -> int:
    return int(color[1 + 2 * k : 3 + 2 * k], 16)
