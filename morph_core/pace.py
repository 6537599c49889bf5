"""The pace of a trainer: how long its iterations and its evaluations take, and so how long the rest of the run will."""

from collections.abc import Sequence

_WINDOW = 20
"""Number of iterations over which the pace is taken, so that it hardly swings."""
_SELDOM = 5
"""Number of searches for phi, and of evaluations, over which theirs is taken: they come seldom."""


class Pace:
    """Seconds of a trainer's iterations, of the searches for phi in them, and of its evaluations, each by itself: what
    comes every few iterations, or ends before the run does, is counted, and not spread over all of them.

    It may be asked by one thread while another one tells it of an iteration.
    """

    def __init__(self) -> None:
        self._first: float | None = None
        self._plain: Sequence[float] = ()
        self._searches: Sequence[float] = ()
        self._evaluated: Sequence[float] = ()
        self._env_steps: Sequence[float] = ()

    def took(self, seconds: float, env_steps: int, searching: float | None = None) -> None:
        """Take in an iteration, of which a search for phi took the seconds `searching`; None if it had none."""
        plain = seconds - (searching or 0.0)
        if self._first is None:
            self._first = plain
        else:
            self._plain = _newest(self._plain, plain, _WINDOW)
        if searching is not None:
            self._searches = _newest(self._searches, searching, _SELDOM)
        self._env_steps = _newest(self._env_steps, env_steps, _WINDOW)

    def evaluated(self, seconds: float) -> None:
        """Take in an evaluation, with all that is saved after it."""
        self._evaluated = _newest(self._evaluated, seconds, _SELDOM)

    @property
    def env_steps(self) -> float | None:
        """Return the environment steps of an iteration; None before the first one."""
        return _mean(self._env_steps)

    def left(
        self,
        iterations: float,
        searches: float = 0.0,
        evaluations: float = 0.0,
        expected: float = 0.0,
        settled: float = 0.0,
        alone: float = 0.0,
    ) -> float | None:
        """Return the seconds that so many iterations, the searches in them and evaluations beside them will take.

        `settled` of the iterations come after phi is frozen, when the policy learns `alone`, which takes that many
        seconds, or as long as before if that is less. An evaluation takes the `expected` seconds as long as none was
        timed. None before the first iteration.
        """
        if self._first is None:
            return None
        # Much is done for the first time in the first one: it counts as long as there is no other.
        plain = _mean(self._plain) or self._first
        search = _mean(self._searches) or 0.0
        evaluated = self.evaluation or expected
        before = plain * (iterations - settled) + min(alone, plain) * settled
        return before + search * searches + evaluated * evaluations

    @property
    def evaluation(self) -> float | None:
        """Return the seconds of an evaluation; None before the first one."""
        return _mean(self._evaluated)


def _newest(values: Sequence[float], value: float, most: int) -> Sequence[float]:
    """Return the newest of some values, at most so many, with another one."""
    return (*values[1 - most :], value)


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None
