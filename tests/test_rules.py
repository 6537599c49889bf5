"""The rules that a linter can't keep: no pickle, no torch in the web process, modules that say what they are."""

import ast
import itertools
import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("morph_core", "studio")
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
IDS = [str(path.relative_to(ROOT)) for path in MODULES]
UNPICKLERS = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}


def _imports(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module


def _unsafe_loads(tree: ast.Module) -> Iterator[str]:
    """Yield what in `tree` can execute what a file holds."""
    for node in ast.walk(tree):
        match node:
            case ast.ImportFrom(module="torch", names=names):
                yield from (f"from torch import {alias.name}" for alias in names if alias.name in ("load", "save"))
            case ast.Attribute(value=ast.Name(id="torch"), attr="load" | "save" as name):
                yield f"torch.{name}"
            case ast.keyword(arg="allow_pickle", value=value) if ast.unparse(value) != "False":
                yield f"allow_pickle={ast.unparse(value)}"
    yield from (f"import {name}" for name in _imports(tree) if name.split(".")[0] in UNPICKLERS)


@pytest.mark.parametrize("path", MODULES, ids=IDS)
def test_no_module_loads_code_from_a_file(path: Path) -> None:
    assert list(_unsafe_loads(ast.parse(path.read_text()))) == []


@pytest.mark.parametrize(
    "line",
    [
        "import pickle",
        "from cloudpickle import load",
        "import torch; torch.load(path)",
        "from torch import save",
        "import numpy as np; np.load(path, allow_pickle=True)",
    ],
)
def test_the_search_for_unsafe_loads_finds_them(line: str) -> None:
    assert list(_unsafe_loads(ast.parse(line)))


def test_whoever_reads_json_from_elsewhere_is_ready_for_all_that_its_reader_raises() -> None:
    """The reader of JSON raises DecodeError, UnicodeDecodeError and RecursionError; the first two are ValueErrors."""
    lacking = []
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ExceptHandler) and node.type and "DecodeError" in (said := ast.unparse(node.type)):
                words = set(re.findall(r"\w+", said))
                if not {"DecodeError", "UnicodeDecodeError", "RecursionError"} <= words:
                    lacking.append(f"{path.relative_to(ROOT)}:{node.lineno} catches {said}")
    assert lacking == []


@pytest.mark.parametrize("path", MODULES, ids=IDS)
def test_every_module_says_what_it_is_in_its_first_line(path: Path) -> None:
    docstring = ast.get_docstring(ast.parse(path.read_text()))
    assert docstring
    first = docstring.splitlines()[0]
    assert len(first) > 15
    assert first.rstrip()[-1] in ".:?"


@pytest.mark.parametrize("module", ["studio.app", "studio.cli", "studio.viewer", "studio.export", "morph_core.history"])
def test_the_web_process_never_loads_torch(module: str) -> None:
    script = f"import json, sys, {module}; print(json.dumps([m for m in ('torch', 'cma') if m in sys.modules]))"
    ended = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout) == []


def test_importing_the_core_loads_no_web_viewer_or_mesh_library() -> None:
    script = (
        "import json, sys, morph_core.train; "
        "names = ('fastapi', 'starlette', 'uvicorn', 'viser', 'trimesh', 'manifold3d'); "
        "print(json.dumps([m for m in names if m in sys.modules]))"
    )
    ended = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout) == []


def test_torch_is_bounded_to_one_minor_version() -> None:
    assert '"torch>=2.13,<2.14"' in (ROOT / "pyproject.toml").read_text()
    assert "torch==2.13.0" in (ROOT / "constraints.txt").read_text().splitlines()


def test_no_two_test_files_are_one_module_to_pytest() -> None:
    files = [path for path in (ROOT / "tests").rglob("test_*.py") if not (path.parent / "__init__.py").exists()]
    twice = {path.name for path in files if [other.name for other in files].count(path.name) > 1}
    assert not twice, f"outside of packages a test file needs a name of its own; given twice: {sorted(twice)}"


@pytest.mark.parametrize("page", sorted(ROOT.glob("studio/page/*.html")), ids=lambda page: page.name)
def test_no_two_scripts_of_a_page_have_a_name_in_common(page: Path) -> None:
    """Scripts that aren't modules share one scope: the later one's function takes the place of the earlier one's."""
    scripts = [
        (page.parent / name).read_text() for name in re.findall(r'<script src="page/([\w-]+\.js)"', page.read_text())
    ]
    declaration = re.compile(r"^(?:async )?(?:function|const|let|class) +(\w+)", re.MULTILINE)
    declared = Counter(name for script in scripts for name in set(declaration.findall(script)))
    assert [name for name, count in declared.items() if count > 1] == []


def test_no_browser_test_gives_up_sooner_than_a_busy_machine_needs() -> None:
    """One patience for all: a wait that is shorter, but for one that is repeated, fails where much else is at work."""
    hasty = [
        f"{path.name}: {line.strip()}"
        for path in sorted((ROOT / "tests" / "e2e").glob("test_*.py"))
        for before, line in itertools.pairwise(path.read_text().splitlines())
        for word in re.findall(r"\btimeout(?:=|\()([\d_]+)", line)
        if int(word) < 60_000 and "suppress(TimeoutError)" not in before
    ]
    assert hasty == []
