"""What every task must keep: a task is done when this suite passes for it."""

import inspect

import mujoco
import numpy as np
import pytest

from morph_core.catalogue import METHODS, TASKS, make_method, make_task
from morph_core.contract import check_task
from morph_core.method import Method
from morph_core.registration import BUILT_IN
from morph_core.rollout import collect
from morph_core.state import start
from morph_core.task import Task
from tests.core.conftest import SMALL
from tests.foreign import Pointer

N = 6


@pytest.fixture(params=sorted(TASKS))
def listed(request: pytest.FixtureRequest) -> Task:
    """A task that has its line in `TASKS`."""
    return make_task(request.param)


@pytest.fixture(params=[*sorted(TASKS), Pointer.name])
def task(request: pytest.FixtureRequest) -> Task:
    """One of those, or a small one of another package that leans on the defaults of the protocol."""
    return Pointer() if request.param == Pointer.name else make_task(request.param)


def test_a_task_is_listed_by_its_name(listed: Task) -> None:
    assert listed.name in TASKS


def test_a_task_that_lacks_a_member_says_which() -> None:
    class Half(Pointer):
        observe = Task.observe

    with pytest.raises(TypeError, match="observe"):
        Half()


def test_what_a_small_task_leaves_out_has_a_default_that_suits() -> None:
    task, phi = Pointer(), np.full((3, 2), 0.3)
    assert (task.title, task.z_unit, task.z_scale, task.runs_on_proxy) == ("pointer", "", 1.0, True)
    assert task.initial_action.tolist() == [0, 0]
    assert task.buildable(phi).tolist() == [True] * 3
    assert task.solved(np.array([[True, False], [False, False]])).tolist() == [True, False]
    s, a = np.array([[0.3, -0.3]]), np.array([[0.3, 0.15]])
    np.testing.assert_allclose(task.proxy_input(s, a), [[0.1, -0.1, 1, 0.5]], rtol=1e-6)

    class Fragile(Pointer):
        def buildable(self, phi: np.ndarray) -> np.ndarray:
            return phi[..., 0] > 0.2

    Fragile().check_buildable(np.array([0.3, 0.1]))
    with pytest.raises(ValueError, match="pointer can't be put together"):
        Fragile().check_buildable(np.array([0.1, 0.3]))


def random_designs(task: Task, rng: np.random.Generator) -> np.ndarray:
    space = task.design_space
    return rng.uniform(space.lo, space.hi, (N, len(space)))


def test_names_units_and_the_initial_design_are_there(task: Task) -> None:
    assert task.title
    assert all(p.name and p.unit for p in task.design_space.parameters)
    task.design_space.check(task.design_space.initial)


def test_the_docstring_and_the_rule_of_success_are_one_sentence(task: Task) -> None:
    assert task.success_rule.endswith(".")
    assert f"Success: {task.success_rule}" in " ".join((inspect.getdoc(type(task)) or "").split())


def test_each_parameter_names_a_part_of_the_robot_or_none(task: Task) -> None:
    model = task.spec(task.design_space.initial).compile()
    names = [model.body(i).name for i in range(model.nbody)]
    assert all(any(name.startswith(p.part) for name in names) for p in task.design_space.parameters)


def test_every_member_explains_itself(task: Task) -> None:
    for name, member in vars(Task).items():
        if not name.startswith("_"):
            assert inspect.getdoc(member if isinstance(member, property) else getattr(task, name)), name


def test_observation_units_make_what_is_observed_dimensionless(task: Task) -> None:
    if task.observation_units is None:
        return
    middle, spread = task.observation_units
    assert middle.shape == spread.shape == (task.observation_size,)
    assert (spread > 0).all()
    rng = np.random.default_rng(6)
    hw_phy = task.hw_phy(task.design_space.initial)
    s = task.reset(hw_phy, N, rng)
    for _ in range(5):
        s = task.step(hw_phy, s, rng.uniform(-1, 1, (N, task.action_size))).s
    x = middle + spread * task.observe(s)
    seen = [np.isclose(column, s, rtol=1e-4, atol=1e-5).all(0).any() for column in x.T[..., None]]
    assert any(seen)
    assert np.abs(task.observe(s)).max() < 20


def test_action_units_are_what_an_action_of_one_asks_for(task: Task) -> None:
    if task.action_units is None:
        return
    rng = np.random.default_rng(7)
    hw_phy = task.hw_phy(task.design_space.initial)
    action = rng.uniform(-1, 1, (N, task.action_size))
    step = task.step(hw_phy, task.reset(hw_phy, N, rng), action)
    free = np.isclose(step.a, task.action_units * action, atol=1e-12).all(1)
    assert free.any(), "contact may cut actions short, but not all of them at the start"


def test_hardware_from_the_scene_is_the_hardware_of_its_design(task: Task) -> None:
    rng = np.random.default_rng(8)
    phi = task.design_space.initial
    hw_phy, reloaded = task.hw_phy(phi), task.hw_phy_from(task.scene(phi), phi)
    s = task.reset(hw_phy, N, rng)
    step = task.step(hw_phy, s, rng.uniform(-1, 1, (N, task.action_size)))
    np.testing.assert_allclose(reloaded(s, step.a), step.z, rtol=0, atol=1e-9)


def test_the_check_that_plug_ins_must_pass_accepts_it(task: Task) -> None:
    check_task(task)


