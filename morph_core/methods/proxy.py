"""MORPH: the method of the paper, which learns a proxy of the hardware."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from morph_core.config import Alpha, Projection, Share
from morph_core.exploration import Exploration, Notes
from morph_core.explorations.design import Design
from morph_core.method import Method
from morph_core.morph import morph
from morph_core.parts import Iterations, ProxyFit
from morph_core.protocol import Progress
from morph_core.search import Memory, Search
from morph_core.searches.cma import Cma
from morph_core.task import Task

if TYPE_CHECKING:
    from morph_core.hw_nn import HwNN
    from morph_core.state import State


@dataclass(frozen=True)
class Morph(Method):
    """The paper's method, Algorithm 1: policy and hardware proxy learn together, and phi follows the proxy."""

    design_interval: Iterations = 1
    """K: iterations between two searches for phi."""
    alpha: Alpha = 1.0
    """alpha: weight of the divergence between proxy and Hw-Phy in Eq. 2."""
    projection: Projection = "none"
    """Rule of the gradient projection: what happens to g_task where it conflicts with g_hw."""
    freeze_success: Share = 0.0
    """Share of successful trajectories from which on phi is frozen and every episode runs on it; 0 never freezes it.
    Among episodes that all succeed, ranking is noise and would move phi at random."""
    proxy: ProxyFit = ProxyFit()
    """Fit of the proxy to Hw-Phy."""
    exploration: Exploration = Design()
    """Exploration of z, the hardware's output: `design` draws designs around phi on Hw-Phy, `gaussian` runs in the
    proxy's world with noise on its z, as the paper does, and `gaussian_iid` draws that noise afresh at every step."""
    search: Search = Cma()
    """Search for phi whose physics match the proxy (Eq. 3): `cma` is CMA-ES on the divergence, `cma_debiased` the same
    without what contact adds to it, `gradient` its gradient where Hw-Phy is differentiable, `drift` least squares on
    what the task asks of the proxy, where contact makes the divergence rough."""

    name: ClassVar[str] = "morph"
    title: ClassVar[str] = "policy and hardware proxy learn together, φ follows the proxy"

    @property
    def proxy_fit(self) -> ProxyFit:
        return self.proxy

    @property
    def steering(self) -> tuple[float, Projection]:
        return self.alpha, self.projection

    def memory(self, proxy: "HwNN | None") -> Memory:
        return self.search.memory(proxy) if proxy else Memory()

    def notes(self) -> Notes:
        return self.exploration.notes()

    def check(self, task: Task) -> None:
        self.exploration.check(task)
        self.search.check(task)

    def rules(self) -> str:
        return f"z explored by {self.exploration.name}, φ searched by {self.search.name}, projection {self.projection}"

    @property
    def search_interval(self) -> int:
        return self.design_interval

    @property
    def freezes(self) -> bool:
        return self.freeze_success > 0

    def prepare(self, task: Task, state: "State") -> None:
        state.fit_proxy(task)

    def iterations(self, task: Task, state: "State") -> Iterator[Progress]:
        return morph(task, self, state)
