"""What can be set: under dotted names or nested, in its range, and only where it does something."""

import copy
import dataclasses
import json
import math
import re
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from morph_core import catalogue
from morph_core.catalogue import (
    EXPLORATIONS,
    METHODS,
    SEARCHES,
    TASKS,
    alternatives,
    configured,
    make_method,
    make_task,
    read_method,
)
from morph_core.config import LARGEST, Settings, check_value, flattened, kinds_of, limits, paths_of, range_of, recorded
from morph_core.format_1 import RENAMED
from morph_core.method import Method
from morph_core.methods.direct import Direct
from morph_core.methods.no_hw_opt import NoHwOpt
from morph_core.methods.proxy import Morph
from morph_core.parts import Evaluation, Ppo, ProxyFit, Schedule
from morph_core.protocol import FORMAT, RunRecord
from morph_core.search import Search
from morph_core.searches.cma import Cma
from morph_core.searches.drift import Drift
from morph_core.spread import ExploredDesigns

PEN, REACHER = make_task("pen_press"), make_task("reacher")


def choices() -> list[Method]:
    """Return every method with every exploration and search it can have, each with its defaults."""
    found: list[Method] = []
    for name in METHODS:
        method = METHODS[name]()
        if not isinstance(method, Morph):
            found.append(method)
            continue
        found += [
            dataclasses.replace(method, exploration=EXPLORATIONS[exploration](), search=SEARCHES[search]())
            for exploration in EXPLORATIONS
            for search in SEARCHES
        ]
    return found


