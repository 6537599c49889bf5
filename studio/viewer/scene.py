"""The 3-D scene: instanced primitives in a few layers, whose nodes are named once and reused by every design."""

import math
from collections import defaultdict
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import viser
from viser._messages import SceneNodeUpdateMessage

from studio.viewer import shapes
from studio.viewer.figure import Figure, Mesh

Host = viser.ViserServer | viser.ClientHandle
"""Whose scene and panels these are: those of one browser, or of all."""
CONTACT_COLOUR = (225, 30, 30)
FORCE_COLOUR = (220, 0, 170)
GHOST_COLOURS = {
    "ghost": (128, 142, 170),
    "trail": (86, 180, 233),
    "explored": (230, 159, 0),
    "generation": (0, 158, 115),
}
"""Colours of the designs that stand beside the one in front, by their layer: those of Okabe and Ito."""
FIELD_OF_VIEW = math.radians(40)
"""Vertical field of view of the camera, in radians."""
USUAL_ASPECT = 0.72
"""Width / height of the part of a usual page that no panel covers."""
NARROW = 0.7
"""Width / height of a page, such as a phone's, below which the panel lies over the lower half of the scene."""
_LIFT = 0.45
"""Height of the scene's middle above that of a narrow page, as a share of half the page's height."""
_TILT = math.radians(16)
"""Angle by which the camera leans from straight above where everything lies in one plane, in radians."""
OBLIQUE = np.array([0.55, -1.0, 0.5]) / np.linalg.norm([0.55, -1.0, 0.5])
"""Unit vector from the middle of the scene to the camera, where the scene has height."""
_AIR, _AIR_ABOVE = 1.06, 1.18
"""Factors by which the view is wider than the box: from the side; from above, where lengths are written round it."""
_MOST_LABELS = 8
"""Largest number of lines along a side of the grid that all have their length written at them; of more, every second
one has."""
_RULER_COLOUR = (150, 155, 165)


_NOTHING = {
    "batched_positions": np.zeros((1, 3), np.float32),
    "batched_wxyzs": np.array([[1, 0, 0, 0]], np.float32),
    "batched_scales": np.zeros((1, 3), np.float32),
    "batched_colors": np.zeros((1, 3), np.uint8),
}
"""What a node has of which nothing is to be seen. A browser that is busy applies the visibility of a node at once and
its arrays later, so that a body would be seen in pieces where its nodes came and went by their visibility."""


class _Changes(SceneNodeUpdateMessage):
    """Arrays that a node's properties become.

    viser's own message looks at the type of every value, and is found again by its node, in case that is removed or
    made anew, which no node of a layer is.
    """

    def redundancy_key(self) -> str:
        """Return what a later message has in common with this one that takes its place."""
        return f"{self.name}:{','.join(self.updates)}"

    def entity_state_key(self) -> None:
        """Leave the message out of viser's index of messages by node."""

    def as_serializable_dict(self, binary_buffers: list[memoryview] | None = None) -> dict[str, Any]:
        """Return what goes to the browsers; the arrays themselves are appended to `binary_buffers`."""
        if binary_buffers is None:
            return super().as_serializable_dict()
        places = {}
        for name, array in self.updates.items():
            places[name] = {"__binary_index": len(binary_buffers), "dtype": array.dtype.str}
            binary_buffers.append(array.data)
        return {"type": "SceneNodeUpdateMessage", "name": self.name, "updates": places, "owner": self.owner}


@dataclass
class _Batch:
    """One instanced node, and which parts of the figure are its instances."""

    handle: viser.BatchedMeshHandle
    parts: list[int]
    mesh: Mesh | None = None
    course: tuple[np.ndarray, np.ndarray] | None = None
    """Positions (T, k, 3) and orientations (T, k, 4) of the instances, once they have been asked for."""


