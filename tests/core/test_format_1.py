"""Runs that were recorded while settings were one flat list open, evaluate and go on as they did then."""

import dataclasses
import json
import shutil
import time
from pathlib import Path
from typing import Any

import pytest
import torch

from morph_core.catalogue import METHODS, configured, make_task, read_method
from morph_core.config import paths_of
from morph_core.evaluate import evaluate_run
from morph_core.explorations.design import Design
from morph_core.explorations.gaussian_iid import GaussianIid
from morph_core.format_1 import RENAMED, translated
from morph_core.history import History
from morph_core.method import Method
from morph_core.methods.direct import Direct
from morph_core.methods.no_hw_opt import NoHwOpt
from morph_core.methods.proxy import Morph
from morph_core.parts import Evaluation, Ppo, ProxyFit, Schedule
from morph_core.protocol import RunRecord
from morph_core.run_folder import RunFolder, create_run, read_episode
from morph_core.searches.cma import Cma
from morph_core.searches.drift import Drift
from morph_core.spread import ExploredDesigns
from tests.forked import trainer

RECORDED = Path(__file__).parents[1] / "data" / "format_1"
RECORDED_WITH = "AVX512"
"""The vector instructions of the processor that made the runs: with others, torch sums in another order."""

OLD_DEFAULTS: dict[str, Any] = {
    "trajectories": 128, "design_interval": 1, "alpha": 1.0, "projection": "none", "exploration": "design",
    "search": "cma", "schedule_iterations": 100, "schedule_hold": 0.0, "gamma": 0.98, "gae_lambda": 0.95,
    "clip_coef": 0.2, "epochs": 5, "minibatches": 8, "learning_rate": 1e-3, "learning_rate_end": 0.3,
    "max_grad_norm": 0.5, "entropy_coef": 0.0, "hidden": 64, "policy_std": 0.5, "policy_std_end": 0.2,
    "proxy_learning_rate": 3e-3, "proxy_prefit": 500, "kappa": 0.3, "z_sigma": 0.5, "z_noise": 0.1, "z_clip_coef": 0.6,
    "proxy_pairs": 0, "utility": "standardised", "advantage_limit": 3.0, "design_correlation": 0.0,
    "restart_interval": 0, "design_sigma": 1.2, "design_sigma_end": 0.2, "freeze_success": 0.0, "direct_step": 1.5,
    "search_pairs": 512, "search_population": 12, "search_generations": 20, "search_sigma": 0.1, "drift_clip": 0.0,
    "drift_designs": 24, "drift_ridge": 0.2, "drift_limit": 1.5, "evaluation_interval": 5, "evaluation_episodes": 128,
}  # fmt: skip
"""Every field that settings had in format 1."""
ONCE_FIXED = {
    "proxy.prefit_pairs": 512, "proxy.prefit_learning_rate": 2e-3, "search.steps": 200, "search.groups": 1,
    "exploration.finish": "policy_and_proxy", "ppo.initial_weights": "uniform",
}  # fmt: skip
"""What could not be set in format 1 -> what it was."""

_TINY: dict[str, Any] = {
    "trajectories": 8, "hidden": 8, "schedule": Schedule(iterations=6), "evaluation": Evaluation(2, 4),
}  # fmt: skip
_PPO = Ppo(epochs=2, minibatches=2)


@dataclasses.dataclass(frozen=True)
class Resumed:
    """A recorded run, and what the code that recorded it made of one further iteration."""

    method: Method
    """Its settings."""
    iteration: int
    """Its last one."""
    phi: list[str]
    """After one further iteration."""
    episode_return: str
    """In that iteration."""
    sampled: str
    """Return of the recorded policy over four episodes."""
    deterministic: str
    """The same, deterministic."""


