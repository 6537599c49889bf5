"""The reacher: exact contact, swept moves, honest starts."""

import itertools

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core.tasks.reacher import LINKS, TOLERANCE, TUNNELS, ForwardKinematics, Reacher

lengths = st.lists(st.floats(0.05, 5.0), min_size=LINKS, max_size=LINKS).map(np.array)
seeds = st.integers(0, 2**32 - 1)


def brute_depth(tunnel_name: str, outline: np.ndarray) -> float:
    """Return the depth of one outline (P, 2) by sampling every link densely."""
    tunnel = TUNNELS[tunnel_name]
    along = np.linspace(0, 1, 4001)[:, None]
    points = np.concatenate([p + along * (q - p) for p, q in itertools.pairwise(outline)])
    inside = points[(points[:, 0] >= tunnel.xs[0]) & (points[:, 0] <= tunnel.xs[-1])]
    centre = np.interp(inside[:, 0], tunnel.xs, tunnel.ys)
    return float((np.abs(inside[:, 1] - centre) - tunnel.gap / 2).max(initial=-np.inf))


@settings(max_examples=60)
@given(st.sampled_from(sorted(TUNNELS)), seeds)
def test_depth_is_that_of_a_dense_sampling(name: str, seed: int) -> None:
    outline = np.random.default_rng(seed).uniform(-1, 8, (6, 2))
    exact, sampled = float(TUNNELS[name].depth(*outline.T)), brute_depth(name, outline)
    assert exact >= sampled - 1e-9
    if np.isfinite(sampled) and sampled > -0.2:
        assert exact == pytest.approx(sampled, abs=0.02)


@settings(max_examples=60)
@given(st.sampled_from(sorted(TUNNELS)), seeds, st.sampled_from([np.float32, np.float64]), st.floats(-0.5, 0.5))
def test_what_touches_is_as_deep_as_the_limit(name: str, seed: int, kind: type, limit: float) -> None:
    tunnel, rng = TUNNELS[name], np.random.default_rng(seed)
    x, y = rng.uniform(-1, 8, (2, 6, 50)).astype(kind)
    x[rng.random(x.shape) < 0.2] = rng.choice(tunnel.xs)  # on a bend, or upright
    assert np.array_equal(tunnel.touches(x, y, limit), tunnel.depth(x, y) >= limit)


def test_a_point_on_the_centre_line_is_free_and_one_beyond_the_gap_is_not() -> None:
    tunnel = TUNNELS["zigzag"]
    for height, expected in ((4.2, -0.55), (4.2 + 0.6, 0.05), (4.2 - 0.6, 0.05)):
        link = np.array([[2.5, height], [2.5, height]])
        assert float(tunnel.depth(*link.T)) == pytest.approx(expected)


def test_the_deepest_point_of_a_bend_crossing_is_the_bend() -> None:
    x, y = np.array([[1.2], [3.8]]), np.array([[3.2], [3.2]])  # straight through the lower corner of the zigzag
    assert TUNNELS["zigzag"].deepest(x, y)[0].tolist() == pytest.approx([2.5, 3.2])


@settings(max_examples=25)
@given(lengths, seeds)
def test_a_sweep_never_ends_in_a_wall_nor_passes_through_one(phi: np.ndarray, seed: int) -> None:
    task, rng = Reacher(), np.random.default_rng(seed)
    arm = task.hw_phy(phi)
    s = task.reset(arm, 1, rng)
    drift = rng.uniform(-1, 1, LINKS)
    for _ in range(15):
        step = task.step(arm, s, drift[None] + 0.5 * rng.standard_normal((1, LINKS)))
        assert float(task.walls.depth(*arm.outline(step.s[0, :LINKS]).T)) < 2 * TOLERANCE
        assert np.isfinite(step.contact[0, 0, 0]) == (np.abs(step.reward_terms["collision"][0]) > 0)
        s = step.s


