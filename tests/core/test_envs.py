"""Gymnasium's contract: what SyncVectorEnv of single environments does is the measure of everything else."""

import copy
import dataclasses
import pickle
import sys
import types
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv, VectorEnv
from gymnasium.wrappers import RecordVideo
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core.catalogue import TASKS, make_task
from morph_core.envs import TaskEnv, TaskVectorEnv, env_id
from morph_core.task import Hardware, Task, Transition
from morph_core.tasks import palette
from morph_core.tasks.pen_press import PenPress
from morph_core.tasks.reacher import Reacher
from tests.core.conftest import Fragile

N = 3
NAMES = sorted(TASKS)
each_task = pytest.mark.parametrize("name", NAMES)
both = pytest.mark.parametrize("make", [TaskEnv, TaskVectorEnv])
Make = Callable[..., Any]


@dataclass(frozen=True)
class Careless(Fragile):
    """A fragile arm that leaves NaN wherever its simulation diverges."""

    def step(self, hardware: Hardware, s: np.ndarray, action: np.ndarray) -> Transition:
        step = super().step(hardware, s, action)
        lost = {name: np.where(step.diverged, np.nan, term) for name, term in step.reward_terms.items()}
        state = np.where(step.diverged[:, None], np.nan, step.s)
        return dataclasses.replace(
            step,
            s=state,
            reward=np.where(step.diverged, np.nan, step.reward),
            reward_terms=lost,
            terminated=step.diverged,
        )


def sync(name: str, environments: int = N, **options: Any) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: TaskEnv(name, **options)] * environments)


def actions(env: gymnasium.Env | VectorEnv, steps: int, seed: int = 0) -> list[np.ndarray]:
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(steps)]


