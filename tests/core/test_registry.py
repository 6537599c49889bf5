"""What an installed package adds is found by its entry points; what can't be used is named with the reason."""

import copy
import sys
import textwrap
import threading
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from morph_core import catalogue
from morph_core.catalogue import EXPLORATIONS, METHODS, SEARCHES, TASKS, broken_plugins, make_method, make_task
from morph_core.registry import Broken, Registry
from morph_core.search import Problem, Search
from morph_core.tasks.reacher import Reacher

Install = Callable[..., str]

NEWTON = """
    from dataclasses import dataclass
    from typing import ClassVar
    from morph_core.config import Positive
    from morph_core.search import Search

    @dataclass(frozen=True)
    class Newton(Search):
        damping: Positive = 1.0
        name: ClassVar[str] = "newton"

        def candidates(self, problem):
            return problem.start[None]
"""
PLUGINS = {
    "morph.searches": ("newton", NEWTON, "Newton"),
    "morph.explorations": (
        "wide",
        """
        from dataclasses import dataclass
        from typing import ClassVar
        from morph_core.explorations.design import Design

        @dataclass(frozen=True)
        class Wide(Design):
            sigma: float = 3.0
            name: ClassVar[str] = "wide"
        """,
        "Wide",
    ),
    "morph.methods": (
        "patient",
        """
        from dataclasses import dataclass
        from typing import ClassVar
        from morph_core.methods.no_hw_opt import NoHwOpt

        @dataclass(frozen=True)
        class Patient(NoHwOpt):
            patience: int = 3
            name: ClassVar[str] = "patient"
            title: ClassVar[str] = "the policy waits"
        """,
        "Patient",
    ),
    "morph.tasks": (
        "stretch",
        """
        from dataclasses import dataclass
        from typing import ClassVar
        from morph_core.tasks.reacher import Reacher

        @dataclass(frozen=True)
        class Stretch(Reacher):
            name: ClassVar[str] = "stretch"
        """,
        "Stretch",
    ),
}
REGISTRIES: dict[str, Registry[Any]] = {r.group: r for r in (TASKS, METHODS, EXPLORATIONS, SEARCHES)}


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Return what installs a distribution of one module with one entry point, as pip would leave it."""
    monkeypatch.syspath_prepend(tmp_path)

    def install(
        group: str, name: str, source: str, attribute: str, package: str = "someones-robots", version: str = "1.0"
    ) -> str:
        module = f"plugin_{uuid.uuid4().hex}"
        (tmp_path / f"{module}.py").write_text(textwrap.dedent(source))
        folder = tmp_path / f"{package.replace('-', '_')}-{version}.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n")
        (folder / "entry_points.txt").write_text(f"[{group}]\n{name} = {module}:{attribute}\n")
        return module

    return install


def fresh(registry: Registry[Any]) -> Registry[Any]:
    """Return the registry as it is in a process that has not asked for anything yet."""
    again = copy.copy(registry)
    again._classes = None
    return again


def the_broken_one(registry: Registry[Any]) -> Broken:
    (broken,) = registry.broken
    return broken


@pytest.mark.parametrize("group", sorted(PLUGINS))
def test_what_an_entry_point_names_is_found_after_our_own(group: str, install: Install) -> None:
    name, source, attribute = PLUGINS[group]
    own = list(REGISTRIES[group])
    module = install(group, name, source, attribute)
    registry = fresh(REGISTRIES[group])
    assert module not in sys.modules  # nothing is imported before somebody asks
    assert list(registry) == [*own, name]
    assert registry[name].__module__ == module
    assert name in registry
    assert registry.broken == ()
    assert len(registry) == len(own) + 1


def test_an_installed_search_is_chosen_and_set_like_our_own(install: Install, monkeypatch: pytest.MonkeyPatch) -> None:
    install("morph.searches", *PLUGINS["morph.searches"])
    monkeypatch.setattr(catalogue, "SEARCHES", fresh(SEARCHES))
    method: Any = make_method("morph", make_task("reacher"), {"search": "newton", "search.damping": 2})
    assert (method.search.name, method.search.damping) == ("newton", 2.0)
    with pytest.raises(ValueError, match=r"^search\.damping must lie in \(0, 1000000\], not -1"):
        make_method("morph", settings={"search": "newton", "search.damping": -1})
    choices = "cma, cma_debiased, drift, gradient, newton"
    with pytest.raises(ValueError, match=f'unknown search "hill"; choose from: {choices}$'):
        make_method("morph", settings={"search": "hill"})
    with pytest.raises(ValueError, match=r'"search\.damping" does nothing with search cma, only with newton; choose'):
        make_method("morph", settings={"search.damping": 2})


@pytest.mark.parametrize("group", sorted(PLUGINS))
def test_an_unknown_name_lists_the_choices_those_installed_included(group: str, install: Install) -> None:
    name, source, attribute = PLUGINS[group]
    install(group, name, source, attribute)
    registry = fresh(REGISTRIES[group])
    noun = {"morph.searches": "search"}.get(group, group.removeprefix("morph.").removesuffix("s"))
    with pytest.raises(ValueError, match=f", {name}$") as refused:
        registry["nobody"]
    assert str(refused.value) == f'unknown {noun} "nobody"; choose from: {", ".join(registry)}'


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("raise RuntimeError('no licence found')", "RuntimeError: no licence found"),
        ("raise ValueError('the arm is not plugged in')", "the arm is not plugged in"),
        ("raise ValueError", "ValueError"),
        ("import a_module_that_nobody_has", "ModuleNotFoundError: No module named 'a_module_that_nobody_has'"),
        ("import sys; sys.exit('usage: newton')", "SystemExit: usage: newton"),
        ("def broken(:", "SyntaxError: invalid syntax"),
        ("def Newton(): ...", "<function Newton at .*> is not a frozen dataclass that inherits from"),
        ("Hooke = 1", "AttributeError: module '.*' has no attribute 'Newton'"),
    ],
)
def test_a_plug_in_that_raises_is_named_with_the_reason_and_harms_nothing(
    source: str, reason: str, install: Install
) -> None:
    install("morph.searches", "newton", source, "Newton")
    registry = fresh(SEARCHES)
    assert list(registry) == list(SEARCHES)
    broken = the_broken_one(registry)
    assert (broken.group, broken.name, broken.package) == ("morph.searches", "newton", "someones-robots 1.0")
    with pytest.raises(ValueError, match=f"^unknown search .*{reason}") as refused:
        registry["newton"]
    assert str(broken) in str(refused.value)
    assert str(broken) == f'"newton" of someones-robots 1.0 (morph.searches) can\'t be used: {broken.reason}'


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (("@dataclass(frozen=True)", ""), "is not a frozen dataclass that inherits from morph_core.search.Search"),
        (("(Search)", ""), "is not a frozen dataclass that inherits from morph_core.search.Search"),
        (("class Newton", "class Hooke"), "no attribute 'Newton'"),
        (("@dataclass(frozen=True)", "@dataclass"), "cannot inherit non-frozen dataclass from a frozen one"),
        (("def candidates", "def candidate"), "Newton lacks candidates"),
        (('"newton"', '"hooke"'), 'Newton calls itself "hooke", its entry point "newton"'),
        (('name: ClassVar[str] = "newton"', ""), 'Newton calls itself "None", its entry point "newton"'),
        (("damping: Positive = 1.0", "damping: Positive = -1.0"), r"^damping must lie in \(0, 1000000\], not -1"),
    ],
)
def test_a_plug_in_that_is_no_strategy_is_broken(change: tuple[str, str], reason: str, install: Install) -> None:
    assert change[0] in NEWTON
    install("morph.searches", "newton", NEWTON.replace(*change), "Newton")
    registry = fresh(SEARCHES)
    assert "newton" not in registry
    with pytest.raises(ValueError, match=reason):
        raise ValueError(the_broken_one(registry).reason)


def test_a_plug_in_without_defaults_is_broken(install: Install) -> None:
    source = NEWTON.replace("import dataclass", "import dataclass, field").replace("= 1.0", "= field(kw_only=True)")
    install("morph.searches", "newton", source, "Newton")
    assert "missing 1 required keyword-only argument: 'damping'" in the_broken_one(fresh(SEARCHES)).reason


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("observation_size: ClassVar[int] = 9", r"stretch: observe must be an array \(2, 9\), not \(2, 17\)"),
        ("horizon: ClassVar[int] = 0", "stretch: horizon and control_dt must be positive"),
        ("def observe(self, s): return super().observe(s).astype(float)", "stretch: observe must be float32"),
        ("def reset(self, *a): return super().reset(*a) * float('nan')", "stretch: reset must be finite"),
        ("title: ClassVar[str] = ''", "a task needs a title, and a name"),
        ("def qpos(self, s): return s", r"stretch: qpos must be \(1, 5\) as the scene has it, not \(1, 8\)"),
        ("def observe(self, s): return s.nothing", "AttributeError: 'numpy.ndarray' object has no attribute"),
    ],
)
def test_a_task_that_breaks_the_contract_is_broken(body: str, reason: str, install: Install) -> None:
    name, source, attribute = PLUGINS["morph.tasks"]
    install("morph.tasks", name, textwrap.dedent(source) + f"    {body}\n", attribute)
    registry = fresh(TASKS)
    assert list(registry) == list(TASKS)
    with pytest.raises(ValueError, match=reason):
        registry["stretch"]


def test_a_task_that_can_be_changed_after_it_is_made_is_broken(install: Install) -> None:
    source = """
    from dataclasses import dataclass
    from morph_core.task import Task

    @dataclass
    class Mutable(Task):
        name = "mutable"
    """
    install("morph.tasks", "mutable", source, "Mutable")
    assert "Mutable is not a frozen dataclass" in the_broken_one(fresh(TASKS)).reason


def test_of_two_plug_ins_of_one_name_both_are_named_and_neither_is_taken(install: Install) -> None:
    for package, version in (("someones-robots", "1.0"), ("anybodys-arms", "2.1")):
        install("morph.searches", "newton", NEWTON, "Newton", package, version)
    registry = fresh(SEARCHES)
    assert list(registry) == list(SEARCHES)
    assert {broken.package for broken in registry.broken} == {"someones-robots 1.0", "anybodys-arms 2.1"}
    both = "anybodys-arms 2.1 and someones-robots 1.0 have one of this name: uninstall one of them"
    assert {broken.reason for broken in registry.broken} == {both}
    with pytest.raises(ValueError, match=both):
        registry["newton"]


def test_a_name_of_ours_stays_ours(install: Install) -> None:
    module = install("morph.searches", "cma", NEWTON.replace('"newton"', '"cma"'), "Newton")
    registry = fresh(SEARCHES)
    assert registry["cma"] is SEARCHES["cma"]
    assert the_broken_one(registry).reason == "the name is taken by morph_core.searches.cma.Cma"
    assert the_broken_one(registry).package == "someones-robots 1.0"
    assert module not in sys.modules


def test_one_that_is_broken_leaves_the_others_usable(install: Install) -> None:
    install("morph.searches", "newton", NEWTON, "Newton")
    install("morph.searches", "hooke", "raise RuntimeError('no')", "Hooke", "anybodys-arms")
    registry = fresh(SEARCHES)
    assert "newton" in registry
    assert the_broken_one(registry).name == "hooke"


def test_everything_broken_is_listed_in_one_place(install: Install, monkeypatch: pytest.MonkeyPatch) -> None:
    for group, (name, _, attribute) in PLUGINS.items():
        install(group, name, "raise RuntimeError('no')", attribute, f"robots-{name}")
    for group, registry in REGISTRIES.items():
        monkeypatch.setattr(catalogue, group.removeprefix("morph.").upper(), fresh(registry))
    assert {(broken.group, broken.name) for broken in broken_plugins()} == {(g, p[0]) for g, p in PLUGINS.items()}


def test_a_plug_in_may_ask_what_there_is_while_it_is_imported(install: Install) -> None:
    source = "from morph_core.catalogue import TASKS\nKNOWN = list(TASKS)\n" + textwrap.dedent(NEWTON)
    install("morph.searches", "newton", source, "Newton")
    assert "newton" in fresh(SEARCHES)


def test_who_asks_from_another_thread_waits_for_all_of_them(install: Install) -> None:
    install("morph.searches", "newton", "import time\ntime.sleep(0.3)\n" + textwrap.dedent(NEWTON), "Newton")
    registry, seen = fresh(SEARCHES), []
    threads = [threading.Thread(target=lambda: seen.append("newton" in registry)) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert seen == [True] * 3


def test_a_class_of_this_process_can_be_added_once() -> None:
    registry = fresh(SEARCHES)

    @registry.add
    @dataclass(frozen=True)
    class Still(Search):
        """Stays where it is."""

        name: ClassVar[str] = "still"

        def candidates(self, problem: Problem) -> np.ndarray:
            return problem.start[None]

    assert registry["still"] is Still
    assert "still" not in SEARCHES
    with pytest.raises(ValueError, match=r'the name "still" is taken in morph\.searches by .*Still'):
        registry.add(Still)


def test_what_breaks_the_contract_can_not_be_added() -> None:
    @dataclass(frozen=True)
    class Endless(Reacher):
        """A task without steps."""

        name: ClassVar[str] = "endless"
        horizon: ClassVar[int] = 0

    registry = fresh(TASKS)
    with pytest.raises(ValueError, match="horizon and control_dt must be positive"):
        registry.add(Endless)
    assert "endless" not in registry
