"""The example package: installed beside this one, it is run, exported and refused like what is built in."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from morph_core.methods.proxy import Morph
from morph_core.spread import Spread
from morph_core.state import start
from studio.export.bundle import robot_files
from studio.export.stand import check_standing
from tests import forked
from tests.packages import OWN_ROBOT, ROOT, beside, install, python, write_package

TINY = ("--trajectories", "8", "--ppo.minibatches", "1", "--ppo.epochs", "1", "--evaluation.episodes", "4")

BROKEN = """
    [morph.tasks]
    wobble = wobbly:Wobble
    [morph.searches]
    hooke = nowhere_to_be_found:Hooke
    """
WOBBLE = """
    from dataclasses import dataclass
    from typing import ClassVar
    from own_robot.throw import Throw

    @dataclass(frozen=True)
    class Wobble(Throw):
        name: ClassVar[str] = "wobble"
        observation_size: ClassVar[int] = 6
    """
NEWTON = """
    from dataclasses import dataclass
    from typing import ClassVar
    from morph_core.search import Search

    @dataclass(frozen=True)
    class Newton(Search):
        name: ClassVar[str] = "newton"

        def candidates(self, problem):
            return problem.start[None]
    """
REASONS = (
    '"wobble" of wobbly 1.0 (morph.tasks) can\'t be used: wobble: observe must be an array (2, 6), not (2, 5)',
    '"hooke" of wobbly 1.0 (morph.searches) can\'t be used: ModuleNotFoundError: No module named',
    '"newton" of anybodys 1.0 (morph.searches) can\'t be used: anybodys 1.0 and someones 1.0 have one of this name',
    '"newton" of someones 1.0 (morph.searches) can\'t be used: anybodys 1.0 and someones 1.0 have one of this name',
)

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the example is installed."""
    site = tmp_path_factory.mktemp("own_robot") / "site"
    install(OWN_ROBOT, site)
    return site


@pytest.fixture
def broken(tmp_path: Path) -> Path:
    """A folder of packages that can't be used: two are broken, and two have one name."""
    folder = tmp_path / "broken"
    folder.mkdir()
    write_package(folder, "wobbly", BROKEN, WOBBLE)
    for package in ("someones", "anybodys"):
        write_package(folder, package, f"[morph.searches]\nnewton = {package}:Newton\n", NEWTON)
    return folder


@pytest.fixture
def morph_studio(site: Path, tmp_path: Path) -> Run:
    """Run `morph-studio` beside the example, and beside what lies in other folders."""

    def run(*words: str | Path, sites: tuple[Path, ...] = ()) -> subprocess.CompletedProcess[str]:
        environment = beside(site, *sites) | {"COLUMNS": "80", "MORPH_RUNS": str(tmp_path / "runs")}
        return forked.morph_studio(*map(str, words), environment=environment, seconds=250)

    return run


def plain(help_text: str) -> str:
    """Return a help text as one line, without its frames."""
    return " ".join(re.sub("[│─╭╮╰╯]", " ", help_text).split())


def trained(run: Run, *words: str) -> Any:
    """Return what `morph-studio train own_throw` says at its end."""
    ended = run("train", "own_throw", *TINY, *words, "--json")
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


# --- what is offered ---


def test_the_help_of_train_offers_task_method_exploration_and_search(morph_studio: Run) -> None:
    shown = plain(morph_studio("train", "--help").stdout).replace(" ", "")  # long choices are wrapped
    for choices in (
        "Choose from: reacher, pen_press, mouse_click, own_throw.",
        "--method {morph,cmaes_rl,direct,no_hw_opt,transform2act,value_gradient,random_walk}",
        "--exploration {design,gaussian,gaussian_iid,uniform}",
        "--search {cma,cma_debiased,drift,gradient,scatter}",
    ):
        assert choices.replace(" ", "") in shown


