"""The robot in the formats of simulators, with the parts that it shows there: the same bytes for the same design."""

from collections.abc import Sequence

import mujoco
import numpy as np

from morph_core.task import Task
from studio.export.archive import json_file, zipped
from studio.export.control import control_settings
from studio.export.mjcf import write_mjcf
from studio.export.ros import ros_package
from studio.export.urdf import write_urdf
from studio.export.zero import hold_keyframes, moved_zero, servo_targets
from studio.robots.chooser import robot_of
from studio.robots.parts import Part, dress, stl_files


def simulated_files(task: Task, phi: np.ndarray, parts: Sequence[Part], formats: Sequence[str]) -> dict[str, bytes]:
    """Return the robot in the formats of simulators, and its parts as STL, which those show."""
    robot = robot_of(task)
    spec, scene = task.spec(phi), task.scene(phi)
    _add_start(task, scene, phi)
    hold_keyframes(spec)
    hold_keyframes(scene)
    zero = robot.zero(phi)
    spec, scene = moved_zero(spec, zero), moved_zero(scene, zero)
    model, name = spec.compile(), robot.file_name
    worn = parts if robot.printed else []
    shown = stl_files(worn)
    files: dict[str, bytes] = {}
    if "stl" in formats:
        files |= stl_files(parts)
    if {"mjcf", "urdf", "ros"} & set(formats):
        files |= shown
    if "mjcf" in formats:
        plain = write_mjcf(dress(spec, worn, shown), f"{name}.xml", "meshes", shown)
        files |= plain | write_mjcf(dress(scene, worn, shown), "scene.xml", "meshes_scene", shown)
        files[f"{name}.mjz"] = zipped({"model.xml": plain.pop(f"{name}.xml"), **plain, **shown})
    if {"urdf", "ros"} & set(formats):
        visuals = {link: part.stl_path for part in worn for link in part.links}
        drives = "ros2_control" in formats
        urdf = write_urdf(model, f"{name}.urdf", task.name, visuals, robot.speeds, drives=drives)
        if "ros" in formats:
            size = float(model.stat.extent)
            files |= ros_package(task.name, name, urdf[f"{name}.urdf"], {**shown, **urdf}, size)
        files |= urdf if "urdf" in formats else {}
        files["control.json"] = json_file(control_settings(model, scene.compile(), zero))
    return files


def _add_start(task: Task, scene: mujoco.MjSpec, phi: np.ndarray) -> None:
    """Give the scene a keyframe: a start of the task, which its servos hold."""
    if any(key.name == "start" for key in scene.keys):
        return
    qpos = task.qpos(task.reset(task.hw_phy(phi), 1, np.random.default_rng(0)))[0]
    scene.add_key(name="start", qpos=qpos, ctrl=servo_targets(scene.compile(), qpos))
