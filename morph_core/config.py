"""Every number the paper leaves open, in one frozen record that is command line, web form and provenance."""

import dataclasses
import math
import typing
from dataclasses import dataclass
from typing import Literal

Method = Literal["morph", "no_hw_opt", "direct"]
Projection = Literal["none", "one_sided", "as_printed"]
Exploration = Literal["design", "gaussian"]
Search = Literal["cma", "gradient", "drift"]
Utility = Literal["standardised", "log_rank"]


@dataclass(frozen=True)
class Config:
    """The settings of a run, whatever its method; METHOD names are the paper's symbols."""

    trajectories: int = 128
    """H: episodes sampled per iteration, one design each under `exploration=design`; even."""
    design_interval: int = 1
    """K: iterations between two searches for phi."""
    alpha: float = 1.0
    """alpha: weight of the divergence between proxy and Hw-Phy in Eq. 2."""
    projection: Projection = "none"
    """What happens to g_task where it conflicts with g_hw: the rule of the gradient projection."""
    exploration: Exploration = "design"
    """How z is explored: designs drawn around phi on Hw-Phy, or the paper's Gaussian noise on the proxy's z."""
    search: Search = "cma"
    """How phi is searched for (Eq. 3): CMA-ES on the divergence, its gradient where Hw-Phy is differentiable, or
    least squares on the drift that the task asks of the proxy, where contact makes the divergence rough."""
    schedule_iterations: int = 100
    """Iterations over which learning rates and noises are annealed; constant afterwards."""
    schedule_hold: float = 0.0
    """Share of the schedule for which the explored designs keep their first Sigma."""

    gamma: float = 0.98
    """Discount per control step."""
    gae_lambda: float = 0.95
    """lambda of generalised advantage estimation."""
    clip_coef: float = 0.2
    """PPO's clip of the probability ratio of actions."""
    epochs: int = 5
    """Passes over the rollout per iteration."""
    minibatches: int = 8
    """Gradient steps per pass."""
    learning_rate: float = 1e-3
    """Adam's step for policy and critic at the start."""
    learning_rate_end: float = 0.3
    """Final learning rates, as a fraction of the first ones."""
    max_grad_norm: float = 0.5
    """Largest norm of the policy's gradient; the critic's may be twice as large."""
    entropy_coef: float = 0.0
    """Weight of the policy's entropy bonus."""
    hidden: int = 64
    """Width of both hidden layers of policy, critic and proxy."""
    policy_std: float = 0.5
    """sigma_a at the start, as a fraction of the largest action."""
    policy_std_end: float = 0.2
    """Upper limit of sigma_a at the end of the schedule."""

    proxy_learning_rate: float = 3e-3
    """Adam's step for the proxy Hw-NN at the start."""
    proxy_prefit: int = 500
    """Supervised steps that fit the proxy to Hw-Phy at the initial design before line 1."""
    kappa: float = 0.3
    """Weight of the task's pull on the proxy under `exploration=design`."""
    z_sigma: float = 0.5
    """sigma_z: scale of the exploration of z under `exploration=design`, in units of z."""
    z_noise: float = 0.1
    """Standard deviation of z around the proxy's output under `exploration=gaussian`, in units of z."""
    z_clip_coef: float = 0.6
    """PPO's clip of the probability ratio of z under `exploration=gaussian`."""
    proxy_pairs: int = 0
    """Sampled (s, a) on which Eq. 2 is evaluated per iteration; 0 means all. Each costs one step of Hw-Phy."""
    utility: Utility = "standardised"
    """What an episode's return counts before it pulls on proxy or phi: standardised, or CMA-ES's weights by rank."""
    advantage_limit: float = 3.0
    """Standardised returns beyond this are clipped."""
    design_correlation: float = 0.0
    """Share of the variance of the explored designs that the parameters of a group have in common."""
    restart_interval: int = 0
    """Iterations without reaching the first milestone of the task after which policy and critic start afresh, phi
    stays: a policy can have learnt to avoid what a better design could do. 0: never."""
    design_sigma: float = 1.2
    """Sigma of the designs drawn around phi at the start, in units of each parameter's scale."""
    design_sigma_end: float = 0.2
    """The same at the end of the schedule (geometric in between)."""
    freeze_success: float = 0.0
    """Once this share of an iteration's trajectories succeeds, phi stays and every episode runs on it: ranks of equally
    good episodes are noise, in which phi would drift while the policy could settle on one design. 0: never."""
    direct_step: float = 1.5
    """Step of the natural evolution strategy of the method `direct`."""

    search_pairs: int = 512
    """Relabelled (s, a) pairs on which a candidate phi is compared with the proxy."""
    search_population: int = 12
    """Candidates per generation of CMA-ES."""
    search_generations: int = 20
    """Generations of CMA-ES per search."""
    search_sigma: float = 0.1
    """sigma0 of CMA-ES in units of each parameter's scale."""
    drift_clip: float = 0.0
    """Differences between two designs' z count up to this, in units of z: what is larger is a state of one design in
    which the other touches or penetrates something. 0: no limit."""
    drift_designs: int = 24
    """Designs, in antithetic pairs, over which `search=drift` averages dz/dphi; a multiple of 4."""
    drift_ridge: float = 0.2
    """Ridge of its least squares, as a share of the mean curvature."""
    drift_limit: float = 1.5
    """Its longest step, in units of the explored Sigma."""

    evaluation_interval: int = 5
    """Iterations between two evaluations on Hw-Phy with the present phi; each is also a checkpoint."""
    evaluation_episodes: int = 128
    """Episodes per evaluation for the sampled policy, and as many for the deterministic one."""

    def __post_init__(self) -> None:
        check_config(self)


