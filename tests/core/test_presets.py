"""A preset is the same settings at every door, and what is asked for beside it is laid over it."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morph_core.catalogue import METHODS, TASKS, make_method, make_task
from morph_core.config import flattened, paths_of, recorded
from morph_core.presets import PRESETS, with_preset

TASK_NAMES = ("reacher", "pen_press", "mouse_click")


@pytest.mark.parametrize("task", TASK_NAMES)
@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_every_preset_can_be_had_on_every_task(preset: str, task: str) -> None:
    made = make_task(task)
    method = make_method(None, made, preset=preset)
    assert method.name == PRESETS[preset].method
    assert dict(paths_of(method)).items() >= PRESETS[preset].settings_for(made).items()


@pytest.mark.parametrize("task", TASK_NAMES)
def test_the_preset_studio_is_the_defaults(task: str) -> None:
    made = make_task(task)
    assert make_method(None, made, preset="studio") == make_method("morph", made) == make_method(None, made)


def test_the_preset_paper_is_algorithm_1() -> None:
    method: Any = make_method(None, make_task("reacher"), preset="paper")
    assert method.exploration.name == "gaussian"
    assert method.search.name == "cma"
    assert method.projection == "one_sided"
    assert method.alpha == 1.0
    assert method.freeze_success == 0.8


@pytest.mark.parametrize("task", ["pen_press", "mouse_click"])
def test_on_the_hands_the_preset_paper_is_cma_es_too_but_not_drawn_by_contact(task: str) -> None:
    method: Any = make_method(None, make_task(task), preset="paper")
    assert (method.exploration.name, method.search.name) == ("design", "cma_debiased")
    assert (method.design_interval, method.exploration.kappa) == (4, 3.0)


@given(
    projection=st.sampled_from(["none", "one_sided", "as_printed"]), alpha=st.floats(0, 10), pairs=st.integers(1, 99)
)
def test_what_is_asked_for_is_laid_over_the_preset(projection: str, alpha: float, pairs: int) -> None:
    asked = {"projection": projection, "alpha": alpha, "search.pairs": pairs}
    found = flattened(recorded(make_method("morph", make_task("reacher"), asked, "paper")))
    assert found.items() >= asked.items()
    assert found["exploration"] == "gaussian"


def test_another_part_than_the_presets_has_its_own_settings() -> None:
    method: Any = make_method(None, make_task("reacher"), {"exploration": "design"}, "paper")
    assert method.exploration == type(method.exploration)()
    assert method.projection == "one_sided"


@pytest.mark.parametrize(("exploration", "kappa"), [("design", 3.0), ("gaussian", None)])
def test_what_the_preset_says_of_a_part_goes_with_that_part(exploration: str, kappa: float | None) -> None:
    laid = with_preset("paper", "morph", make_task("pen_press"), {"exploration": exploration})
    assert laid.get("exploration.kappa") == kappa
    assert laid["search"] == "cma_debiased"


def test_an_unknown_preset_lists_the_choices() -> None:
    with pytest.raises(ValueError, match='unknown preset "letter"; choose from: studio, paper'):
        make_method(None, make_task(next(iter(TASKS))), preset="letter")


@pytest.mark.parametrize("method", sorted(set(METHODS) - {"morph"}))
def test_a_preset_of_another_method_is_refused(method: str) -> None:
    with pytest.raises(ValueError, match=f"the preset paper is one of the method morph, not of {method}"):
        make_method(method, make_task("reacher"), preset="paper")