RUNS = {
    "reacher-morph": Resumed(
        Morph(
            **_TINY,
            ppo=dataclasses.replace(_PPO, gamma=0.95),
            projection="one_sided",
            proxy=ProxyFit(prefit=20, pairs=100),
            exploration=GaussianIid(noise=0.2, clip_coef=0.5),
            search=Cma(pairs=32, population=6, generations=3, sigma0=0.2),
        ),
        4,
        [
            "0x1.1eca685544103p+0", "0x1.65e0a12f90c2fp-4", "0x1.99a7ad0d6e985p-1", "0x1.2dcdca8bd13d0p+1",
            "0x1.4000000000000p+1",
        ],
        "-0x1.652e74fcda76ep+3",
        "-0x1.7fffffffffffap+3",
        "-0x1.7fffffffffffap+3",
    ),
    "reacher-direct": Resumed(
        Direct(
            **_TINY,
            ppo=_PPO,
            step=1.0,
            designs=ExploredDesigns(sigma=0.8, sigma_end=0.4, hold=0.5, utility="log_rank", advantage_limit=2.0),
        ),
        4,
        [
            "0x1.80bf08a80bf0bp+1", "0x1.8d32a1011c1b8p+1", "0x1.52db12244a436p+1", "0x1.c33066028a3eap+1",
            "0x1.f9eb4c34ad34ep+0",
        ],
        "-0x1.b91cdf57da68ep+3",
        "-0x1.b7938e5d69161p+3",
        "-0x1.9b56143e6d717p+3",
    ),
    "reacher-no_hw_opt": Resumed(
        NoHwOpt(**_TINY, ppo=dataclasses.replace(_PPO, gae_lambda=0.9, entropy_coef=0.01, std=0.7, std_end=0.3)),
        4,
        ["0x1.8000000000000p+1"] * 5,
        "-0x1.bff40e6f3b253p+3",
        "-0x1.e3b5863a7addcp+3",
        "-0x1.a02620d598035p+3",
    ),
    "pen_press-morph": Resumed(
        Morph(
            **{**_TINY, "evaluation": Evaluation(1, 4)},
            ppo=Ppo(
                gamma=0.97, epochs=2, minibatches=2, entropy_coef=0.003, std=0.6, std_end=0.3, restart_interval=30
            ),
            freeze_success=0.5,
            proxy=ProxyFit(prefit=2, pairs=64),
            exploration=Design(
                sigma=1.0, sigma_end=0.2, hold=0.4, correlation=0.5, utility="log_rank", advantage_limit=5.0, kappa=1.0,
                drift_clip=0.2,
            ),
            search=Drift(pairs=16, drift_clip=0.2, designs=8, ridge=1.0),
        ),
        2,
        [
            "-0x1.54519a4eef897p-13", "-0x1.c1aa25e4d3932p-14", "0x1.5ca1daa55af9bp-13", "0x1.7a471333b5c19p-12",
            "0x1.ebfe5920e45d5p-4", "0x1.ebc373c3777fap-4", "0x1.ebd51660a4ff7p-4", "0x1.ec02707acd32dp-4",
        ],
        "-0x1.4b4fb3610da36p-1",
        "-0x1.44cc97023f1a8p-1",
        "0x1.bdc45edd6b496p-6",
    ),
}  # fmt: skip
OLD_SEARCHES = ("cma", "drift", "gradient")
CHOICES = [("morph", exploration, search) for exploration in ("design", "gaussian") for search in OLD_SEARCHES] + [
    (method, "design", "cma") for method in ("direct", "no_hw_opt")
]
"""What could be chosen in format 1."""
NOW = {"design": "design", "gaussian": "gaussian_iid"}
"""What an exploration was called in format 1 -> what it is called now."""


@pytest.fixture(params=sorted(RUNS))
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def run(name: str, tmp_path: Path) -> RunFolder:
    """Return a copy of a recorded run."""
    shutil.copytree(RECORDED / name, tmp_path / name)
    return RunFolder(tmp_path / name)


def read(runs: Path, method: str, config: dict[str, Any]) -> Method:
    """Return the method of a run whose run.json has these settings in format 1."""
    record = RunRecord(
        format=1, id=f"old-{time.monotonic_ns()}", task="reacher", method=method, seed=0, iterations=1, config=config,
        parameters=list(make_task("reacher").design_space.parameters), versions={}, created=0.0,
    )  # fmt: skip
    return read_method(create_run(runs, record).record())


def as_recorded(*values: str) -> Any:
    """Return what was recorded, as nearly as this processor can give it again.

    Two kinds with the same vector instructions differed by up to 4e-9 of a value: the libraries choose by kind, too.
    """
    expected = [float.fromhex(value) for value in values]
    has_the_same_vectors = torch.backends.cpu.get_cpu_capability() == RECORDED_WITH
    return pytest.approx(expected, rel=1e-6, abs=1e-8) if has_the_same_vectors else pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("old", sorted(OLD_DEFAULTS))