def annotated(settings: Settings, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the annotation of every value that can be set, but for those that choose a part."""
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if isinstance(value, Settings):
            yield from annotated(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, kinds_of(type(settings))[field.name]


def id_of(method: Method) -> str:
    return "-".join([method.name, *(part.name for part in vars(method).values() if hasattr(part, "name"))])


CHOICES = choices()
EVERYTHING = sorted({path for method in CHOICES for path, _ in paths_of(method)})
every_choice = pytest.mark.parametrize("method", CHOICES, ids=id_of)


@st.composite
def changed(draw: st.DrawFn) -> Method:
    """Draw a method with some of its settings changed to others that are allowed."""
    method = draw(st.sampled_from(CHOICES))
    settings: dict[str, object] = {}
    for name, kind in annotated(method):
        bare, meta = range_of(kind)
        if not draw(st.booleans()):
            continue
        if words := typing.get_args(bare):
            settings[name] = draw(st.sampled_from(words))
            continue
        assert meta is not None
        low = (meta.ge if meta.gt is None else meta.gt + 1e-6) or 0
        step = meta.multiple_of or 1
        high = meta.le if meta.le is not None else low + 1000
        if bare is int:
            settings[name] = step * draw(st.integers(math.ceil(low / step), int(high // step)))
        else:
            settings[name] = draw(st.floats(low, high))
    return configured(method, settings)


def test_there_are_as_many_choices_as_parts_together() -> None:
    assert {id_of(method) for method in CHOICES} >= {
        "morph-design-cma", "morph-gaussian-cma", "morph-design-cma_debiased", "morph-design-drift",
        "morph-design-gradient", "direct", "no_hw_opt", "cmaes_rl", "transform2act", "value_gradient",
    }  # fmt: skip


# --- names ---


@every_choice
def test_setting_what_is_set_already_changes_nothing(method: Method) -> None:
    for name, value in paths_of(method):
        assert configured(method, {name: value}) == method
    assert configured(method, dict(paths_of(method))) == method


@every_choice
def test_what_does_nothing_here_is_refused_with_what_does_something(method: Method) -> None:
    allowed = dict(paths_of(method))
    for name in set(EVERYTHING) - set(allowed):
        with pytest.raises(ValueError, match=f'^"{re.escape(name)}" does nothing (with|for) ') as refused:
            configured(method, {name: 1})
        listed = str(refused.value).partition("choose from: ")[2].split(", ")
        assert set(listed) <= set(allowed)
        assert listed


@every_choice
def test_a_name_that_is_none_is_refused_with_all_that_are(method: Method) -> None:
    for name in ("", "colour", "ppo.colour", "search.colour", "ppo.", ".ppo", "name", "search.name"):
        with pytest.raises(ValueError, match=f'^unknown setting "{re.escape(name)}".*; choose from: ') as refused:
            configured(method, {name: 1})
        assert str(refused.value).partition("choose from: ")[2] == ", ".join(dict(paths_of(method)))


def test_a_setting_that_does_nothing_says_where_it_does_something() -> None:
    with pytest.raises(ValueError, match=r'^"search\.ridge" does nothing with search cma, only with drift; choose'):
        make_method("morph", settings={"search.ridge": 2.5})
    with pytest.raises(ValueError, match=r'^"exploration\.kappa" does nothing with exploration gaussian, only with d'):
        make_method("morph", settings={"exploration": "gaussian", "exploration.kappa": 1.0})
    with pytest.raises(ValueError, match=r'^"search\.ridge" does nothing for direct, only for morph; choose from'):
        make_method("direct", settings={"search.ridge": 2.5})
    with pytest.raises(ValueError, match=r'^"freeze_success" does nothing for no_hw_opt, only for morph or direct'):
        make_method("no_hw_opt", settings={"freeze_success": 0.5})
    with pytest.raises(ValueError, match=r'^"step" does nothing for morph, only for direct or value_gradient; '):
        make_method("morph", settings={"step": 0.5})


@pytest.mark.parametrize("old", sorted(RENAMED))
def test_an_old_name_says_what_it_is_called_now(old: str) -> None:
    with pytest.raises(ValueError, match=f'^"{old}" is called {re.escape(" or ".join(RENAMED[old]))} now; choose'):
        make_method("morph", settings={old: 1})


def test_a_part_that_leaves_no_choice_says_what_is_in_it() -> None:
    with pytest.raises(ValueError, match=r'^"schedule" has settings of its own; choose from: schedule\.iterations$'):
        make_method("morph", settings={"schedule": "long"})


@pytest.mark.parametrize("wanted", [None, 5, ["cma"], "newton", ""])
def test_a_choice_that_is_none_lists_the_choices(wanted: object) -> None:
    with pytest.raises(ValueError, match=r"^unknown search \".*\"; choose from: cma, cma_debiased, drift, gradient$"):
        make_method("morph", settings={"search": wanted})


def test_unknown_methods_tasks_and_options_list_the_choices() -> None:
    methods = "morph, cmaes_rl, direct, no_hw_opt, transform2act, value_gradient"
    with pytest.raises(ValueError, match=rf'^unknown method "cmaes"; choose from: {methods}$'):
        make_method("cmaes")
    with pytest.raises(ValueError, match=r'^unknown task "reach"; choose from: reacher, pen_press, mouse_click$'):
        make_task("reach")
    with pytest.raises(ValueError, match=r'^reacher has no option "colour"; choose from: tunnel, z, action_scale, '):
        make_task("reacher", {"colour": "red"})


def test_dotted_and_nested_settings_are_the_same() -> None:
    dotted = {"ppo.gamma": 0.9, "search": "drift", "search.ridge": 2.5, "alpha": 2}
    nested = {"ppo": {"gamma": 0.9}, "search": {"name": "drift", "ridge": 2.5}, "alpha": 2}
    wanted = Morph(ppo=Ppo(gamma=0.9), search=Drift(ridge=2.5), alpha=2.0)
    assert make_method("morph", settings=dotted) == make_method("morph", settings=nested) == wanted
    backwards = dict(reversed(dotted.items()))
    assert make_method("morph", settings=backwards) == wanted


# --- ranges ---


@every_choice
def test_values_outside_their_range_are_refused_under_their_whole_name(method: Method) -> None:
    for name, kind in annotated(method):
        bare, meta = range_of(kind)
        if typing.get_args(bare):
            with pytest.raises(ValueError, match=f'^unknown {re.escape(name)} "none of them"; choose from: '):
                configured(method, {name: "none of them"})
            continue
        assert meta is not None, f"{name} has no range"
        outside = [meta.gt] if meta.gt is not None else [meta.ge - 1 if meta.ge is not None else None]
        outside += [meta.le + 1 if meta.le is not None else None, meta.multiple_of and 2 * meta.multiple_of + 1]
        for value in [value for value in outside if value is not None]:
            with pytest.raises(ValueError, match=f"^{re.escape(name)} must (lie in|be|not be) .*, not "):
                configured(method, {name: value})
        for value, wanted in ((math.nan, "a whole number" if bare is int else "finite"), ("1", "a"), (True, "a")):
            with pytest.raises(ValueError, match=f"^{re.escape(name)} must be {wanted}"):
                configured(method, {name: value})


def numbers_of(owner: Any) -> dict[tuple[type, str], Any]:
    """Return the annotation of every number that can be set in a dataclass, by the class and the field's name."""
    kinds = kinds_of(type(owner))
    names = [field.name for field in dataclasses.fields(owner) if field.init]
    return {(type(owner), n): kinds[n] for n in names if type(getattr(owner, n)) in (int, float)}


EVERY_SETTING: dict[tuple[type, str], Any] = {}
for chosen in CHOICES:
    for owner in (chosen, *(part for part in vars(chosen).values() if isinstance(part, Settings))):
        EVERY_SETTING |= numbers_of(owner)
EVERY_OPTION = {where: kind for task in TASKS for where, kind in numbers_of(make_task(task)).items()}


@pytest.mark.parametrize(
    ("owner", "name", "kind"),
    [(*where, kind) for where, kind in (EVERY_SETTING | EVERY_OPTION).items()],
    ids=[f"{owner.__name__}.{name}" for owner, name in EVERY_SETTING | EVERY_OPTION],
)
def test_every_number_that_can_be_set_has_both_ends_and_a_reason_for_the_upper_one(
    owner: type, name: str, kind: object
) -> None:
    bare, meta = range_of(kind)
    lo, hi = limits(meta)
    assert meta is not None
    assert lo is not None
    assert hi is not None
    assert -LARGEST <= lo < hi < 1e10
    assert meta.description
    usual = getattr(owner(), name)
    assert check_value(name, kind, usual) == usual
    for value in (hi + 1, 10**18, 1e308, 1e39, 10**400, -(10**400), math.inf):
        with pytest.raises(ValueError, match=f"^{name} must (lie in|be|not be) "):
            check_value(name, kind, value)
    with pytest.raises(ValueError, match=re.escape(f": {meta.description}")):
        check_value(name, kind, bare(hi + 1))


def test_there_are_as_many_numbers_to_set_as_there_are() -> None:
    assert len(EVERY_SETTING) > 60
    assert len(EVERY_OPTION) > 40


# --- records ---


@given(changed())
def test_what_was_recorded_is_read_as_it_was(method: Method) -> None:
    written = json.loads(json.dumps(recorded(method)))
    assert flattened(written) == dict(paths_of(method))
    record = RunRecord(
        format=FORMAT, id="r", task="reacher", method=method.name, seed=0, iterations=1, config=written, parameters=[],
        versions={}, created=0.0,
    )  # fmt: skip
    assert read_method(msgspec.json.decode(msgspec.json.encode(record), type=RunRecord)) == method
    assert configured(METHODS[method.name](), written) == method


def test_a_recorded_setting_that_does_nothing_is_refused() -> None:
    config = recorded(Morph()) | {"colour": 1}
    record = RunRecord(
        format=FORMAT, id="r", task="reacher", method="morph", seed=0, iterations=1, config=config, parameters=[],
        versions={}, created=0.0,
    )  # fmt: skip
    with pytest.raises(ValueError, match='unknown setting "colour"'):
        read_method(record)


# --- what a task has tuned ---


def test_a_task_is_offered_what_it_can_run_and_nothing_else() -> None:
    offered = {}
    for task in (PEN, REACHER):
        method: Any = make_method("morph", task)
        offered[task.name] = alternatives(method.exploration, kinds_of(type(method))["exploration"], task)
    assert set(offered["pen_press"]) == {"design"}
    assert set(offered["reacher"]) == set(EXPLORATIONS)


def test_a_method_of_a_task_is_as_the_task_has_tuned_it() -> None:
    for task in (PEN, REACHER):
        tuned = {type(settings): settings for settings in task.tuned}
        for name in ("morph", "direct", "no_hw_opt"):
            assert make_method(name, task) == tuned[METHODS[name]] != METHODS[name]()
    assert make_method("morph") == Morph()


def test_another_search_is_the_one_that_the_task_has_tuned() -> None:
    method = make_method("morph", PEN, {"search": "cma", "search.sigma0": 0.3})
    tuned = next(settings for settings in PEN.tuned if isinstance(settings, Cma))
    assert isinstance(method, Morph)
    assert method.search == dataclasses.replace(tuned, sigma0=0.3)
    assert tuned != Cma()


def test_naming_the_search_that_is_there_keeps_what_is_tuned() -> None:
    assert make_method("morph", PEN, {"search": "drift"}) == make_method("morph", PEN)


@dataclass(frozen=True)
class Foreign(Method):
    """A method of which no task knows anything."""

    patience: int = 3
    designs: ExploredDesigns = ExploredDesigns()
    proxy: ProxyFit = ProxyFit()
    search: Search = Drift()

    name: ClassVar[str] = "foreign"
    title: ClassVar[str] = "waits"

    def iterations(self, task: object, state: object) -> Iterator[Any]:
        return iter(())


@pytest.fixture
def foreign(monkeypatch: pytest.MonkeyPatch) -> None:
    again = copy.copy(METHODS)
    again._classes = dict(again._loaded())
    again.add(Foreign)
    monkeypatch.setattr(catalogue, "METHODS", again)


@pytest.mark.usefixtures("foreign")
def test_a_method_that_the_task_does_not_know_gets_its_parts() -> None:
    method = make_method("foreign", PEN, {"patience": 5})
    assert isinstance(method, Foreign)
    morph, direct = (make_method(name, PEN) for name in ("morph", "direct"))
    assert isinstance(morph, Morph)
    assert isinstance(direct, Direct)
    for name in ("trajectories", "hidden", "schedule", "ppo", "evaluation"):
        assert getattr(method, name) == getattr(morph, name)
    assert method.hidden != NoHwOpt().hidden
    assert method.proxy == morph.proxy != ProxyFit()
    assert method.search == morph.search != Drift()
    assert method.designs == direct.designs != ExploredDesigns()
    assert method.patience == 5


@pytest.mark.usefixtures("foreign")
def test_where_nothing_is_tuned_a_method_has_its_own_defaults_and_else_the_tasks_parts() -> None:
    assert make_method("foreign") == Foreign()
    assert make_method("foreign", REACHER) == dataclasses.replace(Foreign(), ppo=make_method("direct", REACHER).ppo)
    assert (Foreign().schedule, Foreign().evaluation) == (Schedule(), Evaluation())