def same(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> None:
    """Fail unless our info holds all of theirs; what theirs lacks, ours marks as absent."""
    for key, values in theirs.items():
        assert np.array_equal(ours[key], values), key
        assert ours[key].dtype == values.dtype, key
    for key in ours.keys() - theirs.keys():
        assert not ours[key].any(), key


def unbuildable() -> np.ndarray:
    phi = PenPress().design_space.initial
    phi[1] = -np.pi / 2  # the second finger where the first one is
    return phi


def episode(env: Any, acts: list[np.ndarray]) -> list[np.ndarray]:
    return [part for act in acts for part in map(np.asarray, env.step(act)[:4])]


def equal(one: list[np.ndarray], other: list[np.ndarray]) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.filterwarnings("ignore:.*Box observation space.*infinity")
@each_task
def test_gymnasium_accepts_the_environment(name: str) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("error", module="gymnasium")
        warnings.filterwarnings("ignore", message=".*Box observation space.*infinity")
        check_env(gymnasium.make(env_id(name)).unwrapped)


@each_task
def test_the_vector_environment_is_sync_vector_env_over_episodes_that_restart(name: str) -> None:
    theirs, ours = sync(name), TaskVectorEnv(name, N)
    assert (ours.single_action_space, ours.action_space) == (theirs.single_action_space, theirs.action_space)
    assert ours.observation_space == theirs.observation_space
    assert ours.metadata == theirs.metadata
    (expected, their_info), (seen, our_info) = theirs.reset(seed=7), ours.reset(seed=7)
    assert np.array_equal(seen, expected)
    same(our_info, their_info)
    ended = np.zeros(N, dtype=int)
    for act in actions(ours, 2 * ours.task.horizon + 5):
        *expected, their_info = theirs.step(act)
        *seen, our_info = ours.step(act)
        for mine, other in zip(seen, expected, strict=True):
            assert np.array_equal(mine, other)
            assert mine.dtype == other.dtype
        same(our_info, their_info)
        assert seen[0] in ours.observation_space
        ended += seen[2] | seen[3]
    assert (ended >= 2).all()
    assert ours.np_random_seed == theirs.np_random_seed == (7, 8, 9)
    assert [g.bit_generator.state for g in ours.np_random] == [g.bit_generator.state for g in theirs.np_random]


seed_lists = st.lists(st.none() | st.integers(0, 2**40), min_size=N, max_size=N)


@settings(max_examples=25)
@given(before=st.integers(0, 99), seeds=seed_lists, as_type=st.sampled_from([list, tuple, np.array]))
def test_every_environment_has_its_own_seed(before: int, seeds: list[int | None], as_type: type) -> None:
    ours, theirs = TaskVectorEnv("reacher", N), sync("reacher")
    for env in (ours, theirs):
        env.reset(seed=before)
    seen = ours.reset(seed=as_type(seeds))[0]
    assert np.array_equal(seen, theirs.reset(seed=seeds)[0])
    for i, seed in enumerate(seeds):
        if seed is not None:
            assert np.array_equal(seen[i], TaskEnv("reacher").reset(seed=seed)[0])


def test_equal_seeds_give_equal_states() -> None:
    seen, _ = TaskVectorEnv("pen_press", 3).reset(seed=[7, 7, 7])
    assert np.array_equal(seen[0], seen[1])
    assert np.array_equal(seen[0], seen[2])


@pytest.mark.parametrize(
    ("seed", "sentence"),
    [
        ([1, 2], "2 seeds don't fit 3 environments"),
        ([], "0 seeds don't fit 3"),
        ([1, 2, -3], "whole number from 0 on, or None, not -3"),
        (-1, "not -1"),
        (1.0, "not 1.0"),
        (True, "not True"),
        ("123", "not '123'"),
        (np.array([1.0, 2.0, 3.0]), "not np.float64"),
        ([[1], [2], [3]], r"not \[1\]"),
        ([1, "2", 3], "not '2'"),
        ({1, 2, 3}, "not {1, 2, 3}"),
    ],
)
def test_a_seed_that_is_none_is_refused_and_changes_nothing(seed: Any, sentence: str) -> None:
    env = TaskVectorEnv("reacher", 3)
    env.reset(seed=5)
    twin = copy.deepcopy(env)
    with pytest.raises(ValueError, match=sentence):
        env.reset(seed=seed)
    assert np.array_equal(env.reset()[0], twin.reset()[0])


@pytest.mark.parametrize("seed", [-1, 1.5, [1], "1", True])
def test_a_single_environment_refuses_such_seeds_too(seed: Any) -> None:
    with pytest.raises(ValueError, match="a seed must be a whole number from 0 on, or None"):
        TaskEnv("reacher").reset(seed=seed)


def test_a_single_environment_takes_the_integers_of_numpy() -> None:
    env = TaskEnv("reacher")
    assert np.array_equal(env.reset(seed=np.int64(4))[0], env.reset(seed=4)[0])


@each_task
def test_an_episode_ends_at_the_horizon_and_neither_before_nor_after(name: str) -> None:
    horizon = make_task(name).horizon
    for limit, steps in ((None, horizon), (3, 3), (horizon + 9, horizon), (-1, horizon)):
        env = gymnasium.make(env_id(name), max_episode_steps=limit)
        envs = gymnasium.make_vec(env_id(name), 2, **{"max_episode_steps": limit} if limit else {})
        for one in (env, envs):
            still = np.zeros(one.action_space.shape)
            one.reset(seed=0)
            for _ in range(steps - 1):
                assert not np.any(one.step(still)[3])
            *_, terminated, truncated, _ = one.step(still)
            assert np.all(truncated)
            assert not np.any(terminated)
    assert gymnasium.spec(env_id(name)).max_episode_steps == horizon


@pytest.mark.parametrize("limit", [0, -2, 2.0, True, "9"])
def test_a_limit_that_is_no_number_of_steps_is_refused(limit: Any) -> None:
    with pytest.raises(ValueError, match="max_episode_steps must be a whole number"):
        TaskVectorEnv("reacher", 2, max_episode_steps=limit)


@pytest.mark.parametrize("count", [0, -1, 2.0, "2", None])
def test_a_number_of_environments_that_is_none_is_refused(count: Any) -> None:
    with pytest.raises(ValueError, match="num_envs must be a whole number from 1 on"):
        TaskVectorEnv("reacher", count)


@each_task
def test_the_spec_makes_the_same_environment_again(name: str) -> None:
    env = gymnasium.make(env_id(name), render_mode="rgb_array")
    assert env.spec
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert np.array_equal(again.reset(seed=3)[0], env.reset(seed=3)[0])
    assert again.render_mode == "rgb_array"
    for mode in ("vector_entry_point", "sync"):
        envs = gymnasium.make_vec(env_id(name), num_envs=2, vectorization_mode=mode)
        assert envs.spec
        assert envs.spec.max_episode_steps == make_task(name).horizon
        assert np.array_equal(gymnasium.make_vec(envs.spec).reset(seed=3)[0], envs.reset(seed=3)[0])


@pytest.mark.parametrize("task", [Fragile(), Careless()])
def test_physics_that_fails_truncates_and_says_so(task: Task) -> None:
    env, envs = TaskEnv(task), TaskVectorEnv(task, 2)
    seen, _ = env.reset(seed=0)
    envs.reset(seed=0)
    turn = np.array([1.0, 0, 0, 0, 0])
    moves = np.array([turn, np.zeros(5)])  # the second arm never moves
    for _ in range(task.horizon):
        before, (seen, reward, terminated, truncated, info) = seen, env.step(turn)
        many, rewards, terminations, truncations, infos = envs.step(moves)
        assert np.isfinite(seen).all()
        assert np.isfinite(many).all()
        assert np.isfinite([reward, *rewards, *(info[name] for name in info if name.startswith("reward_"))]).all()
        assert (truncated, info["diverged"]) == (truncations[0], infos["diverged"][0])
        if truncated:
            break
    assert info["diverged"]
    assert not terminated
    assert not info["success"]
    assert reward == rewards[0] == 0
    assert np.array_equal(before, seen)
    assert (terminations.tolist(), truncations.tolist()) == ([False, False], [True, False])
    assert envs.step(moves)[3].tolist() == [False, False]  # it has restarted
    assert not envs.step(moves)[4]["diverged"][1]


@each_task
@pytest.mark.parametrize("lost", [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of numpy, over such numbers
def test_a_state_that_is_no_number_truncates_at_that_step(name: str, lost: float) -> None:
    envs = TaskVectorEnv(name, 2)
    envs.reset(seed=0)
    envs._s[0] = lost
    _, reward, terminated, truncated, info = envs.step(np.zeros(envs.action_space.shape))
    assert (terminated.tolist(), truncated.tolist()) == ([False, False], [True, False])
    assert info["diverged"].tolist() == [True, False]
    assert reward[0] == 0
    assert np.isfinite(envs.step(np.zeros(envs.action_space.shape))[0]).all(), "it has restarted"


@both
def test_a_simulation_that_explodes_truncates_at_that_step(make: Make) -> None:
    env = make("pen_press")
    env.reset(seed=0)
    env._s[:, 17:33] = 1e4
    seen, _, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
    assert np.all(truncated)
    assert np.all(info["diverged"])
    assert not np.any(terminated)
    assert np.isfinite(seen).all()


@both
def test_a_hand_that_cannot_be_built_is_refused_with_the_reason_and_changes_nothing(make: Make) -> None:
    env = make("pen_press")
    env.reset(seed=0)
    acts = actions(env, 4)
    episode(env, acts[:2])
    twin = copy.deepcopy(env)
    with pytest.raises(ValueError, match="fingers 1 and 2 stand"):
        env.reset(seed=1, options={"phi": unbuildable()})
    assert np.array_equal(env.phi, twin.phi)
    assert equal(episode(env, acts[2:]), episode(twin, acts[2:]))
    assert np.array_equal(env.reset()[0], twin.reset()[0])


@dataclass(frozen=True)
class Crowded(PenPress):
    """A hand whose initial design can't be built either."""

    def check_buildable(self, phi: np.ndarray) -> None:
        raise ValueError(f"{len(phi)} parameters are too many")


@dataclass(frozen=True)
class Brittle(Reacher):
    """An arm whose Hw-Phy can't be made with a short last link, which nothing says beforehand."""

    def hw_phy(self, phi: np.ndarray) -> Any:
        if np.any(phi[..., -1] < 1):
            raise ValueError("it breaks")
        return super().hw_phy(phi)


@both
def test_hardware_that_cannot_be_made_changes_nothing(make: Make) -> None:
    env = make(Brittle())
    env.reset(seed=5)
    twin = copy.deepcopy(env)
    with pytest.raises(ValueError, match="it breaks"):
        env.reset(seed=6, options={"phi": [2.0, 2.0, 2.0, 2.0, 0.5]})
    assert np.array_equal(env.phi, twin.phi)
    assert np.array_equal(env.reset()[0], twin.reset()[0])


@both
def test_what_is_handed_out_is_not_what_is_simulated(make: Make) -> None:
    env = make("reacher")
    seen, info = env.reset(seed=5)
    twin = copy.deepcopy(env)
    for array in (seen, info["phi"], env.phi):
        array[:] = 0.0
    acts = actions(env, 3)
    assert equal(episode(env, acts), episode(twin, acts))


@both
def test_an_initial_design_that_cannot_be_built_is_refused_as_well(make: Make) -> None:
    with pytest.raises(ValueError, match="8 parameters are too many"):
        make(Crowded()).reset()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"phy": [1.0]}, "unknown option 'phy'; choose from: phi"),
        ({"phi": [3.0] * 5, "mask": 1}, "unknown option 'mask'; choose from: phi"),
        ({"phi": [3.0] * 4}, "4 entries; 5 are needed"),
        ({"phi": [3.0] * 4 + [np.nan]}, "link_5 must be finite"),
        ({"phi": [3.0] * 4 + [99]}, "link_5 must lie inside"),
        ({"phi": "long"}, "phi must be numbers, not 'long'"),
        ({"phi": None}, "5 are needed"),
        ({"phi": [[3.0], [3.0, 3.0]]}, "phi must be numbers"),
        ({"phi": [10**400] * 5}, "phi must be numbers"),
        ({"phi": ["3.0"] * 5}, "phi must be numbers"),
        ({"phi": np.full(5, 3.0 + 1j)}, "phi must be numbers"),
        ({"phi": np.ma.array([3.0] * 5, mask=[True] * 5)}, "phi must be numbers"),
        ({"phi": np.ones((4, 5))}, "needed"),
        (["phi"], "options must be a dict or None"),
    ],
)
@both
def test_options_that_are_not_allowed_are_refused_and_change_nothing(make: Make, options: Any, sentence: str) -> None:
    env = make("reacher", **{"num_envs": 2} if make is TaskVectorEnv else {})
    env.reset(seed=5)
    twin = copy.deepcopy(env)
    with pytest.raises(ValueError, match=sentence):
        env.reset(seed=9, options=options)
    assert np.array_equal(env.phi, twin.phi)
    assert np.array_equal(env.reset()[0], twin.reset()[0])