_AT_LEAST_ONE = {
    "trajectories", "design_interval", "schedule_iterations", "epochs", "minibatches", "hidden", "search_pairs",
    "search_generations", "evaluation_interval", "evaluation_episodes", "drift_designs",
}  # fmt: skip
_MAY_BE_ZERO = {
    "alpha", "entropy_coef", "proxy_prefit", "kappa", "direct_step", "proxy_pairs", "schedule_hold",
    "restart_interval", "drift_clip", "freeze_success",
    "design_correlation", "drift_ridge",
}  # fmt: skip
_SHARES = {"schedule_hold", "design_correlation", "freeze_success"}
_FRACTIONS = {"gamma", "gae_lambda", "learning_rate_end"}


def check_config(config: Config) -> None:
    """Raise ValueError with a sentence that names the field and what is allowed."""
    for field in dataclasses.fields(config):
        check_field(field.name, getattr(config, field.name))
    if config.trajectories % 2:
        raise ValueError(f"trajectories must be even (antithetic pairs of designs), not {config.trajectories}")
    if config.drift_designs % 4:
        raise ValueError(f"drift_designs must be a multiple of 4 (two halves of pairs), not {config.drift_designs}")
    if config.search_population < 4:
        raise ValueError(f"search_population must be at least 4, not {config.search_population}")


def check_field(name: str, value: object) -> None:
    """Raise ValueError unless `value` is allowed for the config field `name`."""
    kinds = typing.get_type_hints(Config)
    if name not in kinds:
        raise ValueError(f'unknown config field "{name}"; choose from: {", ".join(sorted(kinds))}')
    choices = typing.get_args(kinds[name])
    if choices:
        if value not in choices:
            raise ValueError(f'unknown {name} "{value}"; choose from: {", ".join(choices)}')
        return
    if isinstance(value, bool) or not isinstance(value, int if kinds[name] is int else int | float):
        raise ValueError(f"{name} must be {'a whole number' if kinds[name] is int else 'a number'}, not {value!r}")
    if not math.isfinite(value):
        raise ValueError(f"{name} must be finite, not {value}")
    if name in _AT_LEAST_ONE and value < 1:
        raise ValueError(f"{name} must be at least 1, not {value}")
    if name in _MAY_BE_ZERO and value < 0:
        raise ValueError(f"{name} must not be negative, not {value}")
    if name in _FRACTIONS and not 0 < value <= 1:
        raise ValueError(f"{name} must lie in (0, 1], not {value}")
    if name in _SHARES and value > 1:
        raise ValueError(f"{name} must lie in [0, 1], not {value}")
    if name not in _MAY_BE_ZERO and value <= 0:
        raise ValueError(f"{name} must be positive, not {value}")


def config_from(settings: dict[str, object], defaults: Config | None = None) -> Config:
    """Return `defaults` with `settings` applied; unknown names and bad values raise ValueError."""
    for name, value in settings.items():
        check_field(name, value)
    kinds = typing.get_type_hints(Config)
    cast = {k: float(v) if kinds[k] is float else v for k, v in settings.items()}  # pyright: ignore[reportArgumentType]
    return dataclasses.replace(defaults or Config(), **cast)
