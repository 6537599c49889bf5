"""Colours of robots and scenery. Okabe and Ito's palette: told apart by colour-blind people too."""

Colour = tuple[float, float, float, float]
"""A colour as red, green, blue and opacity in [0, 1]."""

BASE: Colour = (0.35, 0.37, 0.42, 1.0)
PARTS: tuple[Colour, ...] = (
    (0.00, 0.45, 0.70, 1.0), (0.34, 0.71, 0.91, 1.0), (0.00, 0.62, 0.45, 1.0), (0.90, 0.62, 0.00, 1.0),
    (0.84, 0.37, 0.00, 1.0),
)  # fmt: skip
"""Colours of the links of an arm, or of the fingers of a hand."""
WALL: Colour = (0.55, 0.57, 0.62, 1.0)
GOAL: Colour = (0.80, 0.47, 0.65, 1.0)
OBJECT: Colour = (0.86, 0.86, 0.89, 1.0)
BUTTON: Colour = (0.80, 0.28, 0.20, 1.0)
TABLE: Colour = (0.72, 0.70, 0.66, 1.0)


def lighter(colour: Colour, share: float = 0.35) -> Colour:
    """Return the colour, `share` of the way to white."""
    red, green, blue = (c + share * (1 - c) for c in colour[:3])
    return red, green, blue, colour[3]
