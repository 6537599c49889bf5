"""hand.html in a real browser without a network: it runs as Python runs, can be steered, and says what is missing."""

import base64
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from playwright.sync_api import Page, expect
from test_accessibility import grave

from morph_core.history import History
from morph_core.tasks.grasp import GraspTask
from studio.export.bundle import task_of
from studio.export.policy import policy_at
from studio.show.hand import hand_of
from studio.show.page import build_page
from tests.hands import trained_design, write_trained_run

pytestmark = pytest.mark.browser
STARTS = 20
UNTOUCHED = 1e-6
"""m and rad: how far joints may be apart after the first control step, before anything has touched anything."""
OBJECT_MEDIAN = 0.003
"""m: how far the object may be apart after a whole try, in half of the tries: contacts multiply rounding."""
Opened = Callable[[Path], None]


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, History]]:
    made = {}
    for task in ("pen_press", "mouse_click"):
        folder = tmp_path_factory.mktemp(task)
        history = History(write_trained_run(folder, task))
        made[task] = folder / "hand.html", history
        made[task][0].write_bytes(build_page(history, "best").content)
    return made


def tries_in_python(history: History) -> tuple[list[dict[str, Any]], np.ndarray, np.ndarray]:
    """Return 20 starts as the page takes them, qpos (T, N, nq) as the exported scene counts it, and who succeeded."""
    task = task_of(history)
    assert isinstance(task, GraspTask)
    iteration, phi = history.design("best")
    policy = policy_at(history, iteration, phi)
    assert policy is not None
    physics, k = task.hw_phy(phi), task.hand.joints
    s = task.reset(physics, STARTS, np.random.default_rng(5))
    starts = [{"position": q[k : k + 2].tolist(), "turn": 2 * np.arctan2(q[k + 6], q[k + 3])} for q in task.qpos(s)]
    states, reached = [], []
    for _ in range(task.horizon):
        transition = task.step(physics, s, policy.act(task.observe(s), None))
        s = transition.s
        states.append(task.qpos(s).copy())
        reached.append(transition.success)
    qpos = np.array(states)
    qpos[..., :k] -= task.hand.start(phi)
    return starts, qpos, task.solved(np.array(reached))


@pytest.mark.parametrize("task", ["pen_press", "mouse_click"])
def test_twenty_tries_end_as_they_do_in_python(
    task: str, pages: dict[str, tuple[Path, History]], opened: Opened, page: Page
) -> None:
    path, history = pages[task]
    starts, expected, solved = tries_in_python(history)
    opened(path)
    tries = page.evaluate("starts => show.tries(starts)", starts)
    found = np.array([one["states"] for one in tries]).swapaxes(0, 1)
    k = expected.shape[2] - 8
    apart = np.abs(found - expected)
    assert apart[0].max() < UNTOUCHED
    assert np.median(apart[-1, :, k : k + 3].max(1)) < OBJECT_MEDIAN
    succeeded = np.array([one["solved"] for one in tries])
    assert solved.mean() >= 0.9  # or agreement would say little
    share = (solved.sum() + succeeded.sum() + 1) / (2 * STARTS + 2)
    by_chance = 3 * np.sqrt(share * (1 - share) * 2 / STARTS) + 1 / STARTS
    assert abs(solved.mean() - succeeded.mean()) <= by_chance


