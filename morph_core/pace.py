"""The pace of a trainer: how long its iterations and its evaluations take, and so how long the rest of the run will."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from morph_core.method import Method
    from morph_core.state import State

_WINDOW = 20
"""Number of iterations over which the pace is taken, so that it hardly swings."""
_SELDOM = 5
"""Number of searches for phi, and of evaluations, over which theirs is taken: they come seldom."""

_SEARCHED = 0.6
"""Expected share of what is left of a method's schedule over which phi is still searched, where success will freeze it;
in recorded runs of the three tasks it was 0.5 to 0.8."""


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


class Rest:
    """What is left of a run until its last iteration or the end of its budget of environment steps, by its pace so far.

    It may be asked by one thread while another one tells it of an iteration.
    """

    def __init__(self, last: int, budget: int | None, final_episodes: int) -> None:
        self.pace = Pace()
        self._last, self._budget, self._final_episodes = last, budget, final_episodes
        self._method: Method | None = None
        self._longest_iteration = 1  # environment steps
        self._is_searching, self._collected_in, self._learnt_in = True, 0.0, 0.0

    def plan(self, method: "Method", horizon: int) -> None:
        """Take note of the method that runs, on a task whose episodes take at most `horizon` steps."""
        self._method, self._longest_iteration = method, method.trajectories * horizon

    def take_in(self, state: "State") -> None:
        """Take note of how the last iteration has left the run: what it took, and whether phi is frozen."""
        self._is_searching = not state.frozen
        self._collected_in, self._learnt_in = state.collected_in, state.learnt_in

    def iterations(self, done: int, env_steps: int) -> int:
        """Return how many iterations are left after `done` ones, by the last ones' environment steps where a budget may
        end the run."""
        remaining = max(0, self._last - done)
        if self._budget is None:
            return remaining
        steps = self.pace.env_steps or self._longest_iteration
        return min(remaining, math.ceil(max(0, self._budget - env_steps) / max(1.0, steps)))

    def seconds(self, done: int, remaining: int) -> float | None:
        """Return the seconds that the `remaining` iterations after `done` ones will take, with the searches and
        evaluations among them; None before the first iteration."""
        if self._method is None:
            return None
        evaluation, every = self._method.evaluation, self._method.search_interval
        last = done + remaining
        frozen_at = min(last, self._freezes_at(done)) if self._is_searching else last
        searches = frozen_at // every - done // every if self._is_searching else 0
        evaluations = last // evaluation.interval - done // evaluation.interval
        evaluations += remaining > 0 and last % evaluation.interval > 0  # each run ends with one
        at_the_end = self._final_episodes / evaluation.episodes
        shares = 2 * evaluation.episodes / self._method.trajectories  # of an evaluation, in iterations' trajectories
        on_hw_phy = min(self._collected_in, (self.pace.evaluation or math.inf) / shares)
        return self.pace.left(
            remaining, searches, evaluations + at_the_end, expected=shares * self._collected_in,
            settled=last - frozen_at, alone=on_hw_phy + self._learnt_in,
        )  # fmt: skip

    def _freezes_at(self, done: int) -> float:
        """Return the iteration after which success is expected to have frozen phi, which ends the searches, and all
        that serves them.

        When it will is guessed. Where a budget of steps ends the run nothing is taken off: success may make episodes
        shorter, too, and so iterations more.
        """
        method = self._method
        if method is None or self._budget is not None or not method.freezes:
            return math.inf
        left = method.schedule.iterations - done
        return done + _SEARCHED * left if left > 0 else math.inf


def _newest(values: Sequence[float], value: float, most: int) -> Sequence[float]:
    """Return the newest of some values, at most so many, with another one."""
    return (*values[1 - most :], value)


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None
