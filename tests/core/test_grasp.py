"""What counts in a hand's task: each term of the reward, what lifted, pressed and in the hand mean, what is refused."""

import itertools
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import morph_core.envs  # noqa: F401 - registers the tasks
from morph_core.catalogue import make_method
from morph_core.task import Transition
from morph_core.tasks.pen_press import PenPress
from morph_core.tasks.simulation import SENSOR_SIZE, HandPhysics, Outcome

TASK = PenPress()
START = TASK.reset(TASK.hw_phy(TASK.design_space.initial), 1, np.random.default_rng(0))
STRICT = PenPress(grasp="two_besides_presser")
JOINTS, NQ = 9, 17
X, Y, Z, W, BUTTON = 9, 10, 11, 12, 16  # columns of s
DOWN = -0.02  # m: the button pressed in as far as it goes
HELD = 0.3  # m: lifted, with the middle of the pen at the goal

vectors = st.tuples(*[st.floats(-1, 1)] * 4).map(np.array).filter(lambda q: np.linalg.norm(q) > 0.1)
finger_sets = st.sets(st.integers(0, 3))


class Staged(HandPhysics):
    """A physics whose every outcome is the same, made by hand."""

    def __init__(self, outcome: Outcome) -> None:
        self.phi, self._outcome = TASK.design_space.initial, outcome
        self.buildable = TASK.buildable(self.phi)

    def run(self, s: np.ndarray, a: np.ndarray) -> Outcome:
        return self._outcome


def state(height: float = TASK.half_width, button: float = 0.0, x: float = 0.0) -> np.ndarray:
    """Return s (1, state_size): the pen level, its middle `height` m above the table."""
    s = START.copy()
    s[0, X : BUTTON + 1] = [x, 0, height, 1, 0, 0, 0, button]
    return s


def outcome(task: PenPress, s: np.ndarray, on_button: Any = (), on_body: Any = ()) -> Transition:
    """Step into `s` with these fingers (indices from 0) on the button and on the pen."""
    sensors = np.zeros((1, 4, 2, SENSOR_SIZE))
    for column, fingers in enumerate((on_button, on_body)):
        for finger in fingers:
            sensors[0, finger, column] = [1, finger, column, 0.5]
    staged = Staged(Outcome(s, np.zeros((1, TASK.z_size)), sensors, np.zeros(1, dtype=bool)))
    return task.step(staged, s, np.zeros((1, JOINTS)))


def term(name: str, *arguments: Any, task: PenPress = TASK) -> float:
    return float(outcome(task, *arguments).reward_terms[name][0]) / task.reward_scale


def test_distance_costs_by_the_metre_and_never_more_than_at_the_start() -> None:
    at_start = TASK.goal_height - TASK.half_width
    assert term("distance", state(HELD)) == 0
    assert term("distance", state(HELD - 0.1)) == pytest.approx(-0.1 * TASK.distance_weight)
    assert term("distance", state(HELD, x=0.1)) == pytest.approx(-0.1 * TASK.distance_weight)
    assert term("distance", state()) == pytest.approx(-at_start * TASK.distance_weight)
    assert term("distance", state(x=9.0)) == pytest.approx(-at_start * TASK.distance_weight)


def test_height_pays_by_the_metre_up_to_its_limit_and_never_below_the_table() -> None:
    assert term("height", state()) == pytest.approx(0)
    assert term("height", state(TASK.half_width - 0.01)) == 0
    assert term("height", state(TASK.half_width + 0.1)) == pytest.approx(0.1 * TASK.height_weight)
    assert term("height", state(2.0)) == pytest.approx(TASK.height_limit * TASK.height_weight)


def test_contact_pays_while_a_distal_link_is_on_the_button_and_the_pen_off_the_table() -> None:
    risen = state(TASK.half_width + 0.02)
    assert term("contact", risen, [0]) == TASK.contact_weight
    assert term("contact", risen, [0, 1, 2]) == TASK.contact_weight
    assert term("contact", risen, (), [0, 1]) == 0
    assert term("contact", state(), [0]) == 0


@given(finger_sets, finger_sets, st.floats(0.03, 0.6), st.floats(-0.02, 0.0))
def test_the_bonus_is_for_pressing_with_the_pen_in_the_hand(
    on_button: set[int], on_body: set[int], height: float, button: float
) -> None:
    step = outcome(TASK, state(height, button), on_button, on_body)
    pressed = bool(on_button) and button < -TASK.travel / 2
    lifted = height - TASK.half_width > TASK.lift_height and len(on_button | on_body) >= 2
    assert step.milestones["pressed"][0] == pressed
    assert step.milestones["lifted"][0] == lifted
    assert step.success[0] == (pressed and lifted)
    assert step.reward_terms["goal"][0] == TASK.reward_scale * TASK.goal_bonus * (pressed and lifted)
    assert step.reward[0] == pytest.approx(sum(float(t[0]) for t in step.reward_terms.values()))


@given(finger_sets, finger_sets)
def test_by_the_strict_rule_two_hold_the_body_besides_one_that_presses(on_button: set[int], on_body: set[int]) -> None:
    held = state(HELD, DOWN)
    step, loose = (outcome(task, held, on_button, on_body) for task in (STRICT, TASK))
    assert step.success[0] == any(len(on_body - {presser}) >= 2 for presser in on_button)
    assert step.success[0] <= loose.success[0]
    assert step.milestones["lifted"][0] == loose.milestones["lifted"][0]


