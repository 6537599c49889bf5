"""Format 1 of run.json, in which a run's settings were one flat list: old names -> new ones."""

from collections.abc import Mapping

RENAMED: Mapping[str, tuple[str, ...]] = {
    "schedule_iterations": ("schedule.iterations",),
    "gamma": ("ppo.gamma",),
    "gae_lambda": ("ppo.gae_lambda",),
    "clip_coef": ("ppo.clip_coef",),
    "epochs": ("ppo.epochs",),
    "minibatches": ("ppo.minibatches",),
    "learning_rate": ("ppo.learning_rate",),
    "learning_rate_end": ("ppo.learning_rate_end",),
    "max_grad_norm": ("ppo.max_grad_norm",),
    "entropy_coef": ("ppo.entropy_coef",),
    "policy_std": ("ppo.std",),
    "policy_std_end": ("ppo.std_end",),
    "restart_interval": ("ppo.restart_interval",),
    "proxy_learning_rate": ("proxy.learning_rate",),
    "proxy_prefit": ("proxy.prefit",),
    "proxy_pairs": ("proxy.pairs",),
    "design_sigma": ("exploration.sigma", "designs.sigma"),
    "design_sigma_end": ("exploration.sigma_end", "designs.sigma_end"),
    "schedule_hold": ("exploration.hold", "designs.hold"),
    "design_correlation": ("exploration.correlation", "designs.correlation"),
    "utility": ("exploration.utility", "designs.utility"),
    "advantage_limit": ("exploration.advantage_limit", "designs.advantage_limit"),
    "kappa": ("exploration.kappa",),
    "z_sigma": ("exploration.z_sigma",),
    "z_noise": ("exploration.noise",),
    "z_clip_coef": ("exploration.clip_coef",),
    "drift_clip": ("exploration.drift_clip", "search.drift_clip"),
    "search_pairs": ("search.pairs",),
    "search_population": ("search.population",),
    "search_generations": ("search.generations",),
    "search_sigma": ("search.sigma0",),
    "drift_designs": ("search.designs",),
    "drift_ridge": ("search.ridge",),
    "drift_limit": ("search.limit",),
    "direct_step": ("step",),
    "evaluation_interval": ("evaluation.interval",),
    "evaluation_episodes": ("evaluation.episodes",),
}
"""Names that are the same in both formats are not listed: trajectories, hidden, alpha, projection, design_interval,
freeze_success, exploration, search."""


def translated(config: Mapping[str, object]) -> dict[str, object]:
    """Return settings of format 1 under today's dotted names, for every method, exploration and search at once.

    Format 1 recorded all of them, whether they did something or not.
    """
    renamed = {new: value for old, value in config.items() for new in RENAMED.get(old, (old,))}
    if renamed.get("exploration") == "gaussian":
        renamed["exploration"] = "gaussian_iid"  # which had the name then
    return renamed
