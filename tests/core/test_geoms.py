"""What is seen of a MuJoCo model: every kind of geom in its size, place and colour, closed and facing outwards."""

import mujoco
import numpy as np
import pytest

from morph_core.geoms import Geoms

TETRAHEDRON = "0 0 0  1 0 0  0 1 0  0 0 1"
PLACE = 'pos="1 2 3" euler="30 40 50" rgba=".2 .4 .6 1"'


def model_of(geoms: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <asset><mesh name="m" vertex="{TETRAHEDRON}"/><material name="gold" rgba="1 .8 0 1"/></asset>
          <worldbody>{geoms}<body><joint type="slide" axis="0 0 1"/><geom size=".1"/></body></worldbody>
        </mujoco>""")


@pytest.mark.parametrize(
    ("geom", "volume"),
    [
        ('type="sphere" size=".5"', 4 / 3 * np.pi * 0.5**3),
        ('type="ellipsoid" size=".5 .2 .1"', 4 / 3 * np.pi * 0.5 * 0.2 * 0.1),
        ('type="capsule" size=".2 .7"', np.pi * 0.2**2 * 1.4 + 4 / 3 * np.pi * 0.2**3),
        ('type="cylinder" size=".3 .6"', np.pi * 0.3**2 * 1.2),
        ('type="box" size=".5 .2 .1"', 8 * 0.5 * 0.2 * 0.1),
        ('type="mesh" mesh="m"', 1 / 6),
    ],
)
def test_a_solid_is_closed_and_faces_outwards_in_its_size_and_place(geom: str, volume: float) -> None:
    model = model_of(f"<geom {geom} {PLACE}/>")
    triangles, colour = Geoms.of(model).at(np.zeros(1))[0]
    pyramids = np.linalg.det(triangles) / 6  # signed: those of faces that look away from the origin are positive
    assert 0.93 * volume < pyramids.sum() < volume + 1e-6
    middle = (pyramids[:, None] * triangles.mean(1) * 0.75).sum(0) / pyramids.sum()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    assert np.allclose(middle, data.geom_xpos[0], atol=0.01)
    own = (triangles.reshape(-1, 3) - data.geom_xpos[0]) @ data.geom_xmat[0].reshape(3, 3)
    assert np.allclose(np.abs(own).max(0), np.abs(model.geom_aabb[0, :3]) + model.geom_aabb[0, 3:], atol=0.02)
    assert np.allclose(colour, [0.2, 0.4, 0.6])


@pytest.mark.parametrize(("size", "area"), [("2 3 .1", 24.0), ("0 3 .1", None), ("0 0 .1", None)])
def test_a_plane_is_a_rectangle_that_faces_up_and_an_endless_one_is_large(size: str, area: float | None) -> None:
    model = model_of(f'<geom type="plane" size="{size}"/>')
    geoms = Geoms.of(model)
    triangles, _ = geoms.at(np.zeros(1))[0]
    doubled = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]).sum(0)
    assert np.allclose(doubled[:2], 0)
    assert doubled[2] / 2 == pytest.approx(area) if area else doubled[2] / 2 > model.stat.extent
    assert geoms.are_planes == [True, False]


def test_what_moves_is_drawn_where_it_is() -> None:
    geoms = Geoms.of(model_of(""))
    here, there = (geoms.at(np.array([z]))[0][0] for z in (0.0, 2.5))
    assert np.allclose(there - here, [0, 0, 2.5])


@pytest.mark.parametrize("hidden", ['group="3"', 'rgba="1 0 0 0"'])
def test_what_mujoco_hides_is_not_drawn(hidden: str) -> None:
    assert len(Geoms.of(model_of(f'<geom size=".5" {hidden}/>')).at(np.zeros(1))) == 1


def test_a_material_gives_its_colour_where_the_geom_has_none() -> None:
    gold = Geoms.of(model_of('<geom size=".5" material="gold"/>')).at(np.zeros(1))[0][1]
    own = Geoms.of(model_of('<geom size=".5" material="gold" rgba="0 0 1 1"/>')).at(np.zeros(1))[0][1]
    assert np.allclose([gold, own], [[1, 0.8, 0], [0, 0, 1]])
