"""evolution.html in a real browser without a network: scrubbed, played and steered, on a desk and on a phone."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page, expect
from test_accessibility import grave

from morph_core.catalogue import make_task
from morph_core.history import History
from morph_core.protocol import Evaluation, Progress
from morph_core.run_folder import EventLog, RunFolder, write_episode
from studio.show.evolution import build_evolution
from tests.hands import trained_design, write_hand_run

pytestmark = pytest.mark.browser
Opened = Callable[[Path], None]
STATE = """show.ready.then(({ place, mode, time, frames, runners, span }) => ({
    place, mode, time, frames, span, iterations: runners.map(({ iteration }) => iteration),
}))"""


def wait_until(page: Page, condition: str) -> None:
    """Wait until a function of the page's evolution says yes; the page lets no text be made a program in between."""
    page.evaluate(f"""show.ready.then((evolution) => new Promise((go) => {{
        (function look() {{ ({condition})(evolution) ? go() : setTimeout(look, 50); }})();
    }}))""")


def write_evolution(runs: Path, name: str, iterations: int) -> RunFolder:
    """Return a run of the pen whose first finger grows with each iteration, with an episode in every fifth."""
    task, phi = make_task("pen_press"), trained_design("pen_press")
    folder = write_hand_run(runs, "pen_press", phi, name)
    log = EventLog(folder)
    for i in range(2, iterations + 1):
        grown = [*phi[:4], 0.1 + 0.01 * i, *phi[5:]]
        log.append(
            Progress(
                iteration=i, env_steps=5120 * i, phi=grown, episode_return=1.0, success=0.9, policy_std=0.5,
                cosine=float(np.sin(i)), divergence=10.0**-i,
            )
        )  # fmt: skip
        if i % 5 == 0:
            start = task.qpos(task.reset(task.hw_phy(np.array(grown)), 1, np.random.default_rng(0)))
            qpos = np.repeat(start, 41, 0)
            qpos[:, 0] -= np.linspace(0, 0.05, 41)
            episode = write_episode(folder, i, {"qpos": qpos, "phi": np.array(grown)})
            log.append(
                Evaluation(
                    iteration=i, env_steps=5120 * i, phi=grown, sampled_success=i / 20, sampled_return=i,
                    deterministic_success=0.5, deterministic_return=i + 1, episode=episode,
                )
            )  # fmt: skip
    log.close()
    return folder


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a page of one run and a page of two."""
    folder = tmp_path_factory.mktemp("pages")
    runs = [History(write_evolution(folder, name, n)) for name, n in (("long", 12), ("short", 6))]
    for name, shown in (("one", runs[:1]), ("two", runs)):
        (folder / f"{name}.html").write_bytes(build_evolution(shown).content)
    return folder / "one.html", folder / "two.html"


def state(page: Page) -> Any:
    return page.evaluate(STATE)


def drawn_half_length(page: Page) -> float:
    """Return half of the length (m) with which the first finger's link stands in the picture that comes next."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return page.evaluate(
        """show.ready.then(({ actors: [{ run: { cast: { parts } }, shapes }] }) =>
            shapes[parts.findIndex(({ name }) => name === 'finger_1_distal')].userData.half)"""
    )


def test_a_person_scrubs_plays_and_reads(pages: tuple[Path, Path], opened: Opened, page: Page) -> None:
    opened(pages[0])
    assert state(page)["mode"] == "evolution", "it plays by itself"
    page.keyboard.press("End")
    assert state(page)["iterations"] == [12]
    assert state(page)["mode"] == ""
    caption = page.locator(".caption")
    expect(caption).to_contain_text("Iteration 12 of 12 · 61.4 k steps")
    expect(caption).to_contain_text("success 50 % sampled, 50 % with the mean action, in iteration 10")
    expect(page.get_by_role("row", name="length finger 1")).to_contain_text("22.0")  # cm

    page.keyboard.press("ArrowLeft")
    assert state(page)["iterations"] == [11]
    page.keyboard.press("[")
    assert state(page)["iterations"] == [10]
    page.keyboard.press("Home")
    expect(caption).to_contain_text("Initial design")
    initial = drawn_half_length(page)
    page.get_by_label("Iteration that is shown").fill("12")
    assert state(page)["iterations"] == [12]
    assert drawn_half_length(page) == pytest.approx(0.11)
    assert initial != pytest.approx(0.11)

    plot = page.get_by_role("img", name="Return on Hw-Phy").bounding_box()
    assert plot is not None
    middle = plot["x"] + 50 + (plot["width"] - 60) * 0.5, plot["y"] + 60
    page.mouse.move(*middle)
    page.mouse.down()
    assert state(page)["iterations"] == [6]
    page.mouse.move(middle[0] + (plot["width"] - 60) / 3, middle[1])
    assert state(page)["iterations"] == [10]
    page.mouse.up()

    page.keyboard.press("e")
    expect(caption).to_contain_text("plays the episode of iteration 10")
    wait_until(page, "({ time }) => time > 0.2")
    page.keyboard.press("e")
    assert state(page)["mode"] == ""
    page.select_option("#axis", "env_steps")
    assert state(page)["place"] == 51200
    page.select_option("#pace", "10")
    page.keyboard.press("Home")
    page.keyboard.press(" ")
    wait_until(page, "({ place }) => place > 5120")


def test_runs_side_by_side_share_one_place(pages: tuple[Path, Path], opened: Opened, page: Page) -> None:
    page.set_viewport_size({"width": 400, "height": 800})
    opened(pages[1])
    page.keyboard.press("End")
    assert state(page)["iterations"] == [12, 6]
    expect(page.locator(".caption").nth(1)).to_contain_text("B · short")
    page.locator("#place").fill("3")
    assert state(page)["iterations"] == [3, 3]
    expect(page.locator("#legend")).to_contain_text("A: long, direct, seed 0")
    expect(page.get_by_role("img", name="Design φ: length, finger 1")).to_be_visible()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "a phone is wide enough"
    assert grave(page) == {}


@pytest.mark.parametrize("hidden", ["HTMLCanvasElement.prototype.getContext = () => null"])
def test_without_webgl_the_picture_the_traces_and_the_table_are_there(
    hidden: str, pages: tuple[Path, Path], opened: Opened, page: Page
) -> None:
    page.add_init_script(f"{hidden}; delete globalThis.DecompressionStream")  # nor can it unpack by itself
    opened(pages[0])
    expect(page.locator("#note")).to_contain_text("This browser has no WebGL, so that no body moves here.")
    expect(page.get_by_alt_text("the design of iteration")).to_be_visible()
    page.keyboard.press("End")
    expect(page.locator(".caption")).to_contain_text("Iteration 12 of 12")
    expect(page.get_by_role("img", name="Success on Hw-Phy")).to_be_visible()
    expect(page.get_by_role("row", name="length finger 1")).to_contain_text("22.0")
