"""The list of mutants fits the code, and the script tells the living from the dead."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from tests.mutants import ROOT, Copy, Mutant, chosen, judge, stale, verdict
from tests.mutations import MUTANTS


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Return a project of two functions, of which one is tested."""
    (tmp_path / "thing.py").write_text("def held():\n    return 1 + 1\n\n\ndef loose():\n    return 2 + 2\n")
    (tmp_path / "test_thing.py").write_text("from thing import held\n\n\ndef test_held():\n    assert held() == 2\n")
    return tmp_path


HELD = Mutant("thing.py", "1 + 1", "1 - 1", ("test_thing.py",))
LOOSE = Mutant("thing.py", "2 + 2", "2 - 2", ("test_thing.py::test_held",))
BROKEN = Mutant("thing.py", "def held", "def gone", ("test_thing.py",))
"""The import of its test fails: that is no failed test."""


def test_every_mutant_still_fits_the_code_and_its_tests_exist() -> None:
    assert [f"{mutant}: {reason}" for mutant in MUTANTS if (reason := stale(mutant, ROOT))] == []
    assert [str(mutant) for mutant in MUTANTS if mutant.new == mutant.old] == []


def test_there_are_enough_of_them_and_none_twice() -> None:
    assert len(MUTANTS) >= 60
    assert len({(m.file, m.old, m.new) for m in MUTANTS}) == len(MUTANTS)


def test_every_mutant_gets_its_word_and_those_that_live_stand_at_the_end(
    tree: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (tree / "thing.py").read_text()
    assert judge([LOOSE, HELD, BROKEN], tree, 2, libraries=()) == 1
    assert (tree / "thing.py").read_text() == text
    *words, gap, survivor, broken, reason, counts = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in words] == ["SURVIVED", "killed", "BROKEN", "1"]
    assert (gap, counts) == ("", "1 SURVIVED, 1 killed, 1 BROKEN")
    assert survivor == f"SURVIVED  {LOOSE}"
    assert [broken, reason] == words[2:]


@pytest.fixture
def copy(tree: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Copy]]:
    """Return what copies that tree, with the process that runs its tests."""
    with contextlib.ExitStack() as stack:
        yield lambda *libraries: stack.enter_context(
            contextlib.closing(Copy(tree, tmp_path_factory.mktemp("copies") / "0", libraries))
        )


def test_a_module_of_the_tree_is_that_of_the_tree_whatever_is_installed(tree: Path, copy: Callable[..., Copy]) -> None:
    (tree / "studio").mkdir()
    (tree / "morph_core").mkdir()
    (tree / "morph_core/__init__.py").write_text("ONE = 1\n")  # that which is installed is loaded as Python starts
    (tree / "studio/thing.py").write_text("from morph_core import ONE\n\ntwo = ONE + 1\n")
    (tree / "test_thing.py").write_text("def test():\n    from studio.thing import two\n\n    assert two == 2\n")
    there = copy()
    assert there.run_tests(["test_thing.py"])[0] == 0
    assert verdict(Mutant("morph_core/__init__.py", "ONE = 1", "ONE = 3", ("test_thing.py",)), there)[0] == "killed"
    assert verdict(Mutant("studio/thing.py", "ONE + 1", "ONE + 2", ("test_thing.py",)), there)[0] == "killed"
    assert there.run_tests(["test_thing.py"])[0] == 0


def test_one_that_is_loaded_from_elsewhere_proves_nothing(
    tree: Path, copy: Callable[..., Copy], tmp_path_factory: pytest.TempPathFactory
) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    (elsewhere / "thing.py").write_text((tree / "thing.py").read_text())
    text = (tree / "test_thing.py").read_text()
    (tree / "test_thing.py").write_text(f"import sys\n\nsys.path.insert(0, {str(elsewhere)!r})\n{text}")
    status, said = copy().run_tests(["test_thing.py"])
    assert status == 3
    assert said.endswith(f"thing was loaded from {elsewhere / 'thing.py'}\n")


def test_what_hangs_is_ended_with_all_that_it_has_started(tree: Path, copy: Callable[..., Copy]) -> None:
    (tree / "test_thing.py").write_text(
        "import pathlib, subprocess, time\n\ndef test():\n"
        "    child = subprocess.Popen(['sleep', '200'])\n"
        "    pathlib.Path('child').write_text(str(child.pid))\n"
        "    time.sleep(200)\n"
    )
    there = copy()
    for seconds in (1, 10, 100):  # on a busy machine a test may take long to begin
        assert there.run_tests(["test_thing.py"], seconds) == (None, f"not done after {seconds} s")
        if (there.path / "child").exists():
            break
    pid = int((there.path / "child").read_text())
    assert not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE


def test_the_libraries_are_there_before_a_test_asks_for_them(tree: Path, copy: Callable[..., Copy]) -> None:
    (tree / "test_thing.py").write_text("import sys\n\ndef test():\n    assert 'mailbox' in sys.modules\n")
    assert copy().run_tests(["test_thing.py"])[0] == 1
    assert copy("mailbox").run_tests(["test_thing.py"])[0] == 0


def test_where_all_are_killed_all_is_well(tree: Path) -> None:
    assert judge([HELD], tree, libraries=()) == 0


@pytest.mark.parametrize(
    ("mutant", "reason"),
    [
        (Mutant("thing.py", "3 + 3", "", ("test_thing.py",)), "stands 0 times in thing.py"),
        (Mutant("thing.py", "return", "", ("test_thing.py",)), "stands 2 times in thing.py"),
        (Mutant("gone.py", "1 + 1", "", ("test_thing.py",)), "stands 0 times in gone.py"),
        (Mutant("thing.py", "1 + 1", "", ("test_thing.py::test_gone",)), "no test test_thing.py::test_gone"),
        (Mutant("thing.py", "1 + 1", "", ("test_gone.py",)), "no test test_gone.py"),
    ],
)
def test_a_mutant_that_no_longer_fits_is_as_bad_as_one_that_lives(
    tree: Path, capsys: pytest.CaptureFixture[str], mutant: Mutant, reason: str
) -> None:
    assert reason in (stale(mutant, tree) or "")
    assert judge([mutant], tree, libraries=()) == 1
    assert capsys.readouterr().out.endswith("1 STALE\n")


def test_tests_that_fail_without_a_mutant_prove_nothing(tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tree / "test_thing.py").write_text("def test_held():\n    assert False\n")
    assert judge([HELD], tree, libraries=()) == 1
    said = capsys.readouterr().out
    assert "assert False" in said
    assert "killed" not in said


def test_a_sample_is_of_those_that_fit_and_the_same_for_a_seed() -> None:
    fitting = chosen(MUTANTS, "rollout", None, None)
    assert fitting
    assert all("rollout" in m.file + m.old for m in fitting)
    assert chosen(MUTANTS, None, 10, 3) == chosen(MUTANTS, None, 10, 3) != chosen(MUTANTS, None, 10, 4)
    assert len(chosen(MUTANTS, "rollout", 2, 0)) == 2
