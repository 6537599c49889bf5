"""The mouse: its parts, and what a hand meets on the table."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st

from assets.make_mouse import parts
from morph_core.rollout import collect
from morph_core.tasks.mouse_click import BUTTON_HALF_SIZE, BUTTON_MIDDLE, PARTS, MouseClick, read_part


def compiled(task: MouseClick) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return the scene of the initial design, with the mouse where it is first put."""
    model = task.scene(task.design_space.initial).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = task.qpos(task.reset(task.hw_phy(task.design_space.initial), 1, np.random.default_rng(0)))[0]
    mujoco.mj_forward(model, data)
    return model, data


def test_the_script_makes_the_committed_parts() -> None:
    made = parts()
    assert set(made) == set(PARTS)
    for name, mesh in made.items():
        vertices, faces = read_part(name)
        assert np.allclose(vertices, mesh.vertices, atol=1e-9)
        assert np.array_equal(faces, mesh.faces)


@pytest.mark.parametrize("part", PARTS)
def test_a_part_is_convex_closed_and_small(part: str) -> None:
    vertices, faces = read_part(part)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_convex
    assert mesh.volume > 0.05
    assert len(vertices) < 80


def test_the_parts_fill_the_unit_cube() -> None:
    vertices = np.concatenate([read_part(part)[0] for part in PARTS])
    assert np.allclose([vertices.min(0), vertices.max(0)], [[-0.5] * 3, [0.5] * 3])


@settings(max_examples=10, deadline=None)
@given(size=st.tuples(*[st.floats(0.05, 0.8)] * 3), mass=st.floats(0.05, 2.0))
def test_size_and_mass_are_as_asked(size: tuple[float, float, float], mass: float) -> None:
    task = MouseClick(length=size[0], width=size[1], height=size[2], mass=mass)
    model, data = compiled(task)
    assert model.body("object").mass[0] == pytest.approx(mass, rel=1e-5)
    at, turn = data.body("object").xpos, data.body("object").xmat.reshape(3, 3)
    corners = []
    for part in PARTS:
        geom = model.geom(f"object_{part}")
        mesh = model.mesh(int(geom.dataid[0]))
        vertices = model.mesh_vert[int(mesh.vertadr[0]) :][: int(mesh.vertnum[0])]
        placed = data.geom_xpos[geom.id] + vertices @ data.geom_xmat[geom.id].reshape(3, 3).T
        corners.append((placed - at) @ turn)
    corners = np.concatenate(corners)
    assert np.allclose(corners.max(0), task.half_extents, atol=1e-5)
    assert np.allclose(corners.min(0), -task.half_extents, atol=1e-5)


def test_the_pressed_button_is_above_the_recess_and_in_front_on_the_left() -> None:
    task, (vertices, _) = MouseClick(), read_part("left")
    recess = vertices[:, 2].max()
    top = BUTTON_MIDDLE[2] + BUTTON_HALF_SIZE[2]
    assert (top - recess) * task.height > task.travel
    assert BUTTON_MIDDLE[0] - BUTTON_HALF_SIZE[0] > 0
    assert BUTTON_MIDDLE[1] > 0
    assert BUTTON_MIDDLE[1] - BUTTON_HALF_SIZE[1] < 0  # a finger at the front can press it


@settings(max_examples=20, deadline=None)
@example(share=[0.5] * 5 + [0.0] * 5)  # its palm begins lowest
@given(share=st.lists(st.floats(0, 1), min_size=10, max_size=10))
def test_no_hand_starts_in_the_mouse(share: list[float]) -> None:
    task = MouseClick(start_noise=0.0)
    space = task.design_space
    phi = space.lo + np.array(share) * (space.hi - space.lo)
    step = task.step(hw := task.hw_phy(phi), task.reset(hw, 1, np.random.default_rng(0)), np.zeros((1, 11)))
    assert not np.isfinite(step.contact).any()
    assert step.diverged or np.abs(step.z).max() < 0.1  # it lies where it lay: no palm has pushed it away
    assert not step.milestones["pressed"].any()


def test_the_mouse_lies_still_until_it_is_touched() -> None:
    task = MouseClick(start_noise=0.0)
    hw_phy = task.hw_phy(task.design_space.initial)
    s = task.reset(hw_phy, 2, np.random.default_rng(0))
    rollout = collect(task, lambda _: np.tile([1.0] + [0.0] * 10, (2, 1)), hw_phy, s)
    k = task.hand.joints
    assert np.allclose(rollout.last_s[:, k : k + 7], s[:, k : k + 7], atol=2e-3)
    assert np.abs(task.clearance(rollout.last_s)).max() < 2e-3


def test_a_finger_that_weighs_on_the_button_presses_it() -> None:
    task = MouseClick(start_noise=0.0)
    hw_phy = task.hw_phy(task.design_space.initial)
    s = task.reset(hw_phy, 1, np.random.default_rng(0))
    down = np.array([[-1.0] + [0.0] * 10])
    rollout = collect(task, lambda _: down, hw_phy, s)
    assert rollout.milestones["pressed"].any()
    assert not rollout.milestones["lifted"].any()


def test_the_scene_carries_the_meshes_in_its_own_text(tmp_path: Path) -> None:
    task = MouseClick()
    spec = task.scene(task.design_space.initial)
    model = spec.compile()
    (tmp_path / "scene.xml").write_text(spec.to_xml())
    again = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    assert again.nmesh == model.nmesh == len(PARTS)
    assert np.allclose(again.body("object").inertia, model.body("object").inertia, rtol=1e-3)
    assert np.allclose(again.mesh_vert, model.mesh_vert, atol=1e-5)
