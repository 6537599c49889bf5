"""A hand as the page needs it: the exported scene, its policy and its task's rule, as JSON."""

import base64
from xml.etree import ElementTree

import numpy as np

from morph_core.history import History
from morph_core.task import Task
from morph_core.tasks.grasp import PRESSED, GraspTask
from studio.export.bundle import parts_of_design, robot_files
from studio.export.errors import ExportError
from studio.export.policy import Policy, policy_at
from studio.robots.chooser import robot_of
from studio.robots.stl import stl
from studio.show.prints import lightened

_SCENE = "scene.xml"


def check_hand(task: Task) -> GraspTask:
    """Return the task if a hand does it; ExportError says that the page is for hands alone."""
    if not isinstance(task, GraspTask):
        raise ExportError(f"show is for hands that MuJoCo simulates, such as pen_press; this run is of {task.name}")
    return task


def rule_of(task: GraspTask) -> dict[str, object]:
    """Return what the page judges and starts a try with, as the task does."""
    return {
        "noun": task.object_noun,
        "horizon": task.horizon,
        "control_dt": task.control_dt,
        "fingers": task.hand.fingers,
        "joints": task.hand.joints,
        "half_extents": task.half_extents.tolist(),
        "start_noise": task.start_noise,
        "lift_height": task.lift_height,
        "pressed_at": -PRESSED * task.travel,
        "besides_presser": task.grasp == "two_besides_presser",
    }


def hand_of(history: History, task: GraspTask, iteration: int, phi: np.ndarray) -> dict[str, object]:
    """Return one design (d,) as the page runs it; ExportError with the reason where it can't be built.

    The policy is that of the newest checkpoint up to `iteration`; None where there is no checkpoint.
    """
    try:
        task.check_buildable(phi)
    except ValueError as error:
        raise ExportError(str(error)) from error
    robot = robot_of(task)
    parts = parts_of_design(robot, phi)
    files = robot_files(task, phi, parts, ["mjcf"])
    files |= {part.stl_path: stl(*lightened(part.vertices, part.faces), part.name) for part in parts}
    policy = policy_at(history, iteration, phi)
    units = {name: array.tolist() for name, array in robot.program(phi).arrays.items()}
    scene = _with_contact_sensors(files[_SCENE], task.scene(phi).to_xml())
    return {
        "xml": scene,
        "files": {path: _base64(content) for path, content in files.items() if f'file="{path}"' in scene},
        "layers": None if policy is None else _layers(policy),
        **units,
    }


def _with_contact_sensors(scene: bytes, original: str) -> str:
    """Return the exported scene with the task's contact sensors, which its own words, those of MuJoCo 3.2, lack."""
    root = ElementTree.fromstring(scene)
    root.extend(ElementTree.fromstring(original).findall("sensor"))
    return ElementTree.tostring(root, encoding="unicode")


def _layers(policy: Policy) -> list[dict[str, str]]:
    pairs = zip(policy.weights, policy.biases, strict=True)
    return [{"weight": _floats(weight), "bias": _floats(bias)} for weight, bias in pairs]


def _floats(array: np.ndarray) -> str:
    return _base64(np.ascontiguousarray(array, dtype="<f4").tobytes())


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()
