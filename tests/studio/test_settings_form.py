"""The settings of a new run as a form: what is shown is what does something, and only what differs is asked for."""

from concurrent.futures import ThreadPoolExecutor

import pytest
from conftest import Page

from morph_core.catalogue import EXPLORATIONS, METHODS, SEARCHES, make_method, make_task
from morph_core.presets import PRESETS
from studio.fields import chosen_fields, told


def shown(page: Page) -> set[str]:
    form = page.viewer.start.settings
    return {path for path, handle in form._in_sight.items() if handle.visible} | set(form._more)


@pytest.mark.parametrize("method", sorted(METHODS))
@pytest.mark.parametrize("task", ["reacher", "pen_press"])
def test_every_setting_of_the_method_is_there_and_no_other(page: Page, task: str, method: str) -> None:
    form = page.viewer.start
    form.task.value, form.method.value = task, method
    made = make_task(task)
    assert shown(page) == {field.name for field in chosen_fields(make_method(method, made), made)}
    form.submit(None)
    assert (page.started[0].method, page.started[0].settings) == (method, {})


@pytest.mark.parametrize("method", sorted(METHODS))
def test_every_setting_is_explained_by_its_docstring(page: Page, method: str) -> None:
    form = page.viewer.start
    form.method.value = method
    made = make_task("reacher")
    hints = {name: handle.hint for name, handle in (form.settings._in_sight | form.settings._more).items()}
    for field in chosen_fields(make_method(method, made), made):
        assert hints[field.name] == told(field)
        assert field.doc


def test_the_hints_name_every_choice_of_an_exploration_and_a_search(page: Page) -> None:
    form = page.viewer.start.settings
    for handle, known in ((form.exploration, EXPLORATIONS), (form.search, SEARCHES)):
        ours = [choice for choice in handle.options if known[choice].__module__.startswith("morph_core.")]
        assert handle.hint is not None
        assert all(f"`{choice}`" in handle.hint for choice in ours)


def test_another_search_brings_its_own_settings_with_what_the_task_has_tuned(page: Page) -> None:
    form = page.viewer.start
    form.task.value = "pen_press"
    assert "search.ridge" in shown(page)
    form.settings.search.value = "cma"
    assert "search.ridge" not in shown(page)
    assert form.settings._more["search.population"].value == 10
    form.settings._more["search.population"].value = 16
    form.submit(None)
    assert page.started[0].settings == {"search": "cma", "search.population": 16}


def test_a_preset_fills_the_form_and_says_what_it_means(page: Page) -> None:
    form = page.viewer.start
    assert PRESETS["studio"].meaning in form.meaning.content
    form.preset.value = "paper"
    assert PRESETS["paper"].meaning.split("'")[0] in form.meaning.content
    assert (form.settings.exploration.value, form.settings.projection.value) == ("gaussian", "one_sided")
    assert form.settings._more["freeze_success"].value == 0.8
    form.settings.projection.value = "none"
    form.submit(None)
    assert (page.started[0].preset, page.started[0].settings) == ("paper", {"projection": "none"})


def test_a_method_without_presets_offers_none(page: Page) -> None:
    form = page.viewer.start
    form.preset.value, form.method.value = "paper", "direct"
    assert not form.preset.visible
    assert not form.meaning.visible
    form.submit(None)
    assert (page.started[0].method, page.started[0].preset) == ("direct", None)


def test_a_setting_outside_its_range_starts_nothing_and_says_what_is_allowed(page: Page) -> None:
    form = page.viewer.start
    form.settings._more["ppo.gamma"]._impl.value = 1.5
    form.submit(None)
    assert not page.started
    assert "ppo.gamma must lie in (0, 1]" in form.notice.content


def test_a_number_offers_the_range_that_its_field_has(page: Page) -> None:
    gamma = page.viewer.start.settings._more["ppo.gamma"]
    assert (gamma.min, gamma.max) == (0.0, 1.0)
    assert "Allowed: > 0, ≤ 1" in gamma.hint


def test_choices_that_come_at_once_leave_one_form(page: Page) -> None:
    form = page.viewer.start.settings
    with ThreadPoolExecutor(4) as pool:
        for chosen in [pool.submit(form._choose_part) for _ in range(12)]:
            chosen.result()
    assert len(form._folders) == len(form._slot._children)


def test_settings_that_are_read_while_they_are_made_anew_are_whole(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    form, seen = page.viewer.start.settings, list[set[str]]()
    before, add = set(form._more), form._add
    monkeypatch.setattr(form, "_add", lambda field: (seen.append(set(form._more)), add(field))[1])
    form.search.value = "drift"
    assert seen
    assert all(names == before for names in seen)
