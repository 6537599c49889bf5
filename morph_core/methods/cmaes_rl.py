"""`cmaes_rl`, the paper's rival: CMA-ES over phi, with PPO from scratch for every candidate."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from morph_core.config import Fraction
from morph_core.design import DesignSpace
from morph_core.exploration import run_trajectories
from morph_core.method import Method
from morph_core.parts import Iterations
from morph_core.protocol import Progress
from morph_core.search import Memory
from morph_core.spread import nearest_buildable
from morph_core.task import Task

if TYPE_CHECKING:
    from morph_core.hw_nn import HwNN
    from morph_core.state import State

REFUSALS = 100
"""Candidates in a row that can't be built, before the design where CMA-ES began is tried instead."""


@dataclass(frozen=True)
class CmaesRl(Method):
    """The paper's baseline CMA-ES with an inner loop of reinforcement learning: one candidate phi after another is
    tried with a policy that learns from scratch, and costs minus the best mean return of an iteration.

    It differs from the original, the one of HWasP by the same laboratory, in these points. CMA-ES starts at the initial
    design, not in the middle of the box. A candidate costs minus its best undiscounted return, as the paper says; there
    it costs minus the mean discounted return of the last ten epochs. The population is pycma's 4 + floor(3 ln n), not
    8, and the run's budget ends the search, not the fifth generation; where pycma's own tolerances end it sooner, it
    begins anew at the best candidate. PPO, networks and schedule are those of the other methods here; learning rates
    and noise fall anew with each candidate.

    Bounds and locks that a user edits are obeyed from the next candidate on, where CMA-ES begins anew, in the new box,
    at the best candidate so far. A design that a user injects, or to which an edit has moved the present candidate, is
    the next candidate, and CMA-ES begins anew after it.
    """

    candidate_iterations: Iterations = 20
    """Iterations of PPO for each candidate; 20 of the reacher are about the 150 thousand steps of HWasP's."""
    sigma0: Fraction = 0.25
    """sigma0: first step size of CMA-ES, as a share of each parameter's range."""

    name: ClassVar[str] = "cmaes_rl"
    title: ClassVar[str] = "CMA-ES tries one φ after another, the policy learns anew with each"
    ends_at_best: ClassVar[bool] = True

    def memory(self, proxy: "HwNN | None") -> "Trials":
        return Trials()

    def rules(self) -> str:
        return f"CMA-ES over φ, {self.candidate_iterations} iterations of PPO from scratch for each candidate"

    def iterations(self, task: Task, state: "State") -> Iterator[Progress]:
        trials = state.memory
        if not isinstance(trials, Trials):
            raise ValueError("the method cmaes_rl needs the memory that it made before the first iteration")
        for iteration in itertools.count(state.iteration + 1):
            if trials.moved_by_user(state) or self._is_tried(trials, state.design_space):
                state.phi = self._next_candidate(task, state, trials)
                state.control.begin_again(state, iteration - 1)
            state.set_learning_rates(self, iteration)
            rollout = run_trajectories(task, state, task.hw_phy(state.phi), self.trajectories)
            trials.iterations += 1
            if rollout.holds_enough:
                state.control.learn(state, rollout, iteration)
                trials.take_note(rollout.mean_return)
            yield state.advance(iteration, rollout)

    def _is_tried(self, trials: "Trials", space: DesignSpace) -> bool:
        """Tell whether another candidate's turn has come; where every parameter is locked there is no other one."""
        return not trials.phi or (trials.iterations >= self.candidate_iterations and bool(space.free.any()))

    def _next_candidate(self, task: Task, state: "State", trials: "Trials") -> np.ndarray:
        trials.close()
        if trials.moved_by_user(state):
            return trials.open(state.phi, asked=False)
        if not trials.asked or trials.box != _box_of(state.design_space):
            trials.search_anew(task, state)
        for _ in range(REFUSALS):
            phi = trials.ask(state.design_space, self.sigma0)
            if phi is None:
                trials.search_anew(task, state)
            elif task.buildable(phi):
                return trials.open(phi, asked=True)
            else:
                trials.refuse()
        return trials.open(np.array(trials.start), asked=False)


