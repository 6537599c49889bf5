"""The parts that methods are composed of: the schedule, PPO, the proxy's fit, and the evaluations."""

from dataclasses import dataclass

from morph_core.config import Count, CountOrNone, Fraction, NotNegative, Positive, Settings


@dataclass(frozen=True)
class Schedule(Settings):
    """How learning rates and noises fall over the iterations."""

    iterations: Count = 100
    """Iterations over which learning rates and noises are annealed; constant afterwards."""

    def share(self, iteration: int) -> float:
        """Return how much of the schedule is over, in [0, 1]; iterations count from 1."""
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
    """Discount per control step."""
    gae_lambda: Fraction = 0.95
    """lambda of generalised advantage estimation."""
    clip_coef: Positive = 0.2
    """PPO's clip of the probability ratio of actions."""
    epochs: Count = 5
    """Passes over the rollout per iteration, the proxy's too."""
    minibatches: Count = 8
    """Gradient steps per pass, the proxy's too."""
    learning_rate: Positive = 1e-3
    """Adam's step for policy and critic at the start."""
    learning_rate_end: Fraction = 0.3
    """Final learning rates, the proxy's too, as a fraction of the first ones."""
    max_grad_norm: Positive = 0.5
    """Largest norm of the policy's gradient; the critic's may be twice as large."""
    entropy_coef: NotNegative = 0.0
    """Weight of the policy's entropy bonus."""
    std: Positive = 0.5
    """sigma_a at the start, as a fraction of the largest action."""
    std_end: Positive = 0.2
    """Upper limit of sigma_a at the end of the schedule."""
    restart_interval: CountOrNone = 0
    """Iterations without reaching the first milestone of the task after which policy and critic start afresh, phi
    stays: a policy can have learnt to avoid what a better design could do. 0: never."""


@dataclass(frozen=True)
class ProxyFit(Settings):
    """How the proxy Hw-NN is fitted to Hw-Phy."""

    learning_rate: Positive = 3e-3
    """Adam's step for the proxy at the start."""
    prefit: CountOrNone = 500
    """Supervised steps that fit the proxy to Hw-Phy at the initial design before line 1."""
    prefit_pairs: Count = 512
    """Pairs (s, a), spread over the workspace, of each of these steps."""
    prefit_learning_rate: Positive = 2e-3
    """Adam's step for them at the start; it falls linearly to almost 0."""
    pairs: CountOrNone = 0
    """Sampled (s, a) on which Eq. 2 is evaluated per iteration; 0 means all. Each costs one step of Hw-Phy."""


@dataclass(frozen=True)
class Evaluation(Settings):
    """How often, and over how many episodes, success is measured on Hw-Phy."""

    interval: Count = 5
    """Iterations between two evaluations on Hw-Phy with the present phi; each is also a checkpoint."""
    episodes: Count = 128
    """Episodes per evaluation for the sampled policy, and as many for the deterministic one."""