@each_task
def test_a_design_stays_until_another_is_set(name: str) -> None:
    env, envs = TaskEnv(name), TaskVectorEnv(name, 2)
    space = env.task.design_space
    phi = space.clip(space.initial + 0.1 * (space.hi - space.lo) * (np.arange(len(space)) >= len(space) - 2))
    for one in (env, envs):
        first = one.reset(seed=0)[0]
        assert not np.array_equal(one.reset(seed=0, options={"phi": phi})[0], first)
        assert np.array_equal(one.reset()[1]["phi"], np.broadcast_to(phi, one.phi.shape))
    rows = np.array([space.initial, phi])
    together = envs.reset(seed=[3, 3], options={"phi": rows})
    assert np.array_equal(together[1]["phi"], rows)
    acts = actions(env, env.task.horizon + 3)
    for i, design in enumerate(rows):
        alone = SyncVectorEnv([lambda: TaskEnv(name)])
        envs.reset(seed=[3, 3], options={"phi": rows})
        assert np.array_equal(alone.reset(seed=3, options={"phi": design})[0][0], together[0][i])
        for act in acts:
            mine, other = envs.step(np.array([act, act])), alone.step(act[None])
            assert np.array_equal(mine[0][i], other[0][0])
            assert mine[1][i] == other[1][0]


