"""Figures agree with MuJoCo, and the scene reuses its nodes."""

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
import viser
from viser._messages import Message, SceneNodeUpdateMessage

from morph_core.catalogue import make_task
from studio.viewer import shapes
from studio.viewer.figure import Figure, smooth
from studio.viewer.scene import FIELD_OF_VIEW, NARROW, USUAL_ASPECT, Layer, camera, seen_elsewhere

MIXED = """
<mujoco>
  <asset><mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset>
  <worldbody>
    <geom name="wall" type="box" size=".1 .2 .3" pos="2 0 0" rgba="1 0 0 1"/>
    <geom name="hidden" type="box" size="1 1 1" rgba="0 0 0 0"/>
    <geom name="collision" type="box" size="1 1 1" group="3"/>
    <body name="arm">
      <freejoint/>
      <geom name="rod" type="capsule" size=".1" fromto="0 0 0 1 0 0"/>
      <geom type="cylinder" size=".2 .5"/>
      <geom name="ball" type="sphere" size=".3"/>
      <geom name="egg" type="ellipsoid" size=".1 .2 .3"/>
      <geom name="wedge" type="mesh" mesh="wedge"/>
      <body pos="1 0 0"><joint name="hinge" axis="0 0 1"/><geom name="tip" type="box" size=".1 .1 .1"/></body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MIXED)


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


def random_qpos(model: mujoco.MjModel, count: int) -> np.ndarray:
    qpos = np.random.default_rng(0).normal(size=(count, model.nq))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    return qpos


def test_parts_stand_where_mujoco_puts_their_geoms(model: mujoco.MjModel) -> None:
    qpos = random_qpos(model, 10)
    figure = Figure.from_model(model, qpos)
    assert figure.names == ("wall", "rod", "arm", "ball", "egg", "wedge", "tip")
    assert figure.kinds == ("box", "capsule", "cylinder", "sphere", "sphere", "mesh", "box")
    shown = [0, *range(3, model.ngeom)]
    data = mujoco.MjData(model)
    for t, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(figure.positions[t], data.geom_xpos[shown], atol=1e-6)
        for k, i in enumerate(shown):
            matrix = np.empty(9)
            mujoco.mju_quat2Mat(matrix, figure.wxyz[t, k].astype(float))
            np.testing.assert_allclose(matrix, data.geom_xmat[i], atol=1e-6)


def test_sizes_are_half_extents(model: mujoco.MjModel) -> None:
    figure = Figure.from_model(model, model.qpos0[None])
    sizes = dict(zip(figure.names, figure.sizes.tolist(), strict=True))
    assert sizes["rod"] == pytest.approx([0.1, 0.1, 0.5])
    assert sizes["arm"] == pytest.approx([0.2, 0.2, 0.5])
    assert sizes["ball"] == pytest.approx([0.3, 0.3, 0.3])
    assert sizes["egg"] == pytest.approx([0.1, 0.2, 0.3])
    assert sizes["wall"] == pytest.approx([0.1, 0.2, 0.3])


def test_postures_of_another_robot_are_refused(model: mujoco.MjModel) -> None:
    with pytest.raises(ValueError, match=r"\(T, 8\)"):
        Figure.from_model(model, np.zeros((2, 5)))


def test_smooth_goes_through_every_posture_the_short_way(model: mujoco.MjModel) -> None:
    qpos = random_qpos(model, 4)
    frames = smooth(model, qpos, 3)
    assert len(frames) == 10
    np.testing.assert_allclose(frames[::3], qpos, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(frames[:, 3:7], axis=1), 1, atol=1e-9)
    np.testing.assert_allclose(frames[1, 7], qpos[0, 7] + (qpos[1, 7] - qpos[0, 7]) / 3)


def test_extent_holds_every_part(model: mujoco.MjModel) -> None:
    low, high = Figure.from_model(model, model.qpos0[None]).extent()
    assert high[0] >= 2.1
    assert high[2] >= 0.5
    assert (low <= -0.2).all()


def test_the_wall_that_is_touched_is_found() -> None:
    task = make_task("reacher")
    model = task.scene(task.design_space.initial).compile()
    figure = Figure.from_model(model, model.qpos0[None])
    walls = figure.take([i for i, name in enumerate(figure.names) if name.startswith("wall")])
    for point, name in (
        ((2.4, 4.7, 0), "wall_upper_1"),
        ((2.6, 4.7, 0), "wall_upper_2"),
        ((2.4, 3.6, 0), "wall_lower_1"),
        ((3.9, 2.5, 0), "wall_lower_2"),
    ):
        assert walls.names[walls.nearest(np.array(point, float))] == name


@pytest.mark.parametrize("shape", [shapes.box(), shapes.cylinder(), shapes.sphere(), shapes.capsule(4)])
def test_unit_shapes_face_outwards_and_fill_their_box(shape: shapes.Shape) -> None:
    vertices, faces = shape
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("fc,fc->f", normals, corners.mean(1)) > -1e-6).all()
    np.testing.assert_allclose(vertices[:, 0].max(), 1, atol=1e-6)
    np.testing.assert_allclose(vertices.min(0), -vertices.max(0), atol=1e-6)


@pytest.mark.parametrize("half_length", [0.02, 0.3, 1.0, 2.5])
def test_capsules_keep_their_length_and_radius_whatever_their_aspect(
    server: viser.ViserServer, half_length: float
) -> None:
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.06, half_length, 0])
    model = spec.compile()
    layer = Layer(server, "aspect")
    layer.show(Figure.from_model(model, model.qpos0[None]))
    batch = next(batch for batch in layer._batches.values() if batch.parts)
    half = (batch.handle.vertices * np.asarray(batch.handle.batched_scales)[0]).max(0)
    np.testing.assert_allclose(half, [0.06, 0.06, half_length + 0.06], rtol=1e-2)


def test_a_hundred_designs_reuse_the_same_nodes(server: viser.ViserServer) -> None:
    task, rng = make_task("reacher"), np.random.default_rng(0)
    layer = Layer(server, "reuse")
    space = task.design_space
    seen = []
    for _ in range(100):
        model = task.scene(rng.uniform(space.lo, space.hi)).compile()
        layer.show(Figure.from_model(model, model.qpos0[None]))
        seen.append(len(layer.node_names))
    assert seen[-1] == seen[60]
    assert seen[-1] <= 20
    assert sum(len(b.parts) for b in layer._batches.values()) == 11


def seen_of(layer: Layer) -> list[str]:
    return [key for key, batch in layer._batches.items() if np.any(batch.handle.batched_scales)]


def test_a_design_with_fewer_parts_leaves_none_behind(server: viser.ViserServer, model: mujoco.MjModel) -> None:
    layer = Layer(server, "fewer")
    whole = Figure.from_model(model, model.qpos0[None])
    layer.show(whole)
    layer.show(whole.take([0]))
    assert seen_of(layer) == ["box"]
    assert layer._batches["box"].handle.batched_positions.shape == (1, 3)
    layer.show(None)
    assert seen_of(layer) == []
    assert all(batch.handle.visible for batch in layer._batches.values()), "browsers apply it before the arrays"


def test_painting_and_posing_change_only_what_they_name(server: viser.ViserServer, model: mujoco.MjModel) -> None:
    layer = Layer(server, "paint")
    figure = Figure.from_model(model, random_qpos(model, 2))
    layer.show(figure)
    layer.pose(1)
    box = layer._batches["box"]
    np.testing.assert_allclose(box.handle.batched_positions, figure.positions[1, box.parts])
    colours = figure.colours.copy()
    colours[0] = (255, 255, 255)
    layer.paint(colours)
    assert box.handle.batched_colors[0].tolist() == [255, 255, 255]
    assert box.handle.batched_colors[1].tolist() != [255, 255, 255]


def test_a_frame_takes_one_message_for_each_node_that_moves(
    server: viser.ViserServer, model: mujoco.MjModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    layer = Layer(server, "messages")
    qpos = random_qpos(model, 2)
    qpos[1, 3:7] = qpos[0, 3:7]  # the arm does not turn, its hinge does, and so the tip, which is a box as the wall is
    layer.show(Figure.from_model(model, qpos))
    sent: list[Message] = []
    monkeypatch.setattr(server.scene, "_queue_scene_message", sent.append)
    layer.pose(1)
    said = {message.name: set(message.updates) for message in sent if isinstance(message, SceneNodeUpdateMessage)}
    assert len(said) == len(sent)
    assert set(said) == set(layer.node_names)
    assert said["/messages/box"] == {"batched_positions", "batched_wxyzs"}
    assert said["/messages/cylinder"] == {"batched_positions"}
    layer.pose(1)
    assert len(sent) == len(said)
    layer.show(Figure.from_model(model, qpos), 1)
    assert len(sent) == len(said)


@pytest.mark.parametrize("aspect", [0.75, 0.46])
def test_a_flat_scene_is_seen_from_above_and_whole(aspect: float) -> None:
    low, high = np.array([-8.0, -1.0, -0.1]), np.array([4.0, 10.0, 0.1])
    fov = FIELD_OF_VIEW
    position, target = camera(low, high, aspect)
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    assert forward[2] < -0.9
    for corner in np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T:
        seen = corner - position
        depth = seen @ forward
        assert abs(seen @ right) / depth <= np.tan(fov / 2) * aspect
        assert abs(seen @ up) / depth <= np.tan(fov / 2)


def test_in_a_narrow_page_a_scene_is_seen_above_the_panel() -> None:
    low, high = np.array([-8.0, -1.0, -0.1]), np.array([4.0, 10.0, 0.1])
    heights = []
    for aspect in (0.75, 0.46):
        position, target = camera(low, high, aspect)
        forward = (target - position) / np.linalg.norm(target - position)
        up = np.cross(np.cross(forward, [0, 0, 1]) / np.linalg.norm(np.cross(forward, [0, 0, 1])), forward)
        middle = (low + high) / 2 - position
        heights.append((middle @ up) / (middle @ forward) / np.tan(FIELD_OF_VIEW / 2))
    assert heights == pytest.approx([0.0, 0.45], abs=0.05)


@pytest.mark.parametrize("other", [USUAL_ASPECT, 2.0])
@pytest.mark.parametrize("aspect", [0.3, 0.46, NARROW, 1.8])
def test_a_page_without_a_panel_sees_a_scene_as_large_as_any_other_page(aspect: float, other: float) -> None:
    box = np.array([-8.0, -1.0, -0.1]), np.array([4.0, 10.0, 5.0])
    usual = camera(*box)
    shown = seen_elsewhere(*camera(*box, min(aspect, USUAL_ASPECT)), aspect, other)
    assert np.linalg.norm(shown[1] - usual[1]) < 0.3
    assert np.linalg.norm(shown[0] - shown[1]) == pytest.approx(np.linalg.norm(usual[0] - usual[1]), rel=0.25)
    farther = seen_elsewhere(*camera(*box), USUAL_ASPECT, USUAL_ASPECT / 2)
    assert np.linalg.norm(farther[0] - farther[1]) == pytest.approx(2 * np.linalg.norm(usual[0] - usual[1]))
