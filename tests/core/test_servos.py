"""Real servos: figures in SI units, and hands that learn within their limits."""

import math
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core.task import WatchedHardware
from morph_core.tasks.grasp import GraspTask
from morph_core.tasks.mouse_click import MouseClick
from morph_core.tasks.pen_press import PenPress
from morph_core.tasks.servos import SERVOS, ServoLimits, ServoName, kgf_cm, per_minute, seconds_for_60_degrees
from morph_core.tasks.simulation import SUBSTEPS

HANDS = [PenPress, MouseClick]


def test_figures_are_those_of_the_data_sheets_in_si_units() -> None:
    sheet = SERVOS["XM430-W350"]  # 4.1 N m, 46 rev/min, 82 g, 28.5 x 46.5 x 34 mm
    assert sheet.stall_torque == 4.1
    assert sheet.no_load_speed == pytest.approx(4.817, abs=1e-3)
    assert sheet.mass == 0.082
    assert sheet.size == pytest.approx((0.0285, 0.0465, 0.034))
    sheet = SERVOS["STS3215"]  # 30 kgf cm; 0.222 s/60 degrees, which the maker also calls 45 rev/min
    assert sheet.stall_torque == pytest.approx(2.942, abs=1e-3)
    assert sheet.no_load_speed == pytest.approx(per_minute(45), rel=2e-3)
    assert SERVOS["MG90S"].stall_torque == pytest.approx(0.1765, abs=1e-4)  # 1.8 kgf cm


@pytest.mark.parametrize("name", SERVOS)
def test_every_figure_is_of_a_servo_that_a_hand_can_carry(name: ServoName) -> None:
    sheet = SERVOS[name]
    assert 0.1 < sheet.stall_torque < 20  # N m: mN m or kgf cm would be out
    assert 2 < sheet.no_load_speed < 20  # rad/s: rev/min would be out
    assert 0.01 < sheet.mass < 0.2  # kg
    assert all(0.01 < side < 0.06 for side in sheet.size)  # m
    assert sheet.price[0] <= sheet.price[1]
    assert sheet.rated_torque is None or 0.1 < sheet.rated_torque / sheet.stall_torque < 0.5
    assert sheet.source.startswith("https://")
    assert any(str(year) in sheet.price_source for year in range(2024, 2027))


def test_the_table_has_every_name_and_begins_with_the_cheapest() -> None:
    assert tuple(SERVOS) == get_args(ServoName)
    assert set(get_args(ServoLimits)) == {"none", *SERVOS}
    prices = [sum(sheet.price) for sheet in SERVOS.values()]
    assert prices == sorted(prices)


@given(st.floats(0.01, 10))
def test_units_of_data_sheets_agree_with_one_another(seconds: float) -> None:
    assert seconds_for_60_degrees(seconds) == pytest.approx(per_minute(10 / seconds))
    assert kgf_cm(100 / 9.80665 * seconds) == pytest.approx(seconds)
    assert seconds_for_60_degrees(seconds) * seconds == pytest.approx(math.radians(60))


def torques(task: GraspTask) -> np.ndarray:
    """Return the largest force or torque (nu,) of each servo of the initial design."""
    return task.spec(task.design_space.initial).compile().actuator_forcerange[:, 1]


@pytest.mark.parametrize("kind", HANDS)
def test_without_a_servo_a_hand_keeps_its_own_limits(kind: type[GraspTask]) -> None:
    task = kind()
    assert torques(task).tolist() == [100.0, *[4.0] * (2 * task.fingers)]
    assert task.action_units.tolist() == [0.05, *[0.3] * (2 * task.fingers)]


@pytest.mark.parametrize("kind", HANDS)
def test_a_servo_limits_the_torque_of_every_finger_joint_and_not_of_the_palm(kind: type[GraspTask]) -> None:
    task = kind(servo_limits="XL330-M288")
    assert torques(task).tolist() == [100.0, *[0.52] * (2 * task.fingers)]
    assert torques(kind(servo_limits="XM540-W270"))[1:] == pytest.approx(10.6)


@settings(max_examples=20)
@given(st.sampled_from(get_args(ServoName)), st.floats(0, 3))
def test_no_target_moves_faster_than_the_servo_turns(name: ServoName, joint_step: float) -> None:
    task = PenPress(servo_limits=name, joint_step=joint_step)
    palm, joints = task.action_units[0], task.action_units[1:]
    assert palm == task.palm_step
    speeds = joints / task.control_dt
    assert np.all(speeds <= SERVOS[name].no_load_speed * (1 + 1e-12))
    assert np.all((joints == joint_step) | np.isclose(speeds, SERVOS[name].no_load_speed))


def test_a_servo_that_is_not_in_the_table_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(ValueError, match=r'"xm430" \(did you mean XM430-W350\?\); choose from: none, MG90S, MG996R'):
        PenPress(servo_limits="xm430")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r'unknown servo_limits "9999999"; choose from: none'):
        PenPress(servo_limits="9999999")  # pyright: ignore[reportArgumentType]


def test_whoever_watches_sees_each_step_of_the_physics_and_changes_none() -> None:
    task = PenPress(servo_limits="XL330-M288")
    runs = []
    for watched in (False, True):
        rng, seen = np.random.default_rng(1), []
        hardware = task.hw_phy(task.design_space.initial)
        assert isinstance(hardware, WatchedHardware)
        if watched:
            hardware.watch = lambda speeds, forces, seen=seen: seen.append((speeds, forces))
        states = [task.reset(hardware, 3, rng)]
        for _ in range(4):
            states.append(task.step(hardware, states[-1], rng.uniform(-1, 1, (3, 9))).s)
        runs.append((np.array(states), seen))
    (plain, nothing), (same, seen) = runs
    assert not nothing
    assert np.array_equal(plain, same)
    assert len(seen) == 4 * SUBSTEPS
    starts = np.array([speeds for speeds, _ in seen[::SUBSTEPS]])
    assert np.array_equal(starts, np.array([task.qvel(s) for s in plain[:-1]]))
    forces = np.array([force for _, force in seen])[..., 1:]
    assert np.abs(forces).max() == pytest.approx(0.52)  # a fresh target is too far away for a weak servo
