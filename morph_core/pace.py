"""The pace of a trainer: how long its iterations take, and so how long the rest of the run will."""

_WINDOW = 20
"""Number of iterations over which the pace is taken: two searches of a usual interval, so that it hardly swings."""


class Pace:
    """Seconds and environment steps of a trainer's iterations."""

    def __init__(self) -> None:
        self._taken: list[tuple[float, int]] = []

    def took(self, seconds: float, env_steps: int) -> None:
        """Take in an iteration."""
        self._taken = [*self._taken[-_WINDOW:], (seconds, env_steps)]

    @property
    def env_steps(self) -> float | None:
        """Return the environment steps of an iteration; None before the first one."""
        return self._mean(1)

    def left(self, iterations: int) -> float | None:
        """Return the seconds that so many iterations will take; None before the first one."""
        seconds = self._mean(0)
        return None if seconds is None else seconds * iterations

    def _mean(self, which: int) -> float | None:
        """Return the mean of seconds or steps, without the first iteration, in which much is done for the first
        time, as soon as there is another."""
        counted = self._taken[1:] or self._taken
        return sum(taken[which] for taken in counted) / len(counted) if counted else None