def test_the_environment_of_a_wrong_design_is_named() -> None:
    good = PenPress().design_space.initial
    with pytest.raises(ValueError, match="environment 1: fingers 1 and 2 stand"):
        TaskVectorEnv("pen_press", 2).reset(options={"phi": [good, unbuildable()]})


def test_a_mask_restarts_some_as_sync_vector_env_does() -> None:
    ours, theirs = TaskVectorEnv("reacher", N), sync("reacher")
    acts, mask = actions(ours, ours.task.horizon + 6), np.array([False, True, False])
    for env in (ours, theirs):
        env.reset(seed=1)
        episode(env, acts[:2])
    (seen, info), (expected, their_info) = (
        env.reset(seed=[4, 5, 6], options={"reset_mask": mask, "phi": [2.0] * 5}) for env in (ours, theirs)
    )
    assert np.array_equal(seen, expected)
    same(info, their_info)
    assert ours.phi.tolist() == [[3.0] * 5, [2.0] * 5, [3.0] * 5]
    assert equal(episode(ours, acts[2:]), episode(theirs, acts[2:]))


@pytest.mark.parametrize(
    "mask", [[True, False, True], np.array([1, 0, 1]), np.array([True]), np.zeros(3, dtype=bool), None]
)
def test_a_mask_is_refused_where_sync_vector_env_refuses_it(mask: Any) -> None:
    for env in (TaskVectorEnv("reacher", N), sync("reacher")):
        env.reset(seed=0)
        with pytest.raises((TypeError, ValueError), match="reset_mask"):
            env.reset(options={"reset_mask": mask})


