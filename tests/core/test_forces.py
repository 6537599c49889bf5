"""Contact forces of an episode, held to weights that rest."""

import mujoco
import numpy as np
import pytest

from morph_core.catalogue import make_task
from morph_core.episodes import record_episode
from morph_core.forces import carried_first, contact_forces, forces_at
from morph_core.rollout import collect
from morph_core.tasks.grasp import BUTTON_MASS
from morph_core.tasks.pen_press import PenPress

RESTING = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    {first}
    <body name="weight" pos="0 0 .05"><freejoint/><geom name="weight" type="box" size=".1 .1 .05" mass="2"/></body>
    {last}
  </worldbody>
</mujoco>
"""
TABLE = '<geom name="table" type="plane" size="1 1 .1"/>'


def at_rest(xml: str, steps: int = 1000) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, steps)
    return model, data


@pytest.mark.parametrize("places", [{"first": TABLE, "last": ""}, {"first": "", "last": TABLE}])
@pytest.mark.parametrize("robot", [set[str](), {"weight"}])
def test_a_table_carries_the_weight_that_rests_on_it(places: dict[str, str], robot: set[str]) -> None:
    model, data = at_rest(RESTING.format(**places))
    found = forces_at(model, carried_first(model, robot), data.qpos[None], data.qvel[None], data.ctrl[None])
    assert found.points.shape == found.forces.shape
    assert np.nansum(found.forces, 1)[0] == pytest.approx([0, 0, 2 * 9.81], abs=1e-3)
    assert np.nanmax(np.abs(found.points[0, :, 2])) < 1e-3


def test_a_robot_feels_what_it_pushes_as_a_force_on_the_object() -> None:
    robot = '<body name="finger" pos="0 0 .2"><freejoint/><geom type="box" size=".1 .1 .05" mass="1"/></body>'
    model, data = at_rest(RESTING.format(first=TABLE, last=robot), 3000)
    found = forces_at(model, carried_first(model, {"finger"}), data.qpos[None], data.qvel[None], data.ctrl[None])
    above = found.points[0, :, 2] > 0.05
    assert np.nansum(found.forces[0, above], 0) == pytest.approx([0, 0, -9.81], abs=1e-2)
    assert np.nansum(found.forces[0, ~above], 0) == pytest.approx([0, 0, 3 * 9.81], abs=1e-2)


def test_instants_do_not_depend_on_one_another_and_are_filled_with_nan() -> None:
    model, data = at_rest(RESTING.format(first=TABLE, last=""))
    high = data.qpos + np.array([0, 0, 1, 0, 0, 0, 0])
    qpos = np.stack([high, data.qpos, high])
    found = forces_at(model, carried_first(model, set()), qpos, np.zeros((3, 6)), np.zeros((3, 0)))
    assert np.isnan(found.forces[[0, 2]]).all()
    alone = forces_at(model, carried_first(model, set()), qpos[1:2], np.zeros((1, 6)), np.zeros((1, 0)))
    assert np.array_equal(found.forces[1], alone.forces[0])


def test_the_pen_weighs_on_the_table_what_it_weighs() -> None:
    task = PenPress()
    phi = task.design_space.initial
    hw_phy = task.hw_phy(phi)
    still = np.zeros((1, task.action_size), np.float32)
    rollout = collect(task, lambda _: still, hw_phy, task.reset(hw_phy, 1, np.random.default_rng(0)))
    episode = record_episode(task, rollout, phi)
    found = contact_forces(task, phi, episode)
    assert len(found.forces) == task.horizon + 1
    weight = 9.81 * (task.mass + BUTTON_MASS)
    assert np.nansum(found.forces[-1], 0) == pytest.approx([0, 0, weight], rel=0.01, abs=0.01)
    # the hand stays where it starts, so its servos' targets are its joints
    assert episode["ctrl"][-1] == pytest.approx(episode["qpos"][-2, : task.hand.joints])


def test_a_task_that_is_not_simulated_has_none() -> None:
    task = make_task("reacher")
    with pytest.raises(ValueError, match="no contact forces are known: reacher isn't simulated by MuJoCo"):
        contact_forces(task, task.design_space.initial, {"qpos": np.zeros((2, 5))})