@pytest.mark.parametrize("task", ["pen_press", "mouse_click"])
def test_the_hand_of_another_phi_is_the_one_that_is_exported(
    task: str, pages: dict[str, tuple[Path, History]], opened: Opened, page: Page
) -> None:
    path, history = pages[task]
    made, rng = task_of(history), np.random.default_rng(3)
    assert isinstance(made, GraspTask)
    n = made.hand.fingers
    opened(path)
    for _ in range(3):
        phi = np.concatenate([rng.uniform(-0.3, 0.3, n), rng.uniform(0.02, 0.4, n)])
        built = page.evaluate("phi => show.shaped(phi)", phi.tolist())
        exported = hand_of(history, made, 1, phi)
        one, other = read(built), read(exported)
        for field in ("body_mass", "body_pos", "body_ipos", "jnt_range", "actuator_ctrlrange", "key_qpos"):
            np.testing.assert_allclose(getattr(one, field), getattr(other, field), atol=1e-9, err_msg=field)
        np.testing.assert_allclose(inertias(one), inertias(other), atol=1e-12)
        np.testing.assert_allclose(np.abs((one.body_quat * other.body_quat).sum(1)), 1, atol=1e-12)
        solid = other.geom_contype + other.geom_conaffinity > 0
        np.testing.assert_allclose(one.geom_size[solid], other.geom_size[solid], atol=1e-9)
        np.testing.assert_allclose(one.geom_pos[solid], other.geom_pos[solid], atol=1e-9)
        assert built["middle"] == pytest.approx(exported["middle"], abs=1e-9)


def read(design: dict[str, Any]) -> mujoco.MjModel:
    files = {path: base64.b64decode(content) for path, content in design["files"].items()}
    return mujoco.MjModel.from_xml_string(design["xml"], files)


def inertias(model: mujoco.MjModel) -> np.ndarray:
    """Return the inertia of each body about its centre of mass, in its own frame (nbody, 3, 3)."""
    turned = np.empty((model.nbody, 9))
    for matrix, quaternion in zip(turned, model.body_iquat, strict=True):
        mujoco.mju_quat2Mat(matrix, quaternion)
    axes = turned.reshape(-1, 3, 3)
    return np.einsum("bij,bj,bkj->bik", axes, model.body_inertia, axes)


def test_a_slider_builds_the_hand_and_says_what_cannot_be_built(
    pages: dict[str, tuple[Path, History]], opened: Opened, page: Page
) -> None:
    opened(pages["pen_press"][0])
    assert grave(page) == {}
    page.get_by_label("length_1 in m").fill("0.3")
    expect(page.locator("#phi-note")).to_contain_text("not trained for this body")
    length = "show.ready.then(({ shown: [{ world }] }) => -world.model.body_pos[3 * world.body('finger_1_distal') + 2])"
    assert page.evaluate(length) == pytest.approx(0.3)
    page.get_by_label("placement_1 in rad").fill("1.5")
    expect(page.locator("#phi-note")).to_contain_text("Fingers 1 and 2 would stand 2.8 mm apart on the palm, 30.0 mm")
    page.get_by_role("button", name="Back to the run's design").click()
    assert page.evaluate(length) == pytest.approx(trained_design("pen_press")[4])
    expect(page.locator("#phi-note")).to_be_empty()


def test_a_person_watches_steers_and_compares(
    pages: dict[str, tuple[Path, History]], opened: Opened, page: Page
) -> None:
    opened(pages["pen_press"][0])
    page.evaluate("show.ready.then((s) => s.tryAnew({ position: [0, 0], turn: 0 }))")  # others may fail
    label = page.locator("#label-0")
    expect(label.locator(".tally")).to_contain_text("1 of 1 tries (100 %)")
    page.keyboard.press(" ")
    expect(page.locator("#run")).to_contain_text("Start")
    before = page.evaluate("show.ready.then((s) => s.simulated)")
    page.wait_for_timeout(300)
    assert page.evaluate("show.ready.then((s) => s.simulated)") == before

    page.keyboard.press("r")
    expect(page.locator("#time")).to_contain_text("0.0 of 4 s")
    page.select_option("#speed", "0.1")
    page.get_by_label("Beside the initial design").check()
    expect(page.locator("#label-1")).to_contain_text("Initial")
    page.get_by_role("button", name="Push").click()
    page.wait_for_function(
        """show.ready.then((s) => s.shown.length === 2 && s.shown.every(
            ({ world: { disturbed, data } }) => disturbed && data.qvel.slice(9, 11).some((v) => Math.abs(v) > 0.01)
        ))"""
    )


