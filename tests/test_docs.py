"""What README, docs/use.md and CONTRIBUTING say is so: their commands, their files and the ten lines of Python."""

import itertools
import re
import shlex
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

from studio.cli import run
from tests import forked

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
USE = (ROOT / "docs" / "use.md").read_text()
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text()
EXAMPLE = ROOT / "examples" / "ten_lines.py"


def _blocks(text: str, language: str) -> list[str]:
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    return [block for name, block in fenced if name == language]


COMMANDS = [
    part.split("#")[0].strip()
    for block in _blocks(README + USE, "sh")
    for line in block.splitlines()
    for part in line.split("&&")
    if part.strip().startswith("morph-studio")
]


def test_readme_and_docs_show_every_command() -> None:
    shown = {shlex.split(command)[1] for command in COMMANDS}
    assert shown == {
        "serve",
        "train",
        "study",
        "runs",
        "stop",
        "log",
        "replay",
        "evaluate",
        "compare",
        "export",
        "verify",
        "show",
        "import",
    }


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_that_is_shown_exists_with_its_options(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = shlex.split(command)
    with pytest.raises(SystemExit) as ended:
        run([words[1], "--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    for option in (word for word in words if word.startswith("--")):
        assert option in shown
    assert "None" not in shown  # a flag that may be left out
    assert _broken_off(shown) == []


def _broken_off(shown: str) -> list[str]:
    """Return the lines of a help that end where the first word of the next line, of the same flag, would fit."""
    broken, lines = [], re.findall(r"^│ (.*) │$", shown, re.MULTILINE)
    for line, below in itertools.pairwise(lines):
        same_flag = line.strip() and re.match(r" {8}", below) and not re.search(r" {2}|^\W", line.strip())
        if same_flag and len(line.rstrip()) + 1 + len(below.split()[0] if below.split() else "") <= len(line):
            broken.append(line)
    return broken


def test_a_line_of_a_help_that_is_broken_off_is_found() -> None:
    lines = ["--one N   Number of things,", "          which is a whole", "          number that is large, enough."]
    assert _broken_off("".join(f"│ {line:40} │\n" for line in lines)) == [f"{lines[1]:40}"]


def test_the_readme_stays_one_screen() -> None:
    assert len(README.split("## Citation")[0].split()) <= 560


def test_the_readme_sets_up_with_two_commands() -> None:
    blocks = [block.strip() for block in _blocks(README, "sh")]
    assert "pip install -e . && morph-studio serve" in blocks
    assert 'pip install -e ".[test]" && pytest' in blocks


def test_the_docs_show_the_example_as_it_is() -> None:
    program = EXAMPLE.read_text().split('"""\n\n', 1)[1]
    assert _blocks(USE, "python")[0] == program
    assert len([line for line in program.splitlines() if line]) <= 10


@pytest.mark.slow
def test_the_example_prints_a_line_per_iteration() -> None:
    example = forked.python(EXAMPLE.read_text())
    deadline = time.monotonic() + 200
    while not (first := example.said("output").partition("\n")[0]) and time.monotonic() < deadline:
        time.sleep(0.02)
    example.send_signal(signal.SIGKILL)
    assert example.wait() == -signal.SIGKILL, example.said("errors")
    assert re.fullmatch(r" +1  success \d\.\d\d  links( \d\.\d\d){5} m", first)


def test_what_the_docs_show_of_gymnasium_runs() -> None:
    program = _blocks(USE, "python")[1] + "print(env.reset(seed=0)[0].shape, env.render().shape, envs.num_envs)"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert ended.stdout == "(16,) (480, 640, 3) 4\n", ended.stderr


@pytest.mark.parametrize("folder", re.findall(r"^(\w+/(?:\w+/)?)  ", _blocks(USE, "")[-1], re.MULTILINE))
def test_every_folder_that_the_docs_name_exists(folder: str) -> None:
    assert (ROOT / folder).is_dir()


PAGES = sorted(
    page.relative_to(ROOT)
    for page in [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("examples/*/*.md"), *ROOT.glob("assets/*.md")]
)


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_every_file_that_is_linked_exists(page: Path) -> None:
    linked = re.findall(r"\]\((?!http)([^)#]+)\)", (ROOT / page).read_text())
    assert [path for path in linked if not (ROOT / page).parent.joinpath(path).is_file()] == []


def test_the_gallery_shows_every_report() -> None:
    gallery = (ROOT / "docs" / "gallery.md").read_text()
    reports = [path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs" / "studies").glob("*/report.html")]
    assert reports
    assert [report for report in reports if f"]({report})" not in gallery] == []


def test_every_decision_has_its_day() -> None:
    decisions = re.findall(r"^\*\*(.+?)\*\*", (ROOT / "docs" / "decisions.md").read_text(), re.MULTILINE)
    assert decisions
    assert [decision for decision in decisions if not re.search(r"\((\d{4}-\d\d-\d\d(, )?)+\)\.$", decision)] == []


def test_the_newest_version_of_the_changelog_is_the_distribution_s() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    versions = re.findall(r"^## (\d\S*) - \d{4}-\d\d-\d\d$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert versions[0] == version
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text()


MAPS = dict(zip(("morph_core", "studio"), _blocks(CONTRIBUTING, ""), strict=False))
NAMES_OF_A_LINE = re.compile(r"(?:[\w/]+(?:\.py|/) +)+")
FILES_OF_A_FOLDER = re.compile(r"one file = one [\w ]+: ([\w, ]+)")


def _named(lines: str) -> list[str]:
    """Return the files and folders that begin the lines of a map, and those that a folder's line lists."""
    names = []
    for line in lines.splitlines():
        begins, listed = NAMES_OF_A_LINE.match(line), FILES_OF_A_FOLDER.search(line)
        assert begins, f"this line of the map names no file: {line}"
        names += begins[0].split()
        if listed:
            names += [f"{names[-1]}{stem.strip()}.py" for stem in listed[1].split(",")]
    return names


@pytest.mark.parametrize("package", MAPS)
def test_the_map_names_every_module(package: str) -> None:
    named = {name for name in _named(MAPS[package]) if name.endswith(".py")}
    found = {str(path.relative_to(ROOT / package)) for path in (ROOT / package).rglob("[a-z]*.py")}
    modules = {name for name in found if not name.startswith("export/shipped/")}
    assert named == modules, f"lines to add: {sorted(modules - named)}; lines to delete: {sorted(named - modules)}"


@pytest.mark.parametrize("package", MAPS)
def test_the_map_is_in_the_order_of_the_import_contract(package: str) -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (layers,) = (contract["layers"] for contract in contracts if contract.get("containers") == [package])
    height = {name: i for i, layer in enumerate(layers) for name in layer.split(" | ")}
    places = [height[name.split("/")[0].removesuffix(".py")] for name in _named(MAPS[package])]
    assert places == sorted(places)


def test_contributing_names_the_groups_of_checks() -> None:
    (groups,) = re.findall(r"^every=\(([\w ]+)\)$", (ROOT / ".ci" / "run").read_text(), re.MULTILINE)
    assert ", ".join(groups.split()) in CONTRIBUTING


def test_an_unknown_group_of_checks_lists_the_choices() -> None:
    ended = subprocess.run([ROOT / ".ci" / "run", "lnt"], capture_output=True, text=True, timeout=60)
    assert ended.returncode == 2
    assert ended.stderr == 'unknown group "lnt"; choose from: lint, types, docs, fast, slow, browser, mutants\n'


@pytest.mark.parametrize("path", re.findall(r"!\[[^\]]+\]\(([^)]+)\)", README))
def test_a_picture_is_small(path: str) -> None:
    assert (ROOT / path).stat().st_size < 500_000