@each_task
@both
@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_made_in_the_middle_goes_on_alike(make: Make, name: str, duplicate: Callable[[Any], Any]) -> None:
    env = make(name, render_mode="rgb_array")
    env.reset(seed=2)
    acts = actions(env, 8)
    episode(env, acts[:4])
    env.render()
    twin = duplicate(env)
    assert np.array_equal(twin.render(), env.render())
    expected, last = episode(env, acts[4:]), env.reset()[0]
    assert equal(episode(twin, acts[4:]), expected)
    assert np.array_equal(twin.reset()[0], last)


def test_environments_run_in_processes_of_their_own() -> None:
    makers = [lambda: TaskEnv("pen_press")] * 2
    apart, here = AsyncVectorEnv(makers, context="spawn"), SyncVectorEnv(makers)
    try:
        assert np.array_equal(apart.reset(seed=3)[0], here.reset(seed=3)[0])
        acts = actions(here, 5)
        assert equal(episode(apart, acts), episode(here, acts))
    finally:
        apart.close()


@each_task
def test_a_picture_shows_the_scene(name: str) -> None:
    env = TaskEnv(name, render_mode="rgb_array")
    assert env.metadata["render_fps"] == 1 / env.task.control_dt
    env.reset(seed=0)
    start = env.render()
    assert start is not None
    assert start.shape == (480, 640, 3)
    assert start.dtype == np.uint8
    assert np.array_equal(start, env.render())
    for act in actions(env, 10):
        env.step(act)
    moved = env.render()
    assert 0.001 < (moved != start).any(-1).mean() < 0.5
    scene = env.task.scene(env.phi).compile()
    goal = next(scene.geom(i).rgba[:3] for i in range(scene.ngeom) if scene.geom(i).name.startswith("goal"))
    assert (np.abs(hues(start) - hues(goal)).max(-1) < 0.02).sum() > 50


