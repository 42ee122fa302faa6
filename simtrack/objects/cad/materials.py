"""Materials of furniture and household things: colour, how heavy, how slippery."""

from dataclasses import dataclass, replace

from simtrack.objects.shapes import Color


@dataclass(frozen=True, slots=True)
class Material:
    """What a piece is made of."""

    name: str
    color: Color
    density: float
    """kg/m^3 of the drawn volume: of steel tubes and shells that are drawn solid, the mean."""
    friction: float
    """Coefficient of sliding friction."""

    def painted(self, color: Color) -> "Material":
        """The same in another colour."""
        return replace(self, color=color)


OAK = Material("wood", (176, 128, 82), 680.0, 0.5)
PINE = Material("wood", (214, 182, 134), 520.0, 0.5)
WALNUT = Material("wood", (104, 70, 46), 640.0, 0.5)
WHITE_BOARD = Material("board", (232, 230, 224), 650.0, 0.45)
GREY_BOARD = Material("board", (150, 152, 156), 650.0, 0.45)
STEEL = Material("steel", (110, 116, 124), 2700.0, 0.4)
BLACK_STEEL = Material("steel", (44, 46, 50), 2700.0, 0.4)
GLASS = Material("glass", (168, 206, 206), 2500.0, 0.4)
CERAMIC = Material("ceramic", (236, 232, 222), 2300.0, 0.45)
PLASTIC = Material("plastic", (58, 60, 66), 950.0, 0.4)
SHELL = Material("plastic", (226, 226, 222), 950.0, 0.4)
FOAM = Material("upholstery", (96, 106, 122), 70.0, 0.8)
MATTRESS = Material("upholstery", (226, 224, 216), 60.0, 0.8)
TEXTILE = Material("textile", (70, 82, 68), 220.0, 0.7)
LEATHER = Material("leather", (92, 58, 40), 300.0, 0.6)
APPLIANCE = Material("appliance", (226, 228, 230), 190.0, 0.45)
"""Sheet steel around insulation."""
ELECTRONICS = Material("electronics", (38, 40, 44), 800.0, 0.45)
SCREEN = Material("electronics", (18, 22, 30), 1100.0, 0.4)
PAPER = Material("paper", (238, 234, 220), 750.0, 0.5)
CARD = Material("card", (188, 148, 98), 140.0, 0.5)
SOIL = Material("soil", (70, 50, 38), 1100.0, 0.7)
CLAY = Material("ceramic", (184, 104, 70), 1900.0, 0.5)
LEAF = Material("leaf", (66, 128, 62), 90.0, 0.6)
