"""The units in which people read a design parameter."""

import math
from dataclasses import dataclass
from typing import Protocol


class Measured(Protocol):
    """What is asked of a design parameter, whether it is one of a run or of a design.json."""

    @property
    def unit(self) -> str:
        """Unit of the parameter's numbers, such as "m" or "rad"."""
        ...

    @property
    def hard_hi(self) -> float:
        """Largest value that the task allows."""
        ...


@dataclass(frozen=True)
class Unit:
    """Unit in which a quantity is shown, and with how many digits."""

    name: str
    factor: float
    """Factor by which the parameter's own number is multiplied."""
    digits: int

    def number(self, value: float) -> str:
        """Return a value of the parameter as a number in this unit, such as "12.0"."""
        return f"{round(value * self.factor, self.digits) + 0.0:.{self.digits}f}".replace("-", "−")  # no "−0.0"

    def words(self, value: float) -> str:
        """Return a value of the parameter with the unit, such as "12.0 cm"."""
        return f"{self.number(value)}{self._unit}"

    def change(self, value: float) -> str:
        """Return a change of the parameter, such as "+6.3 cm" or "−0.4 cm", and "±0.0 cm" where nothing is to be seen
        of it."""
        number = self.number(abs(value))
        sign = "±" if float(number) == 0 else "+" if value > 0 else "−"
        return f"{sign}{number}{self._unit}"

    @property
    def _unit(self) -> str:
        return self.name if self.name == "°" else f" {self.name}".rstrip()


def unit_of(p: Measured) -> Unit:
    """Return the unit in which people think of a parameter: degrees, and centimetres for what is below a metre."""
    if p.unit == "rad":
        return Unit("°", math.degrees(1), 1)
    if p.unit == "m":
        return Unit("cm", 100.0, 1) if p.hard_hi < 1 else Unit("m", 1.0, 2)
    return Unit(p.unit, 1.0, 2)
