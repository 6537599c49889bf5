"""Names in Gymnasium's registry: there without an import of ours, and at next to no cost."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from morph_core.catalogue import TASKS, make_task
from morph_core.registration import BUILT_IN, env_id

ROOT = Path(__file__).parents[2]
HEAVY = ("mujoco", "torch", "numpy", "gymnasium")


def run(program: str, *paths: Path) -> str:
    """Return what a fresh Python prints, with packages that lie at `paths`."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (ROOT, *paths)))}
    ended = subprocess.run(
        [sys.executable, "-W", "error", "-c", program], env=environment, capture_output=True, text=True, timeout=60
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


@pytest.fixture
def other(tmp_path: Path) -> Path:
    """A package that names tasks in its entry points, and that can't be imported."""
    (tmp_path / "other.py").write_text("raise RuntimeError('broken')")
    about = tmp_path / "other-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    names = ("own_throw", "reacher", "not allowed", "brackets(1)")
    (about / "entry_points.txt").write_text("[morph.tasks]\n" + "".join(f"{name} = other:Throw\n" for name in names))
    return tmp_path


def test_every_task_has_a_name_that_is_known_without_it() -> None:
    assert sorted(BUILT_IN) == sorted(TASKS)
    assert env_id("pen_press") == "morph/PenPress-v0"


def test_an_installed_package_registers_its_tasks_without_being_imported() -> None:
    program = """
import gymnasium
print(gymnasium.make("morph/PenPress-v0"), gymnasium.make_vec("morph/Reacher-v0", num_envs=4))
"""
    shown = run(program)
    assert "<TaskEnv<morph/PenPress-v0>>" in shown, "install this version: pip install -e ."
    assert "TaskVectorEnv(morph/Reacher-v0, num_envs=4)" in shown


def test_an_import_of_gymnasium_registers_names_and_loads_nothing(other: Path) -> None:
    program = f"""
import json, sys, morph_core.startup
first = [name for name in {HEAVY} if name in sys.modules]
import gymnasium
names = [name for name in gymnasium.registry if name.startswith("morph/")]
print(json.dumps([first, sorted(names), [name for name in ("mujoco", "torch", "other") if name in sys.modules]]))
"""
    first, names, loaded = json.loads(run(program, other))
    assert first == []
    assert names == sorted(env_id(name) for name in (*TASKS, "own_throw"))
    assert loaded == []


def test_the_horizon_is_known_when_it_is_asked_for() -> None:
    program = """
import json, sys, morph_core.startup, gymnasium
print(json.dumps([[s.max_episode_steps for s in map(gymnasium.spec, sys.argv[1:])], "mujoco" in sys.modules]))
"""
    ids = [env_id(name) for name in TASKS]
    horizons, loaded = json.loads(run(program.replace("sys.argv[1:]", str(ids))))
    assert horizons == [make_task(name).horizon for name in TASKS]
    assert loaded


@pytest.mark.parametrize("first", ["", "import morph_core.startup"])
@pytest.mark.parametrize("module", ["morph_core.registration", "morph_core.envs", "morph_core.envs.arguments"])
def test_whatever_is_imported_first_registers_once(first: str, module: str) -> None:
    program = f"""
{first}
import {module}, morph_core.registration, gymnasium
before = dict(gymnasium.registry)
import morph_core.startup
morph_core.registration.register_tasks()
assert before.keys() == gymnasium.registry.keys()
assert all(gymnasium.registry[name] is spec for name, spec in before.items())
print("morph/Reacher-v0" in before)
"""
    assert run(program) == "True\n"


def test_gymnasium_can_be_imported_whatever_is_the_matter_with_the_tasks(tmp_path: Path) -> None:
    program = """
import warnings, sys
import morph_core.startup
sys.modules["morph_core.registration"] = None
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    import gymnasium
print(*[str(w.message) for w in caught if "morph-studio" in str(w.message)])
print(gymnasium.make("CartPole-v1"))
"""
    shown = run(program, tmp_path)
    assert "the tasks of morph-studio are not registered in Gymnasium" in shown
    assert "CartPole-v1" in shown
