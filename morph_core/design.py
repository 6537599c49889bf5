"""The design parameters phi: their names, their box, and where the search starts."""

import dataclasses
import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from morph_core.hypertext import table
from morph_core.protocol import Parameter


@dataclass(frozen=True)
class DesignSpace:
    """An immutable box with locks; every edit returns a new one. phi is one vector (d,) in physical units."""

    parameters: tuple[Parameter, ...]

    def __post_init__(self) -> None:
        for p in self.parameters:
            _check_bound(p, p.lo, p.hi)
            if p.locked_at is not None:
                _check_value(p, p.locked_at)

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def names(self) -> list[str]:
        """Return the names of the parameters, in the order of phi."""
        return [p.name for p in self.parameters]

    @property
    def lo(self) -> np.ndarray:
        """Return the present lower bounds (d,)."""
        return np.array([p.lo for p in self.parameters])

    @property
    def hi(self) -> np.ndarray:
        """Return the present upper bounds (d,)."""
        return np.array([p.hi for p in self.parameters])

    @property
    def hard_box(self) -> np.ndarray:
        """Return both ends (2, d) of the task's own box, which no edit changes."""
        return np.array([[p.hard_lo for p in self.parameters], [p.hard_hi for p in self.parameters]])

    @property
    def whole(self) -> "DesignSpace":
        """Return the space with the task's own box as its bounds, and nothing locked."""
        widened = (msgspec.structs.replace(p, lo=p.hard_lo, hi=p.hard_hi, locked_at=None) for p in self.parameters)
        return DesignSpace(tuple(widened))

    @property
    def scale(self) -> np.ndarray:
        """Return a typical change of each parameter (d,): the unit of exploration and search."""
        return np.array([p.scale for p in self.parameters])

    @property
    def initial(self) -> np.ndarray:
        """Return the initial design (d,), clipped into the present bounds and locks."""
        return self.clip(np.array([p.initial for p in self.parameters]))

    @property
    def free(self) -> np.ndarray:
        """Return a mask (d,) of the parameters that may move."""
        return np.array([p.locked_at is None for p in self.parameters])

    @property
    def groups(self) -> list[np.ndarray]:
        """Return a mask (d,) of the parameters of each named group."""
        names = sorted({p.group for p in self.parameters if p.group})
        return [np.array([p.group == name for p in self.parameters]) for name in names]

    def clip(self, phi: np.ndarray) -> np.ndarray:
        """Return phi (..., d) inside the box, locked entries at their value."""
        inside = np.clip(phi, self.lo, self.hi)
        locked = np.array([math.nan if p.locked_at is None else p.locked_at for p in self.parameters])
        return np.where(np.isnan(locked), inside, locked)

    def check(self, phi: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return phi as an array (d,), or raise ValueError that says which entry is not allowed and why."""
        vector = np.asarray(phi, dtype=float)
        if vector.shape != (len(self),):
            raise ValueError(f"phi has {vector.size} entries; {len(self)} are needed: {', '.join(self.names)}")
        for p, value in zip(self.parameters, vector, strict=True):
            _check_value(p, float(value))
        return vector

    def index(self, name: str) -> int:
        """Return the place of a parameter in phi. Raise ValueError that lists the choices if there is none."""
        if name in self.names:
            return self.names.index(name)
        near = difflib.get_close_matches(name, self.names, 1)
        hint = f' (did you mean "{near[0]}"?)' if near else ""
        raise ValueError(f'unknown design parameter "{name}"{hint}; choose from: {", ".join(self.names)}')

    def with_bound(self, name: str, lo: float, hi: float) -> "DesignSpace":
        """Return the space with other bounds. Raise ValueError unless lo < hi, finite, inside the task's hard box."""
        p = self.parameters[self.index(name)]
        _check_bound(p, lo, hi)
        if p.locked_at is not None and not lo <= p.locked_at <= hi:
            raise ValueError(f"{name} is locked at {p.locked_at:g} {p.unit}, outside [{lo:g}, {hi:g}]: unlock it first")
        return self._replace(name, lo=float(lo), hi=float(hi))

    def with_lock(self, name: str, value: float) -> "DesignSpace":
        """Return the space with a parameter locked. Raise ValueError unless `value` is finite and inside the bounds."""
        _check_value(self.parameters[self.index(name)], value)
        return self._replace(name, locked_at=float(value))

    def without_lock(self, name: str) -> "DesignSpace":
        """Return the space with a parameter free to move. Raise ValueError if there is none of that name."""
        return self._replace(name, locked_at=None)

    def table(self, designs: Mapping[str, np.ndarray], caption: str = "") -> str:
        """Return designs (d,) by their names as an HTML table: a row for each parameter, with its unit and bounds."""
        locks = not self.free.all()
        rows = [
            [p.name, p.unit, *(f"{value:.4g}" for value in (p.lo, p.hi, *(phi[i] for phi in designs.values())))]
            + [_lock(p)] * locks
            for i, p in enumerate(self.parameters)
        ]
        return table(["parameter", "unit", "from", "to", *designs, *["locked at"] * locks], rows, caption)

    def _repr_html_(self) -> str:
        return self.table({"initial": self.initial})

    def _replace(self, name: str, **changes: float | None) -> "DesignSpace":
        i = self.index(name)
        changed = msgspec.structs.replace(self.parameters[i], **changes)
        return dataclasses.replace(self, parameters=(*self.parameters[:i], changed, *self.parameters[i + 1 :]))


def _lock(p: Parameter) -> str:
    return "" if p.locked_at is None else f"{p.locked_at:.4g}"


def _check_bound(p: Parameter, lo: float, hi: float) -> None:
    if not (math.isfinite(lo) and math.isfinite(hi)):
        raise ValueError(f"the bounds of {p.name} must be finite, not [{lo}, {hi}]")
    if lo >= hi:
        raise ValueError(f"the lower bound of {p.name} must be below the upper one: {lo:g} >= {hi:g} {p.unit}")
    if lo < p.hard_lo or hi > p.hard_hi:
        raise ValueError(
            f"the bounds of {p.name} must lie inside [{p.hard_lo:g}, {p.hard_hi:g}] {p.unit}, not [{lo:g}, {hi:g}]"
        )


def _check_value(p: Parameter, value: float) -> None:
    if not math.isfinite(value):
        raise ValueError(f"{p.name} must be finite, not {value}")
    if not p.lo <= value <= p.hi:
        raise ValueError(f"{p.name} must lie inside [{p.lo:g}, {p.hi:g}] {p.unit}, not {value:g}")