class Layer:
    """One figure in the scene. Another figure replaces it under the same node names."""

    def __init__(self, host: Host, name: str, *, opacity: float | None = None) -> None:
        self._host = host
        self._name = name
        self._opacity = opacity
        self._batches: dict[str, _Batch] = {}
        self._figure: Figure | None = None
        self._instant = -1

    @property
    def node_names(self) -> list[str]:
        """Return the names of the nodes that the layer has made."""
        return [batch.handle.name for batch in self._batches.values()]

    def show(self, figure: Figure | None, instant: int = 0, colours: np.ndarray | None = None) -> None:
        """Draw `figure` at an instant, in its own colours or in `colours` (n, 3) uint8; None draws nothing."""
        groups = _groups(figure) if figure else {}
        arrays = {key: _instances(figure, key, parts, instant) for key, parts in groups.items()} if figure else {}
        painted = colours if colours is not None else figure.colours if figure else np.zeros((0, 3), np.uint8)
        with self._host.atomic():
            for key, batch in self._batches.items():
                batch.parts, batch.course = groups.get(key, []), None
                if not batch.parts:
                    _change(batch.handle, _NOTHING)
            for key, parts in groups.items():
                self._place(key, parts, figure.meshes[parts[0]] if figure else None, *arrays[key], painted[parts])
        self._figure, self._instant = figure, instant

    def pose(self, instant: int) -> None:
        """Move the parts to another instant of the same figure."""
        figure = self._figure
        if figure is None or instant == self._instant:
            return
        with self._host.atomic():
            for batch in self._shown:
                if batch.course is None:  # picked once, so that each frame of it is sent as it stands in memory
                    batch.course = figure.positions[:, batch.parts], figure.wxyz[:, batch.parts]
                positions, wxyz = batch.course
                _change(batch.handle, {"batched_positions": positions[instant], "batched_wxyzs": wxyz[instant]})
        self._instant = instant

    def paint(self, colours: np.ndarray) -> None:
        """Give the parts other colours (n, 3) uint8."""
        for batch in self._shown:
            _change(batch.handle, {"batched_colors": _linear(colours[batch.parts])})

    @property
    def _shown(self) -> list[_Batch]:
        return [batch for batch in self._batches.values() if batch.parts]

    def _place(
        self,
        key: str,
        parts: list[int],
        mesh: Mesh | None,
        positions: np.ndarray,
        wxyz: np.ndarray,
        scales: np.ndarray,
        colours: np.ndarray,
    ) -> None:
        batch = self._batches.get(key)
        if batch is None:
            vertices, faces = (mesh.vertices, mesh.faces) if mesh else _unit(key)
            handle = self._host.scene.add_batched_meshes_simple(
                f"/{self._name}/{key}", vertices, faces, wxyz, positions, batched_scales=scales,
                batched_colors=_linear(colours),
                opacity=self._opacity, lod="off", flat_shading=mesh is not None, cast_shadow=False,
                receive_shadow=False,
            )  # fmt: skip
            self._batches[key] = _Batch(handle, parts, mesh)
            return
        batch.parts = parts
        shape: dict[str, np.ndarray] = {}
        if mesh and batch.mesh and not _same(mesh, batch.mesh):
            shape, batch.mesh = {"vertices": mesh.vertices, "faces": mesh.faces}, mesh
        placed = {"batched_positions": positions, "batched_wxyzs": wxyz, "batched_scales": scales}
        _change(batch.handle, shape | placed | {"batched_colors": _linear(colours)})


class Arrows:
    """Arrows of one colour in the scene, which come and go from frame to frame."""

    def __init__(self, host: Host, name: str, colour: tuple[int, int, int]) -> None:
        self._host = host
        self._name = f"/{name}/arrows"
        self._colour = colour
        self._radius = 0.0
        self._handle: viser.ArrowsHandle | None = None
        self._shown = np.zeros((0, 2, 3), np.float32)

    def show(self, arrows: np.ndarray, radius: float) -> None:
        """Draw arrows (n, 2, 3) from start to end, with shafts of this radius in m."""
        arrows = arrows.astype(np.float32, copy=False)
        if arrows is self._shown or np.array_equal(arrows, self._shown):
            return
        self._shown = arrows
        if self._handle is None or radius != self._radius:
            self._radius = radius
            self._handle = self._host.scene.add_arrows(
                self._name, arrows, self._colour,
                shaft_radius=radius, head_radius=2.5 * radius, head_length=5 * radius,
            )  # fmt: skip
        self._handle.visible = bool(len(arrows))
        if len(arrows):
            self._handle.points = arrows


class Letters:
    """Letters that stand above things in the scene, to tell them apart."""

    def __init__(self, host: Host, name: str, letters: tuple[str, ...]) -> None:
        self._host = host
        self._name = name
        self._letters = letters
        self._handles: list[viser.LabelHandle] = []

    def show(self, places: np.ndarray | None) -> None:
        """Put each letter at its place (n, 3); None takes them away."""
        if places is not None and not self._handles:
            self._handles = [
                self._host.scene.add_label(
                    f"/{self._name}/{letter}", letter, font_screen_scale=1.8, anchor="bottom-center"
                )
                for letter in self._letters
            ]
        for i, handle in enumerate(self._handles):
            handle.visible = places is not None
            if places is not None:
                handle.position = places[i]