def test_the_help_of_a_run_has_the_settings_of_the_package_with_their_explanation(morph_studio: Run) -> None:
    with_parts = ("--search", "scatter", "--exploration", "uniform")
    shown = plain(morph_studio("train", "own_throw", *with_parts, "--help").stdout)
    for line in (
        "--search.tries INT Designs per search. Allowed: ≥ 1, ≤ 1000000. (default: 64)",
        "--search.radius FLOAT Standard deviation of the designs around phi, in units of each parameter's scale.",
        "--exploration.kappa FLOAT",
        "--hold FLOAT s: how long the hand stays closed. Allowed: > 0, ≤ 1000000. (default: 0.5)",
    ):
        assert line in shown
    assert re.search(r"--schedule\.iterations INT [^(]*\(default: 60\)", shown)
    assert "--step FLOAT Standard deviation of a step of phi" in plain(
        morph_studio("train", "own_throw", "--method", "random_walk", "--help").stdout
    )


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            "--search.tries 3",
            '"search.tries" does nothing with search cma, only with scatter; choose from: search.pairs, ',
        ),
        (
            "--search scatter --search.sigma0 3",
            '"search.sigma0" does nothing with search scatter, only with cma or cma_d',
        ),
        ("--step 3", '"step" does nothing for morph, only for direct or value_gradient or random_walk; '),
        ("--search scatter --search.tries 0", "search.tries must lie in [1, 1000000], not 0"),
        ("--hold -1", "hold must lie in (0, 1000000], not -1"),
        (
            "--search scater",
            'can\'t be "scater" (did you mean scatter?); choose from: cma, cma_debiased, drift, gradient, scatter',
        ),
    ],
)
def test_what_does_nothing_is_refused_as_for_our_own(morph_studio: Run, words: str, sentence: str) -> None:
    ended = morph_studio("train", "own_throw", *words.split())
    assert ended.returncode == 2
    assert sentence in ended.stderr
    assert ended.stderr.count("\n") == 1


def test_the_start_panel_offers_them_with_their_settings(site: Path) -> None:
    shown = json.loads(python(PANEL + ASKED, site).splitlines()[0])
    assert shown["task"][-1] == "own_throw"
    assert shown["method"][-1] == "random_walk"
    assert shown["exploration"] == ["design", "gaussian", "gaussian_iid", "uniform"]
    assert shown["search"] == ["cma", "cma_debiased", "drift", "gradient", "scatter"]
    assert shown["iterations"] == 60
    assert shown["request"] == ["own_throw", "morph", {"search": "scatter", "search.tries": 7}]
    assert not shown["notice"]


PANEL = """
import contextlib, io, json, viser
from studio.viewer.start import StartPanel
with contextlib.redirect_stdout(io.StringIO()):  # it says where it listens
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
panel = StartPanel(server.gui, on_start=print, on_preview=lambda: None)
"""
ASKED = """
panel.task.value = "own_throw"
panel.settings.search.value = "scatter"
panel.settings._more["search.tries"].value = 7
request = panel.request()
print(json.dumps({
    "task": list(panel.task.options), "method": list(panel.method.options),
    "exploration": list(panel.settings.exploration.options), "search": list(panel.settings.search.options),
    "iterations": panel.iterations.value, "request": [request.task, request.method, request.settings],
    "notice": panel.notice.visible,
}))
"""


def test_gymnasium_makes_the_task_and_finds_nothing_wrong(site: Path) -> None:
    program = """
import gymnasium
from gymnasium.utils.env_checker import check_env
env = gymnasium.make("morph/OwnThrow-v0", render_mode="rgb_array")
check_env(env.unwrapped)
env.reset(seed=0)
print(env.spec.max_episode_steps, env.observation_space.shape, env.render().shape)
"""
    assert python(program, site) == "50 (5,) (480, 640, 3)\n"


def test_the_task_passes_the_contract_of_every_task(site: Path) -> None:
    suite = ROOT / "tests" / "core" / "test_task_contract.py"
    options = ["-q", "-o", "addopts=", "-p", "no:cacheprovider", "-p", "pytest_timeout", "-k", "own_throw"]
    environment = beside(site) | {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}  # they take longer to load than to run
    command = [sys.executable, "-m", "pytest", *options, suite]
    ended = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=200)
    assert ended.returncode == 0, ended.stdout
    assert int(re.findall(r"(\d+) passed", ended.stdout)[0]) > 10


# --- what can't be used ---


def test_packages_that_cannot_be_used_are_named_in_the_help_and_harm_nothing(morph_studio: Run, broken: Path) -> None:
    shown = plain(morph_studio("train", "own_throw", "--search", "scatter", "--help", sites=(broken,)).stdout)
    for reason in REASONS:
        assert f"Left out: {reason}" in shown
    assert "--search {cma,cma_debiased,drift,gradient,scatter}" in shown
    assert "--search.tries" in shown


def test_who_asks_for_one_that_cannot_be_used_is_told_the_reason(morph_studio: Run, broken: Path) -> None:
    ended = morph_studio("train", "wobble", sites=(broken,))
    assert ended.returncode == 2
    assert "choose from: reacher, pen_press, mouse_click, own_throw; " + REASONS[0] in ended.stderr


