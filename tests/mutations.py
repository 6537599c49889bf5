"""The list of mutants: what is replaced by what in which file, and the tests of which one must then fail.

Each is a mistake that somebody could make and that raises no error. Where a line is rewritten, its mutants are, too.
"""

from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class Mutant:
    """A text that stands once in a file, and what stands there instead."""

    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    """Files or ids of tests, relative to the root."""

    def __str__(self) -> str:
        return f"{self.file}: {self.old!r} -> {self.new!r}"


def _of(file: str, tests: str, *mutations: tuple[str, str]) -> Iterator[Mutant]:
    for old, new in mutations:
        yield Mutant(file, old, new, tuple(f"tests/{test}" for test in tests.split()))


CORE = "morph_core"

MUTANTS: tuple[Mutant, ...] = (
    # --- policy and critic ---
    *_of(
        f"{CORE}/control.py", "core/test_ppo.py",
        ("torch.min(ratio * advantage, limited * advantage).mean()", "(ratio * advantage).mean()"),
        ("torch.min(ratio * advantage", "torch.max(ratio * advantage"),
        ("ratio.clamp(1 - ppo.clip_coef, ", "ratio.clamp(0, "),
        (", 1 + ppo.clip_coef)", ", 100)"),
        ("- ppo.entropy_coef * policy", "+ ppo.entropy_coef * policy"),
        ("loss = 0.5 * (value_error", "loss = 5 * (value_error"),
        ("policy.limit_std(self._schedule.geometric(ppo.std, ppo.std_end, age))", "pass"),
        ('["lr"] = self._ppo.learning_rate * factor', '["lr"] = self._ppo.learning_rate'),
        ("nn.utils.clip_grad_norm_(policy.parameters(), ppo.max_grad_norm)", "pass"),
        ("nn.utils.clip_grad_norm_(critic.parameters(), 2 * ppo", "nn.utils.clip_grad_norm_(critic.parameters(), ppo"),
        ("                self.optimizer.zero_grad()\n", ""),
        ("for _ in range(ppo.epochs)", "for _ in range(1)"),
        ("self.improve(batch, iteration - state.control_start, ", "self.improve(batch, iteration, "),
        ("return batch.advantage.numpy()", "return batch.value_target.numpy()"),
        ("next(iter(rollout.milestones", "next(reversed(rollout.milestones"),
        ("first.any(0).mean()", "first.mean()"),
        (">= REACHED", "> REACHED"),
        ("self._ppo.restart_interval <= iteration", "self._ppo.restart_interval < iteration"),
        ("0 < self._ppo.restart_interval", "0 <= self._ppo.restart_interval"),
        ("state.control_start = state.last_reached = iteration", "state.last_reached = iteration"),
        ("manual_seed(int(state.rng.integers(2**63)))", "manual_seed(0)"),
    ),
    *_of(
        f"{CORE}/control.py", "core/test_gae.py",
        (".nonzero()[0] / self._task.horizon", ".nonzero()[0]"),
        ("standard = (counted - counted.mean()) / (counted.std() + 1e-8)", "standard = counted"),
        ("(advantage + values)[alive]", "advantage[alive]"),
        ("self._ppo.gamma, self._ppo.gae_lambda", "self._ppo.gae_lambda, self._ppo.gamma"),
    ),
    *_of(
        f"{CORE}/networks.py", "core/test_ppo.py",
        ("math.log(ppo.std)", "math.log(2 * ppo.std)"),
        ("mean + self.std.numpy() * rng", "mean + rng"),
        ("rng.permutation(size)", "np.arange(size)"),
        ("(-0.5 * ((x", "(-1.0 * ((x"),
        ("self.log_std.clamp_(max=", "self.log_std.clamp_(min="),
        ("orthogonal_(self.mean[-1].weight, 0.01", "orthogonal_(self.mean[-1].weight, 1.0"),
    ),
    # --- the proxy and Eq. 2 ---
    *_of(
        f"{CORE}/hw_nn.py", "core/test_eq2.py",
        ("+ state.alpha * g_hw", "+ 1.0 * g_hw"),
        ("project(g_task, g_hw, state.projection)", 'project(g_task, g_hw, "none")'),
        ("for _ in range(ppo.epochs)", "for _ in range(1)"),
        ("state.memory.learn(features[index], target[index])", "pass"),
        ("self.optimizer.zero_grad()\n        divergence(", "divergence("),
        ("left = 1 - step / fit.prefit", "left = 1.0"),
        ('optimizer.param_groups[0]["lr"] = fit.prefit_learning_rate * left + SMALLEST_LEARNING_RATE', "pass"),
        ("sound = np.isfinite(z).all(1)", "sound = np.ones(len(z), dtype=bool)"),
        ("steps += len(z)", "steps += int(np.isfinite(z).all(1).sum())"),
        ("twin.proxy = copy.deepcopy(self.proxy)", "twin.proxy = self.proxy"),
        ("np.array(cosines) < 0", "np.array(cosines) > 0"),
        ("torch.linspace(0, len(pairs) - 1, ", "torch.linspace(0, shown_pairs - 1, "),
        ("index = shown.numpy()", "index = shown"),
        ("if norm > 0 else None", "if norm > 0 else 0.0"),
    ),
    *_of(f"{CORE}/hw_nn.py", "core/test_ppo.py", ("self._fit.learning_rate * factor", "self._fit.learning_rate")),
    *_of(
        f"{CORE}/hw_nn.py", "core/test_searches.py",
        ("self.optimizer.load_state_dict(copy.deepcopy(other.optimizer.state_dict()))", "pass"),
        ("copy.deepcopy(other.optimizer.state_dict())", "other.optimizer.state_dict()"),
        ("self.proxy.load_state_dict(other.proxy.state_dict())", "pass"),
    ),
    *_of(
        f"{CORE}/divergence.py", "core/test_eq2.py",
        ("2 * (z - target) / len(z)", "(z - target) / len(z)"),
        ("2 * (z - target) / len(z)", "2 * (z - target)"),
        ("2 * (z - target) / len(z)", "2 * (target - z) / len(z)"),
        ("squared_distance(z, target).mean(-1)", "squared_distance(z, target).sum(-1)"),
        ("((z - target) ** 2).sum(-1)", "((z - target) ** 2).mean(-1)"),
        (" if limit else difference", ""),
    ),
    *_of(
        f"{CORE}/gradients.py", "core/test_eq2.py",
        ("dot >= 0", "dot <= 0"),
        ('rule == "none" or dot', "dot"),
        ('square.sqrt() if rule == "as_printed" else square', "square"),
        ("g_task - dot /", "g_task + dot /"),
        ("g_task.norm() * g_hw.norm()", "g_task.norm()"),
        ("offset += p.numel()", "offset += 0"),
    ),
    # --- trajectories ---
    *_of(
        f"{CORE}/rollout.py", "core/test_gae.py",
        ("gamma * following * goes_on", "gamma * following"),
        ("running * goes_on", "running"),
        ("gamma * gae_lambda * running", "gamma * running"),
        ("following, goes_on = values[t], rollout.alive[t]", "following, goes_on = values[t], ~rollout.alive[t]"),
        ("(self.reward * self.alive).sum(0)", "self.reward.sum(0)"),
    ),
    *_of(
        f"{CORE}/rollout.py", "core/test_episodes.py",
        ("alive & ~transition.terminated & ~transition.diverged", "alive & ~transition.diverged"),
        ("kept & ~(transition.diverged & alive)", "kept & ~transition.diverged"),
        ("steps=int(np.sum(lives))", "steps=int(np.size(lives))"),
        ("success = stack(t.success & life", "success = stack(t.success"),
        ("successes=task.solved(success)", "successes=success.any(0)"),
    ),
    *_of(
        f"{CORE}/rollout.py", "core/test_lines.py",
        ("self.successes.sum() / self.episodes", "self.successes.sum() / len(self.successes)"),
        ("self.kept.sum() > 1", "self.kept.sum() > 0"),
    ),
    *_of(
        f"{CORE}/episodes.py", "core/test_episodes.py",
        ("task.solved(reached & rollout.alive)", "task.solved(reached)"),
        (".sum() / episodes)", ".mean())"),
        ("rng if sampled else None", "rng"),
        ("rollout.s[steps, episode] if steps < len(rollout.s) else rollout.last_s[episode]", "rollout.last_s[episode]"),
    ),
    # --- explorations ---
    *_of(
        f"{CORE}/exploration.py", "core/test_pull.py",
        ("if 0 < pairs < len(row)", "if pairs < 0"),
        ("np.sort(rng.choice(row, pairs, replace=False))", "np.arange(pairs)"),
        ("np.sort(rng.choice(row, pairs, replace=False))", "np.sort(rng.choice(row, pairs))"),
        ("return Relabelled(row[sound]", "return Relabelled(row[: sound.sum()]"),
        ("z_phi[sound], len(row))", "z_phi[sound], int(sound.sum()))"),
        ("policy.act(observation, state.rng)", "policy.act(observation, None)"),
    ),
    *_of(
        f"{CORE}/explorations/design.py", "core/test_pull.py",
        ("slope = -self.kappa", "slope = self.kappa"),
        ("self.z_sigma**2 * weight", "self.z_sigma * weight"),
        ("limited(pairs.z - pairs.z_phi, self.drift_clip)", "(pairs.z - pairs.z_phi)"),
        ("limited(pairs.z - pairs.z_phi, self.drift_clip)", "limited(pairs.z, self.drift_clip)"),
        ("gradient[index] / np.float32(len(m))", "gradient[index]"),
        ("[pairs.episode]", "[::-1][pairs.episode]"),
        ("self.advantage(rollout.returns)", "(rollout.returns - rollout.returns.mean())"),
    ),
    *_of(
        f"{CORE}/explorations/gaussian.py", "core/test_pull.py",
        ("ratio.clamp(1 - self.clip_coef, 1 + self.clip_coef)", "ratio"),
        ("loss = -torch.min(", "loss = torch.min("),
        ("loss = -torch.min(", "loss = -torch.max("),
        ("advantage[pairs.row]", "advantage[: len(pairs)]"),
        ("self.sigma * self.rng", "self.rng"),
        ("log_before[index]", "log_before"),
        ("log_ratio.clamp(-LARGEST_LOG_RATIO, LARGEST_LOG_RATIO)", "log_ratio"),
        ("if not task.runs_on_proxy", "if False"),
    ),
    *_of(
        f"{CORE}/spread.py", "core/test_spread.py",
        ("np.concatenate([half, -half])", "np.concatenate([half, half])"),
        ("np.sqrt(1 - self.correlation) * noise", "(1 - self.correlation) * noise"),
        ("np.sqrt(self.correlation) * common", "self.correlation * common"),
        ("self.sigma * space.scale * np", "self.sigma * np"),
        ("space.clip(state.phi + self.sigma", "(state.phi + self.sigma"),
        ("0.0 if frozen else sigma", "sigma"),
        ("iteration, self.hold)", "iteration)"),
        ("returns.std(ddof=1)", "returns.std()"),
        ("-limit, limit)", "-np.inf, limit)"),
        ("rank = (-returns)", "rank = returns"),
        ("np.log(len(returns) / 2 + 1)", "np.log(len(returns) + 1)"),
        ("target = (phi + target) / 2", "target = phi"),
    ),
    *_of(
        f"{CORE}/parts.py", "core/test_spread.py",
        ("min(1.0, (iteration - 1)", "min(1.0, iteration"),
        ("return min(1.0, (iteration - 1) / max(1, self.iterations - 1))",
         "return (iteration - 1) / max(1, self.iterations - 1)"),
        (" / max(1e-9, 1 - hold)", ""),
        ("1 - (1 - last) * self", "1 - last * self"),
    ),
    *_of(
        f"{CORE}/design.py", "core/test_spread.py",
        ("np.where(np.isnan(locked), inside, locked)", "inside"),
        ("inside = np.clip(phi, self.lo, self.hi)", "inside = phi"),
    ),
    # --- searches ---
    *_of(
        f"{CORE}/search.py", "core/test_searches.py",
        ("state.memory.phi_was_found(state.hw_nn)", "pass"),
        ("np.argmin(costs)", "np.argmax(costs)"),
        ("phi = space.clip(state.phi)", "phi = state.phi"),
        ("state.relabelled_steps += physics.steps", "pass"),
        ("[nearest_buildable(task, phi, candidate) for candidate", "[candidate for candidate"),
        ("square[sound].max() if sound.any() else np.inf", "np.inf"),
        ("Dataset(s, a, hw_nn(s, a))", "Dataset(s, a, rollout.z[t[chosen], n[chosen]])"),
        ("if space.free.any()", "if True"),
        ("np.repeat(candidates, pairs, 0)", "np.tile(candidates, (pairs, 1))"),
        ("self.steps += count * pairs", "self.steps += count"),
    ),
    *_of(
        f"{CORE}/searches/cma.py", "core/test_searches.py",
        ("problem.start[free] / scale, self.sigma0", "space.initial[free] / scale, self.sigma0"),
        ("/ scale, self.sigma0, options", "/ scale, 0.1, options"),
        ("free_entries * scale", "free_entries"),
        ("self.population * self.generations", "self.population"),
        ('"seed": problem.seed', '"seed": 1'),
        ('"maxiter": self.generations', '"maxiter": 20'),
        ("np.stack([problem.start, self._best(problem)])", "np.stack([self._best(problem), problem.start])"),
    ),
    *_of(
        f"{CORE}/searches/gradient.py", "core/test_searches.py",
        ("step = 1 / max(", "step = 0.5 / max("),
        ("problem.space.clip(phi - step * gradient)", "phi - step * gradient"),
        ("problem.space.clip(phi - step * gradient)", "problem.space.clip(phi + step * gradient)"),
        ("np.linalg.eigvalsh(curvature)[-1]", "np.linalg.eigvalsh(curvature)[0]"),
    ),
    *_of(
        f"{CORE}/searches/drift.py", "core/test_searches.py",
        ("np.maximum(values, ridge + 1e-12)", "np.maximum(values, 1e-12)"),
        ("limited(problem.memory.drift(dataset), self.drift_clip)", "problem.memory.drift(dataset)"),
        ("limited(np.nan_to_num(z[: len(noise)] - z[len(noise) :]) / 2, self.drift_clip)",
         "np.nan_to_num(z[: len(noise)] - z[len(noise) :]) / 2"),
        ("np.nan_to_num(z[: len(noise)] - z[len(noise) :])", "(z[: len(noise)] - z[len(noise) :])"),
        ("z[len(noise) :]) / 2", "z[len(noise) :])"),
        ("(first.T @ second + second.T @ first) / 2", "first.T @ first"),
        ("(first + second).T @ drift.ravel() / 2", "(first + second).T @ drift.ravel()"),
        ("step *= min(1.0, self.limit", "step *= min(1.0, 100 * self.limit"),
        ("(whiten @ step)", "step"),
        ("(spread.sigma * space.scale)[free] * (", "("),
        ("change = (change / unit).reshape", "change = change.reshape"),
        ("dataset.z - self.reference(", "dataset.z + self.reference("),
        ("self.reference.copy_weights(hw_nn)", "pass"),
        ("hw_nn.copy_moments(self.reference)", "pass"),
        ("hw_nn.copy_weights(self.reference)", "pass"),
        ("self.reference.learn(features, target)", "pass"),
        ("correlation * (1 - np.eye(", "0 * (1 - np.eye("),
        ("Twin(copy.deepcopy(hw_nn))", "Twin(hw_nn)"),
    ),
    # --- iterations, and what lives between them ---
    *_of(
        f"{CORE}/morph.py", "core/test_lines.py",
        ("itertools.count(state.iteration + 1)", "itertools.count(1)"),
        ("if iteration % config.design_interval == 0", "if state.iteration % config.design_interval == 0"),
        (" and not state.frozen", ""),
        ("iteration, state.frozen)", "iteration, False)"),
        ("state.relabelled_steps += pairs.steps", "pass"),
        ("relabel(rollout, state.hw_nn,", "relabel(rollout, hw_phy,"),
        ("alpha=state.alpha", "alpha=config.alpha"),
        ("projection=state.projection", "projection=config.projection"),
        ("config.freeze_success,\n            design_sigma", "0.0,\n            design_sigma"),
        ("state.set_learning_rates(config, iteration)", "pass"),
        ("if not rollout.holds_enough or not len(", "if not len("),
    ),
    *_of(
        f"{CORE}/methods/direct.py", "core/test_lines.py",
        ("self.step * step", "step"),
        ("state.phi + self.step", "state.phi - self.step"),
        ("state.phi = nearest_buildable(task, state.phi, target)", "state.phi = target"),
        ("state.design_space.clip(state.phi + self.step * step)", "(state.phi + self.step * step)"),
        ("designs[rollout.kept]", "designs[: rollout.kept.sum()]"),
        ("self.freeze_success, design_sigma", "0.0, design_sigma"),
    ),
    *_of(
        f"{CORE}/methods/no_hw_opt.py", "core/test_lines.py",
        ("state.control.learn(state, rollout, iteration)", "pass"),
        ("if rollout.holds_enough", "if True"),
    ),
    *_of(
        f"{CORE}/state.py", "core/test_lines.py",
        ("0 < freeze_success <= rollout", "0 < freeze_success < rollout"),
        ("self.frozen = self.frozen or 0", "self.frozen = 0"),
        ("self.diverged += rollout.diverged", "self.diverged = rollout.diverged"),
        ("self.env_steps += rollout.steps", "self.env_steps = rollout.steps"),
        ("| dict(self.memory.learners)", ""),
    ),
    *_of(
        f"{CORE}/state.py", "core/test_ppo.py",
        ("set_learning_rate(iteration - self.control_start)", "set_learning_rate(iteration)"),
    ),
    *_of(
        f"{CORE}/state.py", "core/test_eq2.py",
        ("self.memory.proxy_was_fitted(self.hw_nn)", "pass"),
        ("            self.fitted = True", "            pass"),
        ("self.relabelled_steps += self.hw_nn.fit", "self.relabelled_steps = self.hw_nn.fit"),
    ),
    *_of(
        f"{CORE}/checkpoint.py", "core/test_checkpoint_fields.py",
        ('state.control_start, state.last_reached = facts["control_start"], facts["last_reached"]',
         'state.control_start = facts["control_start"]'),
        ('state.control_start, state.last_reached = facts["control_start"], facts["last_reached"]',
         'state.last_reached = facts["last_reached"]'),
        ('state.fitted, state.frozen = facts["fitted"], facts["frozen"]', 'state.fitted = facts["fitted"]'),
        ('state.fitted, state.frozen = facts["fitted"], facts["frozen"]', 'state.frozen = facts["frozen"]'),
        ('state.alpha, state.projection = facts["alpha"], facts["projection"]', 'state.alpha = facts["alpha"]'),
        ('state.alpha, state.projection = facts["alpha"], facts["projection"]',
         'state.projection = facts["projection"]'),
        ('state.rng.bit_generator.state = facts["rng"]', "pass"),
        ('"diverged": state.diverged', '"diverged": 0'),
        ('"relabelled_steps": state.relabelled_steps', '"relabelled_steps": 0'),
        ('start(task, method, 0, space)', "start(task, method, 0)"),
        ('optimizer.load_state_dict({**optimizer.state_dict(), "state": moments})', "pass"),
    ),
    # --- what users change ---
    *_of(
        f"{CORE}/edits.py", "core/test_steered.py",
        ("alpha=float(alpha))", "alpha=in_force.alpha)"),
        ("(in_force, projection=rule)", "(in_force, projection=in_force.projection)"),
        ("inside = space.clip(phi)", "inside = phi"),
        ("task.check_buildable(inside)", "pass"),
        ("space=space, phi=inside", "phi=inside"),
        ("return Edit(moved, message, True)", "return Edit(moved, message, False)"),
        ("space.without_lock(name), phi)", "space, phi)"),
        ("if value is None else value", "if value is None else float(phi[0])"),
    ),
    *_of(
        f"{CORE}/edits.py", "core/test_edits.py::test_a_design_against_a_lock_is_refused_and_one_on_it_is_taken",
        ("_check_locks(space, space.check(given))", "space.check(given)"),
    ),
    *_of(
        f"{CORE}/train.py", "core/test_train.py::test_what_is_acknowledged_is_in_a_checkpoint_before_the_word",
        ("accepted and isinstance(order.command, _SAVED_AFTER)", "False"),
    ),
    *_of(
        f"{CORE}/train.py", "core/test_train.py::test_an_edit_of_the_design_lets_a_frozen_search_go_on",
        ("state.frozen = state.frozen and not edit.concerns_design", "pass"),
    ),
    *_of(
        f"{CORE}/train.py", "core/test_steered.py",
        ("state.frozen and not edit.concerns_design", "False"),
        ("state.fitted = state.fitted and bool(np.array_equal(after.phi, state.phi))", "pass"),
        ("= after.space, after.phi, after.alpha, after.projection",
         "= after.space, after.phi, after.alpha, state.projection"),
        ("= after.space, after.phi, after.alpha, after.projection",
         "= after.space, after.phi, state.alpha, after.projection"),
    ),
    *_of(
        f"{CORE}/history.py", "core/test_history.py",
        ("sorted(before, key=lambda e: e.seq)", "before"),
        ("(e for e in self._changes if e.iteration < iteration)", "(e for e in self._changes)"),
        ("self._changes = [e for e in self._changes if e.iteration <= iteration]", "pass"),
        ("if event.accepted:", "if True:"),
        ("alpha = before.alpha if alpha is None else alpha", "pass"),
        ("space=space, phi=space.clip(before.phi)", "space=space"),
    ),
    *_of(
        "studio/viewer/steer.py",
        "studio/test_viewer.py::test_steering_sends_only_what_was_changed "
        "studio/test_viewer.py::test_what_somebody_types_into_the_steering_form_stays_until_something_changes",
        ("if alpha != in_force[0] else []", ""),
        ("if in_force != self._in_force", "if True"),
    ),
    # --- environments ---
    *_of(
        f"{CORE}/envs/episodes.py",
        "core/test_envs.py::test_an_episode_ends_at_the_horizon_and_neither_before_nor_after",
        ("self._steps >= self._limit", "self._steps > self._limit"),
        ("self._steps >= self._limit", "self._steps >= self._limit - 1"),
    ),
    *_of(
        f"{CORE}/envs/episodes.py", "core/test_envs.py::test_physics_that_fails_truncates_and_says_so",
        ("(diverged | (self._steps >= self._limit))", "(self._steps >= self._limit)"),
        ("transition.terminated & ~diverged", "transition.terminated"),
        ("np.where(diverged[:, None], before, transition.s)", "transition.s"),
        ("np.where(diverged, 0.0, transition.reward)", "transition.reward"),
        ('"diverged": diverged', '"diverged": diverged & False'),
    ),
    *_of(
        f"{CORE}/envs/episodes.py", "core/test_restarts.py",
        ("self._steps[chosen], self._begun[chosen], self._ended[chosen] = 0, True, False",
         "self._begun[chosen], self._ended[chosen] = True, False"),
    ),
    *_of(
        f"{CORE}/envs/vector.py",
        "core/test_envs.py::test_the_vector_environment_is_sync_vector_env_over_episodes_that_restart[reacher]",
        ("np.where(restarted, 0.0, outcome.reward)", "outcome.reward"),
        ("outcome.truncated & ~restarted", "outcome.truncated"),
    ),
    *_of(
        f"{CORE}/envs/arguments.py",
        "core/test_envs.py::test_the_vector_environment_is_sync_vector_env_over_episodes_that_restart[reacher]",
        ("first + i for i in", "first for i in"),
    ),
    # --- what a browser may say ---
    *_of(
        "studio/bridge.py", "studio/test_bridge.py::test_a_number_that_is_none_is_dropped_wherever_it_stands",
        (" or not _is_finite(content)", ""),
        ("all(_is_finite(item) for item in value.values())", "True"),
        ("return all(_is_finite(item) for item in value)\n", "return True\n"),
    ),
    *_of(
        "studio/bridge.py", "studio/test_bridge.py::test_only_allowed_kinds_are_admitted",
        ('content.get("type") not in ALLOWED | UPLOADS', '"type" not in content'),
    ),
    *_of(
        "studio/bridge.py",
        "studio/test_bridge.py::test_what_a_viewer_does_not_need_is_dropped_and_the_connection_lives",
        ('isinstance(updates, dict) and set(updates) <= {"value"}', "isinstance(updates, dict)"),
    ),
)  # fmt: skip