def test_a_dragged_object_follows_the_pointer(
    pages: dict[str, tuple[Path, History]], opened: Opened, page: Page
) -> None:
    opened(pages["pen_press"][0])
    page.evaluate("""show.ready.then((s) => {
        s.run(false);
        s.shown[0].world.policy = null; // the hand holds still
        s.tryAnew({ position: [0, 0], turn: 0 });
        s.stage.draw();
    })""")
    where = """show.ready.then(({ stage, shown }) => {
        const box = stage.canvas.getBoundingClientRect();
        const at = new THREE.Vector3(-0.2, -0.03, 0.03).project(stage.camera);
        return [box.left + (at.x + 1) / 2 * box.width, box.top + (1 - at.y) / 2 * box.height];
    })"""
    x, y = page.evaluate(where)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 60, y - 90, steps=4)
    for _ in range(150):
        page.evaluate("show.ready.then((s) => s.step())")
    way = """show.ready.then(({ shown: [{ forces }] }) => {
        const there = forces.point();
        return forces.held.target.map((x, i) => x - there[i]);
    })"""
    assert np.linalg.norm(page.evaluate(way)) < 0.08  # m: the pen's weight stretches the spring by half of this
    assert page.evaluate("show.ready.then(({ shown: [{ world }] }) => world.disturbed && !world.diverged)")
    page.mouse.up()
    assert page.evaluate("show.ready.then(({ shown: [{ forces }] }) => forces.held)") is None


def test_a_picture_is_as_good_as_there_is_time_and_none_is_drawn_in_vain(
    pages: dict[str, tuple[Path, History]], opened: Opened, page: Page
) -> None:
    opened(pages["pen_press"][0])
    page.evaluate("""show.ready.then((s) => {
        globalThis.seen = s;
        s.run(false);
        Object.assign(s.stage, { quality: s.stage.best, simplest: 4, frames: [], before: null, calm: 0, patience: 12 });
    })""")
    page.evaluate("new Promise((go) => { (function look() { seen.stage.fine ? go() : setTimeout(look, 50); })(); })")
    stage = "(({ stage: { quality, best, fine }, frames }) => ({ quality, best, fine, frames }))(seen)"
    at_rest = page.evaluate(stage)
    page.wait_for_timeout(300)
    assert page.evaluate(stage) == at_rest, "what rests is not drawn again"

    def look(ms: float, times: int = 1) -> int:
        """Return how much simpler the picture is after looks at frames that take so long."""
        page.evaluate(f"for (let i = 0; i < {45 * times}; i++) seen.stage.pace({ms})")
        now = page.evaluate(stage)
        return now["quality"] - now["best"]

    assert [look(40), look(30), look(16, 11), look(16), look(40), look(39), look(39)] == [1, 2, 2, 1, 2, 1, 1]

    page.evaluate("globalThis.graphics = seen.stage.renderer.getContext().getExtension('WEBGL_lose_context')")
    page.evaluate("graphics.loseContext()")
    expect(page.locator("#note")).to_contain_text("The browser has taken the graphics away from this page")
    expect(page.get_by_alt_text("The hand in its start posture")).to_be_visible()
    page.evaluate("graphics.restoreContext()")
    expect(page.locator("#note")).to_be_empty()
    expect(page.locator("#run")).to_be_visible()


@pytest.mark.parametrize(
    ("hidden", "sentence"),
    [
        ("HTMLCanvasElement.prototype.getContext = () => null", "This browser has no WebGL"),
        ("delete globalThis.WebAssembly", "This browser has no WebAssembly"),
    ],
)
def test_a_browser_that_lacks_something_shows_the_picture_and_says_so(
    hidden: str, sentence: str, pages: dict[str, tuple[Path, History]], opened: Opened, page: Page
) -> None:
    page.add_init_script(hidden)
    opened(pages["pen_press"][0])
    expect(page.locator("#note")).to_contain_text(sentence)
    expect(page.get_by_alt_text("The hand in its start posture")).to_be_visible()
    expect(page.get_by_role("row", name="length_1")).to_be_visible()
    expect(page.locator("#run")).to_be_hidden()