def test_the_start_panel_names_what_cannot_be_used(site: Path, broken: Path) -> None:
    program = PANEL + "print(json.dumps([panel.notice.visible, panel.notice.content, list(panel.task.options)]))"
    visible, content, tasks = json.loads(python(program, site, broken).splitlines()[0])
    assert visible
    for reason in REASONS:
        assert reason.split("(")[0].replace('"', "&quot;") in content or reason.split("(")[0] in content
    assert tasks == ["reacher", "pen_press", "mouse_click", "own_throw"]


# --- what it does ---


@pytest.mark.slow
def test_the_method_of_the_paper_runs_with_its_parts_and_the_design_is_exported(
    morph_studio: Run, tmp_path: Path
) -> None:
    words = ("--search", "scatter", "--search.tries", "5", "--exploration", "uniform", "--evaluation.interval", "2")
    said = trained(morph_studio, "--iterations", "4", *words)
    assert (said["status"], said["iterations"], list(said["phi"])) == ("finished", 4, ["upper_arm", "forearm"])
    assert said["phi"] != {"upper_arm": 0.3, "forearm": 0.3}
    record = json.loads((Path(said["path"]) / "run.json").read_text())
    assert (record["config"]["search"]["name"], record["config"]["search"]["tries"]) == ("scatter", 5)
    assert record["config"]["exploration"]["name"] == "uniform"

    measured = morph_studio("evaluate", said["run"], "--design", "latest", "--episodes", "3", "--json")
    assert measured.returncode == 0, measured.stderr
    bundle = tmp_path / "design.zip"
    exported = morph_studio("export", said["run"], "--design", "latest", "--out", bundle)
    assert exported.returncode == 0, exported.stdout + exported.stderr
    verified = morph_studio("verify", bundle)
    assert verified.returncode == 0, verified.stdout + verified.stderr


@pytest.mark.slow
def test_the_method_of_the_package_resumes_to_the_last_bit(morph_studio: Run) -> None:
    words = ("--method", "random_walk", "--evaluation.interval", "2", "--step", "1")
    whole = trained(morph_studio, "--iterations", "4", *words)
    half = trained(morph_studio, "--iterations", "2", *words)
    assert half["phi"] != whole["phi"]
    ended = morph_studio("train", "--resume", half["run"], "--iterations", "2", "--json")
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout)["phi"] == whole["phi"]
    weights = [Path(run["path"]) / "checkpoints" / "000004" / "weights.safetensors" for run in (whole, half)]
    assert weights[0].read_bytes() == weights[1].read_bytes()


@pytest.mark.slow
def test_the_method_of_the_paper_learns_to_hit(morph_studio: Run) -> None:
    ended = morph_studio("train", "own_throw", "--seed", "10", "--iterations", "60", "--json")
    said = json.loads(ended.stdout)
    assert said["last_evaluation"]["deterministic_success"] > 0.9
    assert min(said["phi"].values()) > 0.4