def test_every_old_setting_is_the_same_or_has_a_new_name(old: str) -> None:
    possible = {path for method in METHODS for path, _ in paths_of(METHODS[method]())} | {
        path
        for _, exploration, search in CHOICES
        for path, _ in paths_of(configured(Morph(), {"exploration": NOW[exploration], "search": search}))
    }
    names = RENAMED.get(old, (old,))
    assert set(names) <= possible
    assert (old in RENAMED) != (old in possible)


def test_no_name_is_translated_that_was_never_one() -> None:
    assert set(RENAMED) <= set(OLD_DEFAULTS)


@pytest.mark.parametrize(("method", "exploration", "search"), CHOICES)
def test_a_run_with_the_old_defaults_has_the_new_ones(
    tmp_path: Path, method: str, exploration: str, search: str
) -> None:
    config = OLD_DEFAULTS | {"exploration": exploration, "search": search}
    chosen = {"exploration": NOW[exploration], "search": search} if method == "morph" else {}
    assert read(tmp_path, method, config) == configured(METHODS[method](), chosen)


@pytest.mark.parametrize(("method", "exploration", "search"), CHOICES)
def test_what_a_method_can_be_told_comes_from_the_old_settings(
    tmp_path: Path, method: str, exploration: str, search: str
) -> None:
    others = {name: value + 1 for name, value in OLD_DEFAULTS.items() if isinstance(value, int)}
    others |= {name: value / 2 + 0.125 for name, value in OLD_DEFAULTS.items() if isinstance(value, float)}
    others |= {"trajectories": 64, "drift_designs": 32, "projection": "as_printed", "utility": "log_rank"}
    config = OLD_DEFAULTS | others | {"exploration": exploration, "search": search}
    renamed = translated(config)
    assert all(config[name] != OLD_DEFAULTS[name] for name in others)
    found = dict(paths_of(read(tmp_path, method, config)))
    assert found == {path: renamed.get(path, ONCE_FIXED.get(path)) for path in found}


def test_a_recorded_run_opens_with_its_settings_events_and_episode(run: RunFolder, name: str) -> None:
    history, recorded = History(run), RUNS[name]
    written = json.loads((run.path / "run.json").read_text())
    assert written["format"] == 1
    assert set(written["config"]) == set(OLD_DEFAULTS)
    assert read_method(history.record) == recorded.method
    lines = run.events.read_text().splitlines()
    assert [event.seq for event in history.events] == list(range(1, len(lines) + 1))
    assert history.status == "finished"
    assert history.iteration == recorded.iteration
    assert [e.iteration for e in history.evaluations][-1] == recorded.iteration
    told = [json.loads(line) for line in lines]
    assert [p.diverged for p in history.progress] == [e["truncations"] for e in told if e["kind"] == "progress"]
    assert read_episode(run, recorded.iteration)["phi"].tolist() == history.phi.tolist()


def test_a_recorded_run_evaluates_as_it_did(run: RunFolder, name: str) -> None:
    document: dict[str, Any] = evaluate_run(run, "latest", 4)
    returns = [document[policy]["episode_return"] for policy in ("sampled", "deterministic")]
    assert returns == as_recorded(RUNS[name].sampled, RUNS[name].deterministic)


def test_a_recorded_run_goes_on_with_what_was_in_force(run: RunFolder, name: str) -> None:
    before, recorded = History(run), RUNS[name]
    assert trainer(run, "--further", "1").wait() == 0
    history = History(run)
    assert history.iteration == recorded.iteration + 1
    last = history.progress[-1]
    assert [*last.phi, last.episode_return] == as_recorded(*recorded.phi, recorded.episode_return)
    assert (last.alpha, last.projection) == (before.progress[-1].alpha, before.progress[-1].projection)
    assert history.design_space == before.design_space
    assert run.checkpoint_iterations()[-1] == last.iteration
    assert read_episode(run, last.iteration)["phi"].tolist() == last.phi


def test_the_recorded_runs_were_steered() -> None:
    history = History(RunFolder(RECORDED / "reacher-morph"))
    assert history.progress[-1].alpha == 2.0
    assert history.design_space.parameters[0].hi == 4.0
    assert history.design_space.parameters[4].locked_at == 2.5
