"""Colours of the report: one for each object class, legible on light and dark ground and over photographs."""

from collections.abc import Iterable, Mapping

PALETTE = ("#4c9be8", "#f28e2b", "#59b36b", "#e0567a", "#b07aa1", "#17b3b3", "#d6a514", "#9c755f", "#7f8cff", "#8fb339")
"""Tableau-like hues of about equal lightness."""
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
    """Class name -> colour, stable for the same set of names."""
    return {name: PALETTE[i % len(PALETTE)] for i, name in enumerate(sorted(set(names)))}