def hues(image: np.ndarray) -> np.ndarray:
    """Return the colours (..., 3) of an image at full brightness."""
    return image / np.maximum(image.max(-1, keepdims=True), 1e-9)


@each_task
def test_a_picture_frames_what_stands_at_the_start(name: str) -> None:
    env = TaskEnv(name, render_mode="rgb_array")
    env.reset(seed=0)
    image = env.render()
    assert image is not None
    painted = hues(image).min(-1) < 0.9  # table and background are nearly grey
    assert not painted[[0, -1]].any()
    assert not painted[:, [0, -1]].any()
    assert painted.any(0).mean() > 0.4


def test_a_flat_scene_is_seen_from_above() -> None:
    env = TaskEnv("reacher", render_mode="rgb_array")
    env.reset(seed=0)
    image = env.render()
    assert image is not None
    rows, columns = np.nonzero(np.abs(hues(image) - hues(np.array(palette.GOAL[:3]))).max(-1) < 0.02)
    assert np.ptp(rows) == pytest.approx(np.ptp(columns), abs=1)  # the goal is a disc


def test_what_is_lifted_to_the_goal_stays_in_the_picture() -> None:
    env = TaskEnv("pen_press", render_mode="rgb_array")
    env.reset(seed=0, options={"phi": [0.0] * 4 + [0.35] * 4})
    env._s[:, [0, 11]] += PenPress().goal_height - PenPress().half_width  # palm and pen
    image = env.render()
    assert image is not None
    assert not (hues(image).min(-1) < 0.9)[0].any()


def test_the_hand_and_the_pen_throw_a_shadow_on_the_table() -> None:
    env = TaskEnv("pen_press", render_mode="rgb_array")
    env.reset(seed=0)
    image = env.render()
    assert image is not None
    table = image[np.abs(hues(image) - hues(np.array(palette.TABLE[:3]))).max(-1) < 0.01].max(-1)
    bright = np.bincount(table).argmax()
    assert (table == bright).mean() > 0.8
    assert (np.abs(table - 0.8 * bright) < 2).sum() > 2000


def test_a_vector_environment_has_a_picture_of_each() -> None:
    ours, theirs = TaskVectorEnv("reacher", 2, render_mode="rgb_array"), sync("reacher", 2, render_mode="rgb_array")
    for env in (ours, theirs):
        env.reset(seed=0)
    frames = ours.render()
    assert isinstance(frames, tuple)
    assert np.array_equal(frames, theirs.render())
    assert not np.array_equal(frames[0], frames[1])


