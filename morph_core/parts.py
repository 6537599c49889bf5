"""The parts that methods are composed of: the schedule, PPO, the proxy's fit, and the evaluations."""

from dataclasses import dataclass
from typing import Annotated

from morph_core.config import Count, CountOrNone, Fraction, InitialWeights, NotNegative, Positive, Settings, most

LearningRate = Annotated[
    Positive, most(10.0, "Adam moves each weight by about as much in a step, and weights are of order one")
]
Std = Annotated[Positive, most(100.0, "wider noise only presses every action to its limit")]
Iterations = Annotated[Count, most(1_000_000, "as many iterations as a run may have")]


@dataclass(frozen=True)
class Schedule(Settings):
    """How learning rates and noises fall over the iterations."""

    iterations: Iterations = 100
    """Iterations over which learning rates and noises fall; they are constant afterwards."""

    def share(self, iteration: int) -> float:
        """Return the share of the schedule that is over, in [0, 1]; iterations count from 1."""
        return min(1.0, (iteration - 1) / max(1, self.iterations - 1))

    def geometric(self, first: float, last: float, iteration: int, hold: float = 0.0) -> float:
        """Return a value that goes geometrically from first to last, after a `hold` share of the schedule."""
        return first * (last / first) ** (max(0.0, self.share(iteration) - hold) / max(1e-9, 1 - hold))

    def linear(self, last: float, iteration: int) -> float:
        """Return a factor that goes linearly from 1 to last."""
        return 1 - (1 - last) * self.share(iteration)


@dataclass(frozen=True)
class Ppo(Settings):
    """PPO (Schulman et al. 2017) for policy and critic; the proxy's passes and rates follow it."""

    gamma: Fraction = 0.98
    """gamma: discount of rewards per control step."""
    gae_lambda: Fraction = 0.95
    """lambda: decay of later steps in generalised advantage estimation (Schulman et al. 2016)."""
    clip_coef: Annotated[Positive, most(100.0, "a ratio that may change a hundredfold is not clipped")] = 0.2
    """PPO's clip of the probability ratio of actions."""
    epochs: Annotated[Count, most(1000, "more passes take hours and only overfit one rollout")] = 5
    """Passes over the rollout per iteration, for the proxy too."""
    minibatches: Annotated[Count, most(4096, "the steps of a rollout are not enough for more")] = 8
    """Gradient steps per pass over the rollout, for the proxy too."""
    learning_rate: LearningRate = 1e-3
    """Learning rate of Adam for policy and critic at the start."""
    learning_rate_end: Fraction = 0.3
    """Learning rates at the end of the schedule, the proxy's too, as a fraction of the first ones."""
    max_grad_norm: Annotated[Positive, most(1e9, "no gradient is longer: it is no limit any more")] = 0.5
    """Largest norm of the policy's gradient; the critic's may be twice as large."""
    entropy_coef: Annotated[NotNegative, most(1000.0, "nothing else of the loss would count")] = 0.0
    """Weight of the policy's entropy bonus."""
    std: Std = 0.5
    """sigma_a: standard deviation of the actions at the start, as a fraction of the largest action."""
    std_end: Std = 0.2
    """sigma_a: upper limit of the actions' standard deviation at the end of the schedule, as a fraction of the largest
    action."""
    initial_weights: InitialWeights = "uniform"
    """How the weights of policy and critic are drawn at the start: uniform within 1 / sqrt(inputs of the layer), biases
    too, or orthogonal matrices times sqrt(2) with biases of 0 (Saxe et al. 2014), as most implementations of PPO have
    them."""
    restart_interval: Annotated[CountOrNone, most(1_000_000, "as many iterations as a run may have")] = 0
    """Iterations without reaching the first milestone of the task after which policy and critic start afresh, while phi
    stays: a policy can have learnt to avoid what a better design could do. With 0 they never do."""


@dataclass(frozen=True)
class ProxyFit(Settings):
    """How the proxy Hw-NN is fitted to Hw-Phy."""

    learning_rate: LearningRate = 3e-3
    """Learning rate of Adam for the proxy at the start."""
    prefit: Annotated[CountOrNone, most(100_000, "more take an hour before the first iteration")] = 500
    """Supervised steps that fit the proxy to Hw-Phy at the initial design before line 1."""
    prefit_pairs: Annotated[Count, most(65_536, "they are simulated and kept at once")] = 512
    """Pairs (s, a), spread over the workspace, in each supervised step before line 1."""
    prefit_learning_rate: LearningRate = 2e-3
    """Learning rate of Adam at the first supervised step before line 1; it falls linearly to almost 0."""
    pairs: Annotated[CountOrNone, most(1_000_000, "no rollout has more")] = 0
    """Sampled pairs (s, a) on which Eq. 2 is evaluated per iteration; 0 takes all. Each costs one step of Hw-Phy."""


@dataclass(frozen=True)
class Evaluation(Settings):
    """How often, and over how many episodes, success is measured on Hw-Phy."""

    interval: Iterations = 5
    """Iterations between two evaluations on Hw-Phy with the present phi; with each, a checkpoint is saved."""
    episodes: Annotated[Count, most(10_000, "they are simulated and kept at once")] = 128
    """Episodes per evaluation for the sampled policy, and as many for the deterministic one."""
