"""What README and CONTRIBUTING say is so: their commands, their files and the ten lines of Python."""

import re
import shlex
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from morph_core.tasks import TASKS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text()
EXAMPLE = ROOT / "examples" / "ten_lines.py"
MORPH_STUDIO = Path(sysconfig.get_path("scripts")) / "morph-studio"


def _blocks(text: str, language: str) -> list[str]:
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    return [block for name, block in fenced if name == language]


COMMANDS = [
    part.split("#")[0].strip()
    for block in _blocks(README, "sh")
    for line in block.splitlines()
    for part in line.split("&&")
    if part.strip().startswith("morph-studio")
]


def test_the_readme_shows_every_command() -> None:
    shown = {shlex.split(command)[1] for command in COMMANDS}
    assert shown == {"serve", "train", "runs", "evaluate", "export", "verify", "import"}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_of_the_readme_exists_with_its_options(command: str) -> None:
    words = shlex.split(command)
    ended = subprocess.run([MORPH_STUDIO, words[1], "--help"], capture_output=True, text=True, timeout=60)
    assert ended.returncode == 0, ended.stderr
    for option in (word for word in words if word.startswith("--")):
        assert option in ended.stdout


def test_the_readme_sets_up_with_two_commands() -> None:
    blocks = [block.strip() for block in _blocks(README, "sh")]
    assert "pip install -e . && morph-studio serve" in blocks
    assert 'pip install -e ".[test]" && pytest' in blocks


def test_the_readme_shows_the_example_as_it_is() -> None:
    program = EXAMPLE.read_text().split('"""\n\n', 1)[1]
    assert _blocks(README, "python")[0] == program
    assert len([line for line in program.splitlines() if line]) <= 10


def test_the_example_prints_a_line_per_iteration() -> None:
    process = subprocess.Popen([sys.executable, str(EXAMPLE)], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None
    try:
        first = process.stdout.readline()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    assert re.fullmatch(r" +1  success \d\.\d\d  links( \d\.\d\d){5} m\n", first)


def test_what_the_readme_shows_of_gymnasium_runs() -> None:
    program = _blocks(README, "python")[1] + "print(env.reset(seed=0)[0].shape, env.render().shape, envs.num_envs)"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert ended.stdout == "(16,) (480, 640, 3) 4\n", ended.stderr


@pytest.mark.parametrize("folder", re.findall(r"^(\w+/(?:\w+/)?)  ", _blocks(README, "")[-1], re.MULTILINE))
def test_every_folder_that_the_readme_names_exists(folder: str) -> None:
    assert (ROOT / folder).is_dir()


@pytest.mark.parametrize("path", re.findall(r"\]\((?!http)([^)#]+)\)", README + CONTRIBUTING))
def test_every_file_that_is_linked_exists(path: str) -> None:
    assert (ROOT / path).is_file()


def test_the_map_names_every_module_of_the_core() -> None:
    named = set(re.findall(r"(?:tasks/)?[a-z_]+\.py", _blocks(CONTRIBUTING, "")[0]))
    core, tasks = (
        {path.name for path in (ROOT / folder).glob("[a-z]*.py")} for folder in ("morph_core", "morph_core/tasks")
    )
    shared = tasks - {f"{name}.py" for name in TASKS}  # a task's own file needs no line
    assert named == core | {f"tasks/{name}" for name in shared}


@pytest.mark.parametrize("path", re.findall(r"!\[[^\]]+\]\(([^)]+)\)", README))
def test_a_picture_is_small(path: str) -> None:
    assert (ROOT / path).stat().st_size < 500_000