def _change(handle: viser.BatchedMeshHandle, arrays: dict[str, np.ndarray]) -> None:
    """Give properties of a node other values, all of them by one message; what has its value already is left out.

    The setters of viser's handles send a message for each property, which takes most of the time of a frame. The arrays
    become the handle's own: whoever calls changes them no more.
    """
    props = handle._impl.props
    changed = {
        name: np.ascontiguousarray(array)
        for name, array in arrays.items()
        if not np.array_equal(getattr(props, name), array)
    }
    if changed:
        for name, array in changed.items():
            setattr(props, name, array)
        handle._impl.api._queue_scene_message(_Changes(handle.name, changed))


def light_up(host: Host) -> None:
    """Light the scene evenly: colours must look the same on the light and on the dark theme."""
    host.scene.configure_default_lights(enabled=False)
    host.scene.configure_environment_map(None)
    host.scene.add_light_ambient("/light/ambient", intensity=1.7)
    host.scene.add_light_directional("/light/above", intensity=1.9, position=(-3.0, -4.0, 8.0))


def clients_of(host: Host) -> list[viser.ClientHandle]:
    """Return the browsers that see what is drawn for the host."""
    return list(host.get_clients().values()) if isinstance(host, viser.ViserServer) else [host]


def initial_camera_of(host: Host) -> viser.InitialCameraConfig:
    """Return where the camera begins and is reset to; viser offers that for all browsers at once, and means it so."""
    if isinstance(host, viser.ViserServer):
        return host.initial_camera
    return viser.InitialCameraConfig(host._websock_connection.queue_message)


class Ruler:
    """A grid with its lengths written along two sides, and a pole with heights, so that metres can be read off."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self._labels: list[viser.LabelHandle] = []

    def show(self, floor: tuple[np.ndarray, np.ndarray], box: tuple[np.ndarray, np.ndarray]) -> None:
        """Draw the grid on `floor`, and a pole beside `box` unless that is flat; each is a pair of corners (3,)."""
        low, high = floor
        cell = round_up(float(np.max(high - low)) / 10)
        start, end = np.floor(low[:2] / cell + 1e-6) * cell, np.ceil(high[:2] / cell - 1e-6) * cell
        z = float(low[2]) + 0.004 * cell
        xs, ys = _ticks(start[0], end[0], cell), _ticks(start[1], end[1], cell)
        heights = [] if is_flat(*box) else _ticks(cell, float(box[1][2] - z), cell)
        lines = [((x, ys[0], z), (x, ys[-1], z)) for x in xs] + [((xs[0], y, z), (xs[-1], y, z)) for y in ys]
        lines += [((xs[0], ys[-1], z), (xs[0], ys[-1], z + h)) for h in heights[-1:]]
        self._host.scene.add_line_segments(
            "/ruler/lines", np.array(lines, np.float32), _RULER_COLOUR, thickness=1.0, thickness_units="screen"
        )
        seldom = 2 * cell if len(xs) > _MOST_LABELS else cell
        ticks = [((x, ys[0], z), f"{x:g} m") for x in _multiples(xs, seldom)]
        ticks += [((xs[0], y, z), f"{y:g} m") for y in _multiples(ys[1:], seldom)]
        ticks += [((xs[0], ys[-1], z + h), f"{h:g} m") for h in heights]
        self._write(ticks, "center-center" if is_flat(*box) else "bottom-center")

    def _write(
        self,
        ticks: list[tuple[tuple[float, float, float], str]],
        anchor: Literal["center-center", "bottom-center"],
    ) -> None:
        for i, (position, text) in enumerate(ticks):
            if i == len(self._labels):
                self._labels.append(
                    self._host.scene.add_label(f"/ruler/{i}", text, font_screen_scale=0.75, depth_test=True)
                )
            label = self._labels[i]
            label.text, label.position, label.visible, label.anchor = text, np.array(position), True, anchor
        for label in self._labels[len(ticks) :]:
            label.visible = False


def is_flat(low: np.ndarray, high: np.ndarray) -> bool:
    """Tell whether a box between two corners (3,) is so low that it is best seen from above."""
    size = high - low
    return bool(size[2] < 0.25 * min(size[0], size[1]))


def camera(
    low: np.ndarray, high: np.ndarray, aspect: float = USUAL_ASPECT, *, is_covered: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) and target (3,) of a camera that frames the box: from above if flat, else from the side.

    `aspect` is width / height of the free part of the page. In a narrow page the box is seen in the upper half, where
    the lower one is covered by panels.
    """
    flat = is_flat(low, high)
    direction = np.array([0.0, -math.sin(_TILT), math.cos(_TILT)]) if flat else OBLIQUE
    right, up = screen_axes(direction)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), -1).reshape(-1, 3) - (low + high) / 2
    slope = math.tan(FIELD_OF_VIEW / 2) / (_AIR_ABOVE if flat else _AIR)
    across, upward, nearer = corners @ right, corners @ up, corners @ direction
    shift = (upward.max() + upward.min()) / 2
    distance = np.max(nearer + np.maximum(np.abs(across) / (slope * aspect), np.abs(upward - shift) / slope))
    distance = max(float(distance), 1e-3)
    lift = _LIFT * distance * math.tan(FIELD_OF_VIEW / 2) if is_covered and aspect < NARROW else 0.0
    target = (low + high) / 2 + (shift - lift) * up
    return target + distance * direction, target