@dataclass
class Trials(Memory):
    """What is known of the candidates: enough to make CMA-ES again after a resume, bit for bit.

    Every field is as JSON has it.
    """

    seed: int = 0
    """Seed of the present CMA-ES."""
    start: list[float] = field(default_factory=list)
    """Design phi where the present CMA-ES began."""
    box: list[list[float | None]] = field(default_factory=list)
    """Lower bound, upper bound and lock of each parameter in the present CMA-ES."""
    costs: list[float | None] = field(default_factory=list)
    """Costs of the present CMA-ES's candidates in the order in which it asked for them; None is infinite."""
    phi: list[float] = field(default_factory=list)
    """Design phi of the candidate that is being tried; empty before the first."""
    asked: bool = False
    """Whether the present CMA-ES asked for the candidate that is being tried, and is to be told its cost."""
    iterations: int = 0
    """Iterations for which the candidate has been tried."""
    best_return: float | None = None
    """Best mean return of the candidate that is being tried; None as long as every simulation has diverged."""
    best_phi: list[float] = field(default_factory=list)
    """Design phi of the best candidate so far; empty before the first."""
    best_of_all: float | None = None
    """Best mean return of the best candidate so far."""
    refused: int = 0
    """Candidates so far that could not be built."""

    @property
    def facts(self) -> dict[str, object]:
        return dict(vars(self))

    def recall(self, facts: dict[str, object]) -> None:
        vars(self).update(facts)

    def moved_by_user(self, state: "State") -> bool:
        """Tell whether phi is no longer that of the candidate, or of the initial design before the first."""
        return state.phi.tolist() != (self.phi or state.design_space.initial.tolist())

    def take_note(self, mean_return: float) -> None:
        """Take note of the mean return of an iteration of the candidate."""
        self.best_return = mean_return if self.best_return is None else max(self.best_return, mean_return)

    def open(self, phi: np.ndarray, asked: bool) -> np.ndarray:
        """Begin to try a candidate phi (d,), and return it."""
        self.phi, self.asked, self.iterations, self.best_return = phi.tolist(), asked, 0, None
        return phi

    def close(self) -> None:
        """Write down what the candidate that was tried has cost."""
        found = self.best_return
        if self.asked:
            self.costs.append(None if found is None else -found)
        if found is not None and (self.best_of_all is None or found > self.best_of_all):
            self.best_phi, self.best_of_all = self.phi, found

    def refuse(self) -> None:
        """Write down that the candidate that CMA-ES asks for can't be built."""
        self.costs.append(None)
        self.refused += 1

    def search_anew(self, task: Task, state: "State") -> None:
        """Begin another CMA-ES, in the present box and at the best candidate so far, or at phi before the first."""
        space = state.design_space
        best = np.array(self.best_phi or state.phi)
        self.start = nearest_buildable(task, state.phi, space.clip(best)).tolist()
        self.seed, self.box, self.costs = int(state.rng.integers(1, 2**31)), _box_of(space), []

    def ask(self, space: DesignSpace, sigma0: float) -> np.ndarray | None:
        """Return the next candidate phi (d,) of the present CMA-ES; None where it has come to its end.

        Nothing of pycma outlives the call: seed and costs lead it to where it was, which takes milliseconds.
        """
        import cma

        free = space.free
        lo, width = space.lo[free], (space.hi - space.lo)[free]
        x0 = np.full(max(2, len(lo)), 0.5)  # cma needs two dimensions: beside a lone free one stands one without effect
        x0[: len(lo)] = np.clip((np.array(self.start)[free] - lo) / width, 0, 1)
        es = cma.CMAEvolutionStrategy(x0, sigma0, {"bounds": [0, 1], "seed": self.seed, "verbose": -9})
        told = 0
        while len(population := es.ask()) <= len(self.costs) - told:
            costs = self.costs[told : told + len(population)]
            es.tell(population, [np.inf if cost is None else cost for cost in costs])
            told += len(population)
            if es.stop():
                return None
        phi = np.array(self.start)
        phi[free] = lo + width * population[len(self.costs) - told][: len(lo)]
        return space.clip(phi)


def _box_of(space: DesignSpace) -> list[list[float | None]]:
    return [[p.lo, p.hi, p.locked_at] for p in space.parameters]