def test_what_is_tuned_for_it_is_what_a_run_of_it_gets(listed: Task) -> None:
    tuned = {settings.name: settings for settings in listed.tuned if isinstance(settings, Method)}
    assert set(tuned) <= set(METHODS)
    if listed.name in BUILT_IN:
        assert set(tuned) == {"morph", "direct", "no_hw_opt"}
    for name, settings in tuned.items():
        assert make_method(name, listed) == settings
        settings.check(listed)


def test_it_says_whether_it_runs_in_the_proxys_world(task: Task) -> None:
    hw_nn, rng = start(task, SMALL, 0).hw_nn, np.random.default_rng(0)
    s = task.reset(task.hw_phy(task.design_space.initial), N, rng)
    action = rng.uniform(-1, 1, (N, task.action_size))
    if task.runs_on_proxy:
        step = task.step(hw_nn, s, action)
        assert np.array_equal(step.z, hw_nn(s, step.a))
    else:
        with pytest.raises(ValueError, match="not in the proxy's world"):
            task.step(hw_nn, s, action)


def test_shapes_are_as_declared(task: Task) -> None:
    rng = np.random.default_rng(0)
    hw_phy = task.hw_phy(random_designs(task, rng))
    s = task.reset(hw_phy, N, rng)
    assert s.shape == (N, task.state_size)
    assert task.observe(s).shape == (N, task.observation_size)
    assert task.observe(s).dtype == np.float32
    step = task.step(hw_phy, s, rng.uniform(-1, 1, (N, task.action_size)))
    assert step.s.shape == s.shape
    assert step.a.shape == (N, task.action_size)
    assert step.z.shape == (N, task.z_size)
    assert step.contact.shape[::2] == (N, 3)
    flags = (step.terminated, step.diverged, step.success, *step.milestones.values())
    for vector in (step.reward, *flags, *step.reward_terms.values()):
        assert vector.shape == (N,)
    assert task.proxy_input(s, step.a).shape == (N, task.proxy_input_size)
    assert task.proxy_input(s, step.a).dtype == np.float32
    pairs = task.sample_pairs(5, rng)
    assert [len(part) for part in pairs] == [5, 5]


def test_everything_stays_finite_over_an_episode_of_any_design(task: Task) -> None:
    rng = np.random.default_rng(1)
    hw_phy = task.hw_phy(random_designs(task, rng))
    act = lambda _: rng.uniform(-2, 2, (N, task.action_size)).astype(np.float32)  # noqa: E731
    rollout = collect(task, act, hw_phy, task.reset(hw_phy, N, rng))
    for array in (rollout.s, rollout.observation, rollout.a, rollout.z, rollout.reward):
        assert np.isfinite(array).all()
    assert np.allclose(sum(rollout.reward_terms.values()), rollout.reward)


def test_the_same_seed_gives_the_same_episode(task: Task) -> None:
    def episode() -> np.ndarray:
        rng = np.random.default_rng(2)
        hw_phy = task.hw_phy(task.design_space.initial)
        act = lambda _: rng.uniform(-1, 1, (N, task.action_size)).astype(np.float32)  # noqa: E731
        return collect(task, act, hw_phy, task.reset(hw_phy, N, rng)).s

    assert np.array_equal(episode(), episode())


def test_environments_do_not_touch_each_other(task: Task) -> None:
    rng = np.random.default_rng(3)
    designs, action = random_designs(task, rng), rng.uniform(-1, 1, (N, task.action_size))
    s = task.reset(task.hw_phy(designs), N, rng)
    for _ in range(task.horizon):
        together = task.step(task.hw_phy(designs), s, action)
        for i in range(N):
            alone = task.step(task.hw_phy(designs[i]), s[i : i + 1], action[i : i + 1])
            assert np.allclose(alone.s[0], together.s[i], atol=1e-12)
            assert np.allclose(alone.z[0], together.z[i], atol=1e-12)
        s = together.s


def test_z_is_what_hw_phy_says_of_the_executed_action(task: Task) -> None:
    rng = np.random.default_rng(4)
    hw_phy = task.hw_phy(random_designs(task, rng))
    s = task.reset(hw_phy, N, rng)
    step = task.step(hw_phy, s, rng.uniform(-1, 1, (N, task.action_size)))
    assert np.allclose(hw_phy(s, step.a), step.z, atol=1e-9)


def test_actions_beyond_one_are_clipped(task: Task) -> None:
    rng = np.random.default_rng(5)
    hw_phy = task.hw_phy(task.design_space.initial)
    s = task.reset(hw_phy, N, rng)
    wild = rng.choice([-1.0, 1.0], (N, task.action_size))
    assert np.array_equal(task.step(hw_phy, s, 50 * wild).s, task.step(hw_phy, s, wild).s)


def test_robot_and_scene_compile_at_every_corner_of_the_box(task: Task) -> None:
    space = task.design_space
    for phi in (space.lo, space.hi, space.initial, np.where(np.arange(len(space)) % 2, space.lo, space.hi)):
        robot = task.spec(phi).compile()
        scene = task.scene(phi).compile()
        assert task.qpos(task.reset(task.hw_phy(phi), 1, np.random.default_rng(0))).shape == (1, scene.nq)
        assert scene.nq >= robot.nq
        data = mujoco.MjData(scene)
        mujoco.mj_forward(scene, data)
        assert np.isfinite(data.geom_xpos).all()
        assert any(scene.geom(i).name.startswith("goal") for i in range(scene.ngeom))