class Outlined:
    """An arm that can be asked for its joints alone, as a proxy can."""

    def __init__(self, arm: ForwardKinematics) -> None:
        self.arm, self.phi = arm, arm.phi

    def __call__(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        return self.arm(s, a)

    def of(self, episodes: np.ndarray) -> "Outlined":
        phi = self.phi[episodes] if self.phi.ndim > 1 else self.phi
        return Tiled(phi, self.arm.tip_only)


class Tiled(Outlined):
    """Arms of some episodes, asked several times over."""

    def __init__(self, phi: np.ndarray, tip_only: bool) -> None:
        self.phi, self.tip_only = phi, tip_only

    def __call__(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        phi = np.tile(self.phi, (len(s) // len(self.phi), 1)) if self.phi.ndim > 1 else self.phi
        return ForwardKinematics(phi, self.tip_only)(s, a)


@settings(max_examples=25)
@given(seeds)
def test_the_outline_of_a_world_is_swept_as_the_arm_itself_is(seed: int) -> None:
    task, rng = Reacher(sweep_resolution=0.15), np.random.default_rng(seed)
    arm = task.hw_phy(rng.uniform(0.05, 5, (16, LINKS)))  # an arm of its own for each episode
    s, drift = task.reset(arm, 16, rng), rng.uniform(-1, 1, (16, LINKS))
    stopped = 0
    for _ in range(15):
        action = drift + 0.5 * rng.standard_normal((16, LINKS))
        step, swept = task.step(arm, s, action), task.step(Outlined(arm), s, action)
        # rounding at the edge of a wall or of a resolution may let one posture more pass, seldom
        same = np.isclose(step.a, swept.a, atol=1e-4).all(1)
        assert same.mean() > 0.8
        assert np.allclose(step.reward[same], swept.reward[same], atol=1e-4)
        assert np.allclose(step.contact[same], swept.contact[same], atol=0.01, equal_nan=True)
        stopped += (step.reward_terms["collision"][same] < 0).sum()
        s = step.s
    assert stopped > 0


def test_a_swept_outline_does_not_leap_through_a_wall_and_its_end_alone_does() -> None:
    task = Reacher(action_scale=3.5, start_noise=0.0)
    arm = task.hw_phy(np.array([0.05, 0.05, 0.05, 0.05, 5.0]))
    s = task.reset(arm, 2, np.random.default_rng(0))
    turn = np.zeros((2, LINKS))
    turn[0, -1] = np.deg2rad(-190)  # from straight up to straight down, clockwise: both ends are free
    swept = task.step(Outlined(arm), s, turn / task.action_scale)
    assert abs(swept.a[0, -1]) < abs(turn[0, -1])
    assert swept.contact[0, 0, 0] >= task.walls.xs[0] - 1e-6
    assert np.isnan(swept.contact[1]).all()
    ends = task.step(lambda s, a: arm(s, a), s, turn / task.action_scale)
    assert ends.a[0, -1] == pytest.approx(turn[0, -1])


def test_a_tip_alone_is_swept_too() -> None:
    task = Reacher(action_scale=3.5, start_noise=0.0, z="tip")
    arm = task.hw_phy(np.array([0.05, 0.05, 0.05, 0.05, 5.0]))
    s = task.reset(arm, 1, np.random.default_rng(0))
    turn = np.array([[0, 0, 0, 0, np.deg2rad(-190)]])
    assert abs(task.step(Outlined(arm), s, turn / task.action_scale).a[0, -1]) < abs(turn[0, -1])


def test_a_link_can_not_leap_through_a_wall() -> None:
    task = Reacher(action_scale=3.5, start_noise=0.0)
    arm = task.hw_phy(np.array([0.05, 0.05, 0.05, 0.05, 5.0]))
    s = task.reset(arm, 1, np.random.default_rng(0))
    turn = np.zeros((1, LINKS))
    turn[0, -1] = np.deg2rad(-190)  # from straight up to straight down, clockwise: both ends are free
    assert float(task.walls.depth(*arm.outline(s[0, :LINKS] + turn[0]).T)) < 0
    step = task.step(arm, s, turn / task.action_scale)
    assert abs(step.a[0, -1]) < abs(turn[0, -1])
    assert step.contact[0, 0, 0] >= task.walls.xs[0] - 1e-6


@settings(max_examples=30)
@given(lengths, seeds)
def test_every_design_of_the_box_starts_outside_the_zigzag(phi: np.ndarray, seed: int) -> None:
    task = Reacher()
    arm = task.hw_phy(phi)
    s = task.reset(arm, 8, np.random.default_rng(seed))
    assert (arm.outline(s[:, :LINKS])[..., 0] <= task.walls.xs[0]).all()
    assert not s[:, -1].any()


def test_a_design_that_starts_in_the_paper_tunnel_is_stuck_and_never_touches() -> None:
    task = Reacher(tunnel="paper")
    arm = task.hw_phy(np.array([0.05, 0.05, 3.0, 3.6, 3.6]))  # its folded start reaches the goal right away
    s = task.reset(arm, 2, np.random.default_rng(0))
    step = task.step(arm, s, np.zeros((2, LINKS)))
    assert not step.success.any()
    assert step.reward.tolist() == pytest.approx([-task.stuck_cost * task.reward_scale] * 2)


def test_reward_terms_add_up_and_have_the_right_signs() -> None:
    task, rng = Reacher(), np.random.default_rng(0)
    arm = task.hw_phy(task.design_space.initial)
    step = task.step(arm, task.reset(arm, 16, rng), rng.uniform(-1, 1, (16, LINKS)))
    assert np.allclose(sum(step.reward_terms.values()), step.reward)
    for name in ("distance", "centre", "collision"):
        assert (step.reward_terms[name] <= 0).all()
    assert (step.reward_terms["distance"] < 0).all()


def test_the_goal_bonus_is_paid_at_the_goal_and_ends_the_episode() -> None:
    task = Reacher()
    threaded = np.array([[0, 0], [0, 3], [1, 3], [2.5, 4.2], [4, 3], [4.3, 2.8]])  # along the centre line
    step = task.step(*posture(task, threaded), np.zeros((1, LINKS)))
    assert step.success[0]
    assert step.terminated[0]
    assert step.reward_terms["goal"][0] == pytest.approx(task.goal_bonus * task.reward_scale)


def test_an_arm_that_stands_in_a_wall_does_not_touch_the_goal() -> None:
    task = Reacher()
    straight = np.linspace([0, 0], [4.4, 2.8], LINKS + 1)  # the shortest way leads through the lower wall
    step = task.step(*posture(task, straight), np.zeros((1, LINKS)))
    assert not step.success[0]


def posture(task: Reacher, joints: np.ndarray) -> tuple[ForwardKinematics, np.ndarray]:
    """Return the arm and the state (1, state_size) whose joints stand at the given points (6, 2)."""
    links = np.diff(joints, axis=0)
    arm = task.hw_phy(np.linalg.norm(links, axis=1))
    s = task.reset(arm, 1, np.random.default_rng(0))
    s[0, :LINKS] = np.diff(np.arctan2(links[:, 1], links[:, 0]), prepend=0)
    return arm, s


@settings(max_examples=20)
@given(lengths, seeds)
def test_the_jacobian_is_the_derivative_of_z(phi: np.ndarray, seed: int) -> None:
    task = Reacher()
    s, a = task.sample_pairs(4, np.random.default_rng(seed))
    arm = task.hw_phy(phi)
    for i in range(LINKS):
        nudge = 1e-6 * np.eye(LINKS)[i]
        difference = (task.hw_phy(phi + nudge)(s, a) - task.hw_phy(phi - nudge)(s, a)) / 2e-6
        assert np.allclose(arm.jacobian(s, a)[..., i], difference, atol=1e-6)


@pytest.mark.parametrize("z", ["joints", "tip"])
def test_one_design_each_equals_one_design_at_a_time(z: str) -> None:
    task, rng = Reacher(z=z), np.random.default_rng(0)
    designs = rng.uniform(0.05, 5, (6, LINKS))
    s, a = task.sample_pairs(6, rng)
    together = task.hw_phy(designs)(s, a)
    alone = np.concatenate([task.hw_phy(phi)(s[i : i + 1], a[i : i + 1]) for i, phi in enumerate(designs)])
    assert np.array_equal(together, alone)
    assert together.shape == (6, task.z_size)


@settings(max_examples=20)
@given(lengths, seeds)
def test_the_exported_arm_has_the_kinematics_of_hw_phy(phi: np.ndarray, seed: int) -> None:
    task = Reacher()
    model = task.spec(phi).compile()
    data = mujoco.MjData(model)
    q = np.random.default_rng(seed).uniform(-3, 3, LINKS)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    assert np.allclose(data.site("tip").xpos[:2], task.hw_phy(phi).outline(q)[-1], atol=1e-9)


def test_unknown_tunnel_and_z_list_the_choices() -> None:
    with pytest.raises(ValueError, match=r"unknown tunnel \"cave\"; choose from: zigzag, paper$"):
        Reacher(tunnel="cave")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="choose from: joints, tip"):
        Reacher(z="elbow")  # pyright: ignore[reportArgumentType]


def test_weights_that_are_not_finite_are_refused() -> None:
    with pytest.raises(ValueError, match="goal_bonus"):
        Reacher(goal_bonus=float("nan"))
