"""What if a run's design were another: an evaluation on any phi of the task's own box, or a sweep along each parameter.

The policy is that of the newest checkpoint up to the iteration whose design was changed.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Literal, get_args

import msgspec
import numpy as np

from morph_core.catalogue import make_task
from morph_core.design import DesignSpace
from morph_core.history import History
from morph_core.task import Task
from morph_core.what_if import Measured, Question
from studio.cancellation import Cancellation
from studio.evaluator import Evaluator
from studio.limits import LARGEST_SEED

POINTS = 9
"""Number of values of each parameter in a sweep, from one end of the task's own box to the other."""
_COARSE_TO_FINE = (0, 8, 4, 2, 6, 1, 3, 5, 7)
"""Order of the values of a sweep, so that every curve is there early and gets finer."""
Episodes = Annotated[int, msgspec.Meta(ge=1, le=10_000)]
Policy = Literal["sampled", "deterministic"]
POLICIES: tuple[Policy, ...] = get_args(Policy)
"""Ways to act: by actions that are drawn from the policy's distribution, or by its means."""
Phi = list[float] | dict[str, float]
"""Design as all of its values, or as some by name, which are laid over the design that was chosen."""


class Wish(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Wish for an evaluation. `phi` are all values of another design, or some by name, in the parameters' own units."""

    design: str = "best"
    """Design to begin with, and whose policy it is: best, latest or an iteration."""
    phi: Phi | None = None
    episodes: Episodes = 128
    seed: Annotated[int, msgspec.Meta(ge=0, le=LARGEST_SEED)] = 0
    policy: Policy = "sampled"


class WhatIf(Measured, frozen=True, kw_only=True):
    """Answer to a wish: what the policy came to on the design."""

    run: str
    iteration: int
    policy_iteration: int
    """Iteration of the checkpoint that holds the policy."""
    note: str = ""
    """Sentence that says whose policy it is where the iteration has no checkpoint of its own; else empty."""
    policy: str
    seed: int
    phi: dict[str, float]


class SweepPoint(msgspec.Struct, frozen=True, kw_only=True):
    """One point of a sweep: a design that differs in one parameter."""

    number: int
    """Number of this point, from 1 on, in the order of their evaluation."""
    of: int
    """Number of points in all."""
    parameter: str
    unit: str
    value: float
    measured: Measured | None
    """What was measured; None where the design can't be put together."""
    reason: str = ""
    """Why the design can't be put together."""


class WhatIfs:
    """Answers to wishes about runs, from the process that evaluates designs."""

    def __init__(self, evaluator: Evaluator) -> None:
        self._evaluator = evaluator

    def warm_up(self) -> None:
        """Load the process that evaluates designs, so that the first answer is quick."""
        self._evaluator.warm_up()

    def evaluate(
        self,
        history: History,
        wish: Wish,
        cancellation: Cancellation,
        on_played: Callable[[bytes], None] | None = None,
    ) -> WhatIf:
        """Return how good the policy is on a design; `on_played` is handed an episode of it first, as npz.

        Raise RunFolderError or ValueError with what is allowed, CancelledError, or EvaluatorError.
        """
        asked = _Asked(history, wish)
        asked.task.check_buildable(asked.phi)
        measured = self._evaluator.ask(asked.question(asked.phi), cancellation, on_played=on_played)
        return WhatIf(
            **msgspec.structs.asdict(measured),
            run=history.folder.id,
            iteration=asked.iteration,
            policy_iteration=asked.checkpoint,
            note=policy_note(asked.iteration, asked.checkpoint),
            policy=wish.policy,
            seed=wish.seed,
            phi=dict(zip(asked.space.names, asked.phi.tolist(), strict=True)),
        )

    def sweep(self, history: History, wish: Wish, cancellation: Cancellation) -> Iterator[SweepPoint]:
        """Yield the points of a sweep along each parameter, through the wish's design, coarse to fine.

        What is wrong with the wish is raised by this call; the evaluations are done as the points are taken, and
        others go before them.
        """
        asked = _Asked(history, wish)
        return self._points(asked, cancellation)

    def _points(self, asked: "_Asked", cancellation: Cancellation) -> Iterator[SweepPoint]:
        designs = sweep_designs(asked.space, asked.phi)
        for number, (i, phi) in enumerate(designs, 1):
            p, measured, reason = asked.space.parameters[i], None, ""
            try:
                asked.task.check_buildable(phi)
            except ValueError as error:
                reason = str(error)
            else:
                measured = self._evaluator.ask(asked.question(phi), cancellation, patient=True)
            yield SweepPoint(
                number=number, of=len(designs), parameter=p.name, unit=p.unit, value=float(phi[i]), measured=measured,
                reason=reason,
            )  # fmt: skip


class _Asked:
    """A wish that is allowed, with what an evaluation needs."""

    def __init__(self, history: History, wish: Wish) -> None:
        self._run, self._wish = history.folder, wish
        self.iteration, recorded = history.design(wish.design)
        self.space = DesignSpace(tuple(history.record.parameters)).whole
        self.phi = phi_of(self.space, recorded, wish.phi)
        self.checkpoint = history.folder.checkpoint_up_to(self.iteration)
        self.task: Task = make_task(history.record.task, history.record.task_options)

    def question(self, phi: np.ndarray) -> Question:
        wish = self._wish
        return Question(
            id=0, run=str(self._run.path.resolve()), iteration=self.iteration, checkpoint=self.checkpoint,
            phi=phi.tolist(), episodes=wish.episodes, seed=wish.seed, sampled=wish.policy == "sampled",
        )  # fmt: skip


def phi_of(space: DesignSpace, recorded: np.ndarray, given: Phi | None) -> np.ndarray:
    """Return the design (d,) that is meant: `given` in place of the recorded one, or laid over it by name.

    Raise ValueError with what is allowed.
    """
    if given is None:
        return space.check(recorded)
    if not isinstance(given, Mapping):
        return space.check(given)
    phi = recorded.copy()
    for name, value in given.items():
        phi[space.index(name)] = value
    return space.check(phi)


def policy_note(iteration: int, checkpoint: int) -> str:
    """Return whose policy it is where the iteration has no checkpoint of its own, in a sentence; else nothing."""
    if iteration == checkpoint:
        return ""
    return f"iteration {iteration} has no checkpoint: the policy is that of iteration {checkpoint}, the nearest before"


def sweep_designs(space: DesignSpace, phi: np.ndarray) -> Sequence[tuple[int, np.ndarray]]:
    """Return the index of a parameter and a design (d,) that differs from phi in it, for each point of a sweep."""
    lo, hi = space.hard_box
    values = np.linspace(lo, hi, POINTS)  # (POINTS, d)
    designs = []
    for point in _COARSE_TO_FINE:
        for i in range(len(space)):
            other = phi.copy()
            other[i] = values[point, i]
            designs.append((i, other))
    return designs
