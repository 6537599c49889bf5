"""One line of the proof that exported files are the same robot."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Check:
    """One line of the proof: the largest difference found, and what is allowed."""

    name: str
    worst: float
    allowed: float
    detail: str = ""
    """Words on where the largest difference is, or why there is no comparison."""

    @property
    def passed(self) -> bool:
        """Whether the largest difference is allowed; false where it is NaN."""
        return self.worst <= self.allowed  # False for NaN

    @property
    def facts(self) -> dict[str, object]:
        """Return the fields and `passed` for JSON, which knows no infinity: there `worst` is None."""
        worst = self.worst if math.isfinite(self.worst) else None
        return {
            "name": self.name,
            "passed": self.passed,
            "worst": worst,
            "allowed": self.allowed,
            "detail": self.detail,
        }

    def __str__(self) -> str:
        verdict = "agrees" if self.passed else "DISAGREES"
        return (
            f"{self.name}: {verdict} ({self.worst:.2g}, allowed {self.allowed:g}{self.detail and f', {self.detail}'})"
        )


def relative(expected: Mapping[str, object], found: Mapping[str, object]) -> dict[str, float]:
    """Return the difference of each entry of `expected`, relative to its size; infinity where it is missing."""
    differences = {}
    for name, value in expected.items():
        if name not in found:
            differences[name] = math.inf
            continue
        a, b = np.asarray(value, dtype=float), np.asarray(found[name], dtype=float)
        differences[name] = float(np.abs(a - b).max() / max(float(np.abs(a).max()), 1e-300)) if (a != b).any() else 0.0
    return differences


def worst(name: str, allowed: float, differences: Mapping[str, float]) -> Check:
    """Return the check of the largest difference; NaN counts as larger than anything."""
    where = max(differences, key=lambda n: math.inf if math.isnan(differences[n]) else differences[n], default=None)
    if where is None:
        return Check(name, 0.0, allowed, "none to compare")
    return Check(name, differences[where], allowed, "" if differences[where] == 0 else f"at {where}")