@pytest.fixture
def throw(site: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module of the example's task."""
    monkeypatch.syspath_prepend(site)
    import own_robot.throw  # pyright: ignore[reportMissingImports]

    return own_robot.throw


@pytest.fixture
def strategies(throw: Any) -> tuple[Any, Any, Any]:
    """The classes of the example's method, exploration and search."""
    del throw  # it has made the package importable
    from own_robot.random_walk import RandomWalk  # pyright: ignore[reportMissingImports]
    from own_robot.scatter import Scatter  # pyright: ignore[reportMissingImports]
    from own_robot.uniform import Uniform  # pyright: ignore[reportMissingImports]

    return RandomWalk, Uniform, Scatter


def test_phi_walks_to_the_neighbour_only_where_that_returned_more(
    throw: Any, strategies: tuple[Any, Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    kind, seen = strategies[0], []
    module = sys.modules[kind.__module__]
    run = module.run_trajectories
    monkeypatch.setattr(module, "run_trajectories", lambda *arguments: seen.append(run(*arguments)) or seen[-1])
    task, method = throw.Throw(), kind(trajectories=16, hidden=8)
    state = start(task, method, 0)
    moves = set()
    before = state.phi
    for _ in islice(method.iterations(task, state), 12):
        first, second = state.explored[[0, -1]]
        assert first.tolist() == before.tolist() != second.tolist()
        better = seen[-1].returns[8:].mean() > seen[-1].returns[:8].mean()
        assert state.phi.tolist() == (second if better else first).tolist()
        moves.add(better)
        before = state.phi
    assert moves == {True, False}


def test_uniform_designs_have_the_sigma_that_is_asked_for(throw: Any, strategies: tuple[Any, Any, Any]) -> None:
    task, method = throw.Throw(), Morph(exploration=strategies[1]())
    state = start(task, method, 0)
    space = task.design_space
    world = method.exploration.world(task, state, Spread(0.5, 0.0), 4000)
    assert world.phi is state.explored
    offsets = (state.explored - space.initial) / space.scale
    np.testing.assert_allclose(offsets.std(0), 0.5, atol=0.02)
    assert 0.86 < np.abs(offsets).max() <= 0.5 * np.sqrt(3)
    np.testing.assert_allclose(offsets.mean(0), 0, atol=1e-12)  # antithetic pairs


def test_scattered_designs_are_in_the_box_with_the_present_one_among_them(
    throw: Any, strategies: tuple[Any, Any, Any]
) -> None:
    space = throw.Throw().design_space
    problem: Any = SimpleNamespace(space=space, start=space.initial, seed=3)
    found = strategies[2](tries=500, radius=2.0).candidates(problem)
    assert found.shape == (501, 2)
    assert found[0].tolist() == space.initial.tolist()
    assert ((found >= space.lo) & (found <= space.hi)).all()
    np.testing.assert_allclose(found[1:].std(0), 2 * space.scale, rtol=0.1)


def nearest_throw(throw: Any, length: float) -> float:
    """Return how near (m) to the disc's middle a ball can come that an arm with two such links throws."""
    task = throw.Throw()
    angles = np.linspace(-np.pi, np.pi, 61)
    speeds = task.top_speed * np.array([-1.0, 0.0, 1.0])
    s = np.zeros((61 * 61 * 9, task.state_size))
    s[:, [0, 1, 4, 5]] = np.stack(np.meshgrid(angles, angles, speeds, speeds), -1).reshape(-1, 4)
    z = task.hw_phy(np.full(2, length))(s, np.zeros((len(s), 2)))
    ball, velocity = throw.SHOULDER + z[:, :2], z[:, 2:]
    flown = np.arange(0, 1.5, 0.01)[:, None, None]
    path = ball + flown * velocity - [0, throw.GRAVITY / 2] * flown**2
    return float(np.linalg.norm(path - task.goal, axis=-1).min())


def test_only_a_longer_arm_can_reach_the_disc(throw: Any) -> None:
    task = throw.Throw()
    assert nearest_throw(throw, task.design_space.initial[0]) > 2 * task.goal_radius
    assert nearest_throw(throw, 0.45) < task.goal_radius / 2


def test_the_robot_stands_wherever_its_files_are_opened(throw: Any) -> None:
    task = throw.Throw()
    files = robot_files(task, task.design_space.initial, [], ("mjcf",))
    for file, own in (("robot.xml", {"world", "upper_arm", "forearm"}), ("scene.xml", {"upper_arm", "forearm"})):
        model = mujoco.MjModel.from_xml_string(files[file].decode())
        assert model.nkey == (file == "scene.xml")
        checks = check_standing(file, model, own)
        assert [str(check) for check in checks if not check.passed or "not asked" in check.detail] == []


def test_the_ball_flies_as_it_should_once_the_hand_has_opened(throw: Any) -> None:
    task = throw.Throw(start_noise=0.0)
    hw_phy = task.hw_phy(np.full(2, 0.5))
    s = task.reset(hw_phy, 1, np.random.default_rng(0))
    while s[0, 8] < task.hold - throw.DT / 2:
        step = task.step(hw_phy, s, np.array([[-1.0, -0.3]]))
        s = step.s
        np.testing.assert_array_equal(s[0, [2, 3, 6, 7]], np.concatenate([throw.SHOULDER, [0, 0]]) + step.z[0])
    release = s
    for _ in range(6):
        s = task.step(hw_phy, s, np.ones((1, 2))).s
    t = 6 * throw.DT
    expected = release[0, 2:4] + t * release[0, 6:8] - [0, throw.GRAVITY * t**2 / 2]
    np.testing.assert_allclose(s[0, 2:4], expected, atol=1e-12)
    assert np.abs(s[0, 4:6]).max() < np.abs(release[0, 4:6]).max() / 3  # the joints brake


def test_the_physics_are_differentiable_as_they_say(throw: Any) -> None:
    task, rng = throw.Throw(), np.random.default_rng(0)
    s, a = task.sample_pairs(5, rng)
    phi, h = np.array([0.3, 0.4]), 1e-6
    slopes = [(task.hw_phy(phi + d)(s, a) - task.hw_phy(phi - d)(s, a)) / (2 * h) for d in h * np.eye(2)]
    np.testing.assert_allclose(task.hw_phy(phi).jacobian(s, a), np.stack(slopes, -1), atol=1e-6)
