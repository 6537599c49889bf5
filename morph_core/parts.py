"""The parts that methods are composed of: the schedule, PPO, the proxy's fit, and the evaluations."""

from dataclasses import dataclass

from morph_core.config import Count, CountOrNone, Fraction, InitialWeights, NotNegative, Positive, Settings


@dataclass(frozen=True)
class Schedule(Settings):
    """How learning rates and noises fall over the iterations."""

    iterations: Count = 100
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
    clip_coef: Positive = 0.2
    """PPO's clip of the probability ratio of actions."""
    epochs: Count = 5
    """Passes over the rollout per iteration, for the proxy too."""
    minibatches: Count = 8
    """Gradient steps per pass over the rollout, for the proxy too."""
    learning_rate: Positive = 1e-3
    """Learning rate of Adam for policy and critic at the start."""
    learning_rate_end: Fraction = 0.3
    """Learning rates at the end of the schedule, the proxy's too, as a fraction of the first ones."""
    max_grad_norm: Positive = 0.5
    """Largest norm of the policy's gradient; the critic's may be twice as large."""
    entropy_coef: NotNegative = 0.0
    """Weight of the policy's entropy bonus."""
    std: Positive = 0.5
    """sigma_a: standard deviation of the actions at the start, as a fraction of the largest action."""
    std_end: Positive = 0.2
    """sigma_a: upper limit of the actions' standard deviation at the end of the schedule, as a fraction of the largest
    action."""
    initial_weights: InitialWeights = "uniform"
    """How the weights of policy and critic are drawn at the start: uniform within 1 / sqrt(inputs of the layer), biases
    too, or orthogonal matrices times sqrt(2) with biases of 0 (Saxe et al. 2014), as most implementations of PPO have
    them."""
    restart_interval: CountOrNone = 0
    """Iterations without reaching the first milestone of the task after which policy and critic start afresh, while phi
    stays: a policy can have learnt to avoid what a better design could do. With 0 they never do."""


@dataclass(frozen=True)
class ProxyFit(Settings):
    """How the proxy Hw-NN is fitted to Hw-Phy."""

    learning_rate: Positive = 3e-3
    """Learning rate of Adam for the proxy at the start."""
    prefit: CountOrNone = 500
    """Supervised steps that fit the proxy to Hw-Phy at the initial design before line 1."""
    prefit_pairs: Count = 512
    """Pairs (s, a), spread over the workspace, in each supervised step before line 1."""
    prefit_learning_rate: Positive = 2e-3
    """Learning rate of Adam at the first supervised step before line 1; it falls linearly to almost 0."""
    pairs: CountOrNone = 0
    """Sampled pairs (s, a) on which Eq. 2 is evaluated per iteration; 0 takes all. Each costs one step of Hw-Phy."""


@dataclass(frozen=True)
class Evaluation(Settings):
    """How often, and over how many episodes, success is measured on Hw-Phy."""

    interval: Count = 5
    """Iterations between two evaluations on Hw-Phy with the present phi; with each, a checkpoint is saved."""
    episodes: Count = 128
    """Episodes per evaluation for the sampled policy, and as many for the deterministic one."""