def test_a_longer_robot_has_a_picture_of_its_own() -> None:
    env = TaskEnv("reacher", render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    env.reset(seed=0, options={"phi": [1.0] * 5})
    assert not np.array_equal(env.render(), before)


@both
def test_without_a_mode_there_is_a_word_and_no_picture(make: Make) -> None:
    env = make("reacher")
    env.reset()
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


@both
@pytest.mark.parametrize("mode", ["human", "ansi", "", 5])
def test_another_mode_is_refused_with_the_choices(make: Make, mode: Any) -> None:
    with pytest.raises(ValueError, match="choose from: rgb_array"):
        make("reacher", render_mode=mode)


def test_a_video_holds_every_frame_at_the_pace_of_the_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clips: list[tuple[int, float]] = []

    def clip(frames: list[np.ndarray], fps: float) -> types.SimpleNamespace:
        clips.append((len(frames), fps))
        return types.SimpleNamespace(write_videofile=lambda path, **_: Path(path).touch())

    for module in ("moviepy", "moviepy.video", "moviepy.video.io", "moviepy.video.io.ImageSequenceClip"):
        monkeypatch.setitem(sys.modules, module, types.SimpleNamespace(ImageSequenceClip=clip))
    hand = gymnasium.make("morph/PenPress-v0", render_mode="rgb_array", max_episode_steps=5)
    env = RecordVideo(hand, str(tmp_path))
    env.reset(seed=0)
    episode(env, actions(env, 5))
    env.close()
    assert clips == [(6, pytest.approx(10))]
    assert list(tmp_path.iterdir())


@both
def test_a_task_object_will_do(make: Make) -> None:
    task = Reacher(action_scale=0.1)
    by_object, by_name = make(task), make("reacher", action_scale=0.1)
    assert by_object.task is task
    assert by_name.task == task
    assert np.array_equal(by_object.reset(seed=1)[0], by_name.reset(seed=1)[0])
    assert isinstance(gymnasium.make("morph/Reacher-v0", action_scale=0.1).unwrapped.task, Reacher)


@both
@pytest.mark.parametrize(
    ("task", "options", "sentence"),
    [
        ("reach", {}, "choose from"),
        ("reacher", {"scale": 1}, 'reacher has no option "scale"; choose from: .*action_scale'),
        (Reacher(), {"action_scale": 0.1}, "action_scale: options go with a task's name"),
        (Reacher, {}, "a task's name or a task object"),
        (None, {}, "a task's name or a task object, not None"),
    ],
)
def test_what_is_no_task_is_refused(make: Make, task: Any, options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        make(task, **options)


@both
@pytest.mark.parametrize("call", [lambda env: env.step(env.action_space.sample()), lambda env: env.render()])
def test_nothing_goes_on_before_a_reset(make: Make, call: Callable[[Any], Any]) -> None:
    with pytest.raises(ResetNeeded, match="call reset"):
        call(make("reacher", render_mode="rgb_array"))


def test_some_cannot_begin_before_all_have_begun() -> None:
    with pytest.raises(ResetNeeded, match="without reset_mask first"):
        TaskVectorEnv("reacher", 2).reset(options={"reset_mask": np.array([True, False])})


def test_an_episode_does_not_go_on_beyond_its_end() -> None:
    env = TaskEnv("reacher")
    env.reset()
    still = np.zeros(5)
    while not env.step(still)[3]:
        pass
    with pytest.raises(ResetNeeded, match="the episode has ended"):
        env.step(still)
    env.reset()
    env.step(still)


@both
@pytest.mark.parametrize("action", [[np.nan] * 5, [np.inf] * 5, [0.0] * 4, 0.0, "left", None, [[0.0] * 5] * 2])
def test_an_action_that_is_none_is_refused_and_changes_nothing(make: Make, action: Any) -> None:
    env = make("reacher")
    env.reset(seed=0)
    twin = copy.deepcopy(env)
    with pytest.raises(ValueError, match=r"an action must be (\(.*5,?\) finite )?numbers"):
        env.step(action)
    acts = actions(env, 3)
    assert equal(episode(env, acts), episode(twin, acts))


@both
def test_an_action_beyond_one_is_clipped(make: Make) -> None:
    env = make("reacher")
    env.reset(seed=0)
    twin, wild = copy.deepcopy(env), np.sign(actions(env, 1)[0])
    assert equal(episode(env, [7 * wild]), episode(twin, [wild]))


def test_the_action_of_an_environment_that_restarts_is_ignored() -> None:
    env = TaskVectorEnv("reacher", 2, max_episode_steps=1)
    env.reset(seed=0)
    env.step(np.zeros((2, 5)))
    assert env.step(np.full((2, 5), np.nan))[1].tolist() == [0.0, 0.0]