def seen_elsewhere(
    position: np.ndarray, target: np.ndarray, aspect: float, other: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) and target (3,) of a camera that shows on a page with no panel what one shows on a page
    like the studio's; `aspect` is width / height of that one, `other` of the page with no panel."""
    away = position - target
    if aspect < NARROW:  # the scene stands in the upper half, above the panel
        _, up = screen_axes(away / np.linalg.norm(away))
        target = target + _LIFT * np.linalg.norm(away) * math.tan(FIELD_OF_VIEW / 2) * up
    factor = max(1.0, USUAL_ASPECT / other) / max(1.0, USUAL_ASPECT / aspect)
    return target + factor * away, target


def screen_axes(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit vectors (3,) that point right and up on the screen, for a camera in this direction (3,) from its
    target."""
    right = np.cross([0.0, 0.0, 1.0], direction)
    right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-9 else np.array([1.0, 0.0, 0.0])
    return right, np.cross(direction, right)


def _ticks(start: float, end: float, step: float) -> list[float]:
    return (np.round(np.arange(start, end + step / 2, step), 9) + 0.0).tolist()  # no "-0 m"


def _multiples(values: list[float], step: float) -> list[float]:
    return [value for value in values if abs(value / step - round(value / step)) < 1e-6]


def _linear(colours: np.ndarray) -> np.ndarray:
    """Return sRGB colours (n, 3) uint8 as the light intensities that viser's instances are painted with."""
    share = colours / 255
    return np.round(255 * np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)).astype(np.uint8)


def _groups(figure: Figure) -> dict[str, list[int]]:
    """Return the parts by the node that draws them: one for each kind, aspect of capsule, and mesh."""
    groups: dict[str, list[int]] = defaultdict(list)
    unique: list[Mesh] = []
    for i, (kind, size, mesh) in enumerate(zip(figure.kinds, figure.sizes, figure.meshes, strict=True)):
        if mesh is not None:
            known = next((k for k, other in enumerate(unique) if _same(mesh, other)), None)
            if known is None:
                known = len(unique)
                unique.append(mesh)
            groups[f"mesh_{known}"].append(i)
        elif kind == "capsule":
            groups[f"capsule_{shapes.capsule_bucket(size[0], size[2])}"].append(i)
        else:
            groups[kind].append(i)
    return dict(groups)


def _instances(figure: Figure, key: str, parts: list[int], instant: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions (k, 3), wxyz (k, 4) and scales (k, 3) of the parts that node `key` draws."""
    scales = figure.sizes[parts].astype(np.float32)
    if key.startswith("capsule_"):
        unit = 1 + shapes.capsule_half_length(int(key.removeprefix("capsule_")))
        scales[:, 2] = (scales[:, 2] + scales[:, 0]) / unit
    return figure.positions[instant, parts], figure.wxyz[instant, parts], scales


def _unit(key: str) -> shapes.Shape:
    if key.startswith("capsule_"):
        return shapes.capsule(int(key.removeprefix("capsule_")))
    return {"box": shapes.box, "cylinder": shapes.cylinder, "sphere": shapes.sphere}[key]()


def _same(one: Mesh, other: Mesh) -> bool:
    return one is other or (
        np.array_equal(one.faces, other.faces)
        and one.vertices.shape == other.vertices.shape
        and np.allclose(one.vertices, other.vertices, atol=1e-6)
    )


def round_up(number: float) -> float:
    """Return the smallest of 1, 2 and 5 times a power of ten that is not less than `number`."""
    power = 10.0 ** math.floor(math.log10(max(number, 1e-6)))
    return next(power * step for step in (1, 2, 5, 10) if power * step >= number * 0.999)
