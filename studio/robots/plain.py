"""Any other robot: what its MuJoCo model shows is all that is known of it, and enough for an export."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from morph_core.task import Task
from morph_core.tasks.servos import ServoLimits, ServoName
from studio.robots import geometry
from studio.robots.parts import MILLIMETRE, Part, free_name, link_names
from studio.robots.robot import Bought, Program, Quantity
from studio.robots.shapes import solid_of
from studio.robots.units import speeds_of, units_of

OFF_ALLOWED = 0.01
"""Largest distance between where MuJoCo and the task take the robot in one control step, as a share of the way."""


@dataclass(frozen=True)
class PlainRobot:
    """A robot of a task that says no more of it than `spec`."""

    task: Task

    file_name = "robot"
    printed = False
    servo_joints = ()
    servo_limits: ServoLimits = "none"
    about_servos = ""
    about_parts = "<p>The collision shapes of each link: they stand in for parts, which nobody has drawn."

    @property
    def has_parts(self) -> bool:
        """Whether any body of the initial design has a shape with a volume."""
        return bool(self.parts(self.task.design_space.initial))

    def parts(self, phi: np.ndarray) -> list[Part]:
        """Return the shapes of each body as a part; ValueError for a design (d,) that can't be put together."""
        self.task.check_buildable(phi)
        model = self.task.spec(phi).compile()
        found: list[Part] = []
        for body, link in enumerate(link_names(model)):
            solid = solid_of(model, body)
            if solid is not None:
                name = free_name(re.sub(r"[^A-Za-z0-9_-]+", "_", link)[:60], {part.name for part in found})
                density = float(model.body_mass[body]) / (solid.volume() * MILLIMETRE**3)
                found.append(Part(name, (link,), *geometry.mesh(solid), density))
        return found

    def bought(self, phi: np.ndarray, parts: Sequence[Part], servo: ServoName | None) -> list[Bought]:
        """Return nothing: a model does not tell what is bought."""
        return []

    def zero(self, phi: np.ndarray) -> dict[str, float]:
        """Return nothing: what a stranger's task calls zero stays zero."""
        return {}

    @property
    def speeds(self) -> dict[str, float]:
        """Speed of each joint (m/s, rad/s) that the task moves by itself; with actuators nothing is known of it."""
        model, speeds = self.task.spec(self.task.design_space.initial).compile(), speeds_of(self.task)
        if model.nu:
            return {}
        return {
            model.joint(j).name: speeds[dof]
            for j in range(model.njnt)
            if (dof := int(model.jnt_dofadr[j])) < len(speeds)
            and int(model.jnt_type[j]) in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
        }

    def program(self, phi: np.ndarray) -> Program:
        """Return a program that runs the policy in MuJoCo where that does as the task does, else one for any task."""
        if reason := why_not_in_mujoco(self.task, phi):
            about = (
                f"one line of {self.task.observation_size} numbers in, which the task's `observe` makes; one line of "
                f"{self.task.action_size} actions in [-1, 1] out;",
                f"it does not run in MuJoCo by itself: {reason}",
            )
            return Program(
                "run_observations.py", sees=_numbered("observation", self.task.observation_size),
                gives=_numbered("action", self.task.action_size), command="python run_policy.py < observations.txt",
                about=about,
            )  # fmt: skip
        model = self.task.scene(phi).compile()
        substeps = round(self.task.control_dt / model.opt.timestep)
        places, ways = coordinates(model)
        speeds = [Quantity(f"speed of {name}", f"{unit}/s") for name, unit in ways]
        driven = [Quantity(model.actuator(i).name or f"actuator_{i}", "") for i in range(model.nu)]
        return Program(
            "run_scene.py", sees=[*places, *speeds][: self.task.observation_size],
            gives=(driven or ways)[: self.task.action_size],
            arrays={**units_of(self.task), "substeps": np.array(substeps)},
        )  # fmt: skip


def _numbered(name: str, count: int) -> list[Quantity]:
    """Return quantities of which no more is known than their order."""
    return [Quantity(f"{name}_{i}", "") for i in range(count)]


def coordinates(model: mujoco.MjModel) -> tuple[list[Quantity], list[Quantity]]:
    """Return what the entries of qpos (nq,) of a model are, and along which ways its degrees of freedom (nv,) go."""
    places: list[Quantity] = []
    ways: list[Quantity] = []
    for j in range(model.njnt):
        name, kind = model.joint(j).name or f"joint_{j}", int(model.jnt_type[j])
        if kind in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            along = [Quantity(name, "rad" if kind == mujoco.mjtJoint.mjJNT_HINGE else "m")]
            places, ways = places + along, ways + along
            continue
        shifts = [Quantity(f"{name} {axis}", "m") for axis in "xyz"] if kind == mujoco.mjtJoint.mjJNT_FREE else []
        places += shifts + [Quantity(f"{name} q{axis}", "") for axis in "wxyz"]
        ways += shifts + [Quantity(f"{name} about {axis}", "rad") for axis in "xyz"]
    return places, ways


def why_not_in_mujoco(task: Task, phi: np.ndarray) -> str:
    """Return why a policy can't be run on the scene by observation_units and action_units alone; "" where it can."""
    if task.observation_units is None or task.action_units is None:
        return "the task has no observation_units and action_units"
    model, rng = task.scene(phi).compile(), np.random.default_rng(0)
    middle, spread = task.observation_units
    known = model.nq + (model.nv if model.nu else 0)
    if len(middle) > min(known, task.state_size):
        return f"it observes {len(middle)} numbers, and the scene holds {known}"
    if task.action_size != model.nu if model.nu else task.action_size > model.nv:
        room = f"{model.nu} actuators and {model.nv} degrees of freedom"
        return f"it has {task.action_size} actions, and the scene {room}"
    hardware = task.hw_phy(phi)
    before = task.reset(hardware, 1, rng)
    step = task.step(hardware, before, rng.uniform(-1, 1, (1, task.action_size)))
    for s in (before, step.s):
        if not np.allclose(task.observe(s), (s[:, : len(middle)] - middle) / spread, atol=1e-5):
            return "what it observes are not the first entries of its state"
        if not np.allclose(task.qpos(s), s[:, : model.nq], atol=1e-9):
            return "its state does not begin with qpos and qvel of the scene"
    taken = moved(model, before[0], step.a[0], round(task.control_dt / model.opt.timestep))
    own = step.s[0, : model.nq]
    if np.abs(taken - own).max() > OFF_ALLOWED * np.abs(own - before[0, : model.nq]).max() + 1e-9:
        return "MuJoCo does not move the robot as the task does"
    return ""


def moved(model: mujoco.MjModel, s: np.ndarray, a: np.ndarray, substeps: int) -> np.ndarray:
    """Return qpos (nq,) after a control step from s = (qpos, qvel, ...), as the shipped program takes it."""
    data = mujoco.MjData(model)
    data.qpos[:] = s[: model.nq]
    if model.nu:
        speeds = s[model.nq : model.nq + model.nv]
        data.qvel[: len(speeds)] = speeds
        data.ctrl[:] = a
        mujoco.mj_step(model, data, nstep=substeps)
    else:
        mujoco.mj_integratePos(model, data.qpos, np.pad(a, (0, model.nv - len(a))), 1.0)
    return data.qpos