def test_contact_is_where_a_finger_touches_the_button_or_else_the_pen() -> None:
    points = outcome(TASK, state(), [0, 2], [0, 1]).contact[0]
    assert points[:3].tolist() == [[0, 0, 0.5], [1, 1, 0.5], [2, 0, 0.5]]
    assert np.isnan(points[3]).all()


@given(vectors, st.floats(0, 1))
def test_clearance_is_that_of_the_lowest_corner(quaternion: np.ndarray, height: float) -> None:
    s = state(height)
    s[0, W : W + 4] = quaternion / np.linalg.norm(quaternion)
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, s[0, W : W + 4])
    corners = np.array(list(itertools.product(*[(-h, h) for h in TASK.half_extents])))
    assert TASK.clearance(s)[0] == pytest.approx(height + (corners @ turn.reshape(3, 3).T)[:, 2].min(), abs=1e-9)


@given(vectors, st.tuples(*[st.floats(-1.7, 1.7)] * 3).map(np.array))
def test_z_is_the_change_of_pose_in_typical_units(quaternion: np.ndarray, rotation: np.ndarray) -> None:
    s = state()
    s[0, W : W + 4] = quaternion / np.linalg.norm(quaternion)
    after, turned = s + 0.0, np.empty(4)
    angle = np.linalg.norm(rotation)
    mujoco.mju_axisAngle2Quat(turned, rotation / max(float(angle), 1e-9), angle)
    mujoco.mju_mulQuat(after[0, W : W + 4], turned, s[0, W : W + 4])
    after[0, :JOINTS] += np.arange(JOINTS) / 100
    after[0, X:W] += [0.1, 0.2, 0.3]
    z = TASK.change(s, after)[0]
    assert z[0] == 0
    assert z[1:JOINTS] == pytest.approx(np.arange(1, JOINTS) / 100 / 0.15)
    assert z[JOINTS : JOINTS + 3] == pytest.approx(np.array([0.1, 0.2, 0.3]) / 0.02)
    assert z[JOINTS + 3 :] == pytest.approx(rotation / 0.1, abs=1e-6)
    same = after.copy()
    same[0, W : W + 4] *= -1  # q and -q are one orientation
    assert TASK.change(s, same)[0] == pytest.approx(z, abs=1e-6)
    if abs(after[0, W]) > 1e-9:  # at half a turn the two observations meet in a jump
        assert np.allclose(TASK.observe(same), TASK.observe(after))


@pytest.mark.parametrize(
    ("last", "held"),
    [("1111111111", True), ("0000011111", True), ("1010101010", True), ("0000001111", False), ("1111000000", False)],
)
def test_held_is_half_of_the_last_ten_steps(last: str, held: bool) -> None:
    reached = np.array([bit == "1" for bit in "1" * 30 + last])[:, None]
    assert TASK.solved(np.hstack([reached, ~reached])).tolist() == [held, (~reached[-10:]).mean() >= 0.5]


@pytest.mark.parametrize(
    ("options", "message"),
    [({"grasp": "three"}, "choose from: any_two, two_besides_presser"), ({"servo": "huge"}, "choose from: none, mg90s"),
     ({"initial_length": 0.5}, "must lie inside"),
     ({"initial_length": float("nan")}, "initial_length must be finite, not nan"), ({"goal_bonus": -1.0}, "goal_bonus"),
     ({"mass": True}, "mass"), ({"travel": "far"}, "travel")],
)  # fmt: skip
def test_options_that_make_no_sense_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PenPress(**options)


def test_hands_are_explored_by_design_and_searched_without_a_gradient() -> None:
    make_method("morph", TASK).check(TASK)
    with pytest.raises(ValueError, match=r'can\'t be explored by "gaussian": .*; choose from: "design"$'):
        make_method("morph", TASK, {"exploration": "gaussian"})
    with pytest.raises(ValueError, match='has no gradient in phi: search by "cma" or "drift"'):
        make_method("morph", TASK, {"search": "gradient"})


def test_hands_do_not_run_in_the_proxys_world() -> None:
    with pytest.raises(ValueError, match='explore by "design"'):
        TASK.step(lambda s, _: s, state(), np.zeros((1, JOINTS)))


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [("length_2", 0.41, "must lie inside"), ("length_2", 0.0, "must lie inside"), ("placement_1", 3.2, "must lie"),
     ("length_3", np.nan, "must be finite"), ("placement_4", np.inf, "must be finite")],
)  # fmt: skip
def test_a_design_outside_the_box_is_refused_where_it_enters(entry: str, value: float, message: str) -> None:
    phi = TASK.design_space.initial
    phi[TASK.design_space.index(entry)] = value
    with pytest.raises(ValueError, match=f"{entry} {message}"):
        gymnasium.make("morph/PenPress-v0").reset(options={"phi": phi})


def test_a_design_that_is_not_a_number_does_not_compile() -> None:
    with pytest.raises(ValueError, match="nan"):
        TASK.hw_phy(np.full(8, np.nan))


def test_as_many_designs_as_environments_are_needed() -> None:
    hw_phy = TASK.hw_phy(np.tile(TASK.design_space.initial, (3, 1)) + np.arange(3)[:, None] / 100)
    with pytest.raises(ValueError, match="3 designs don't fit 5 environments"):
        hw_phy(np.repeat(state(), 5, 0), np.zeros((5, JOINTS)))
