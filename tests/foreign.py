"""Tasks of a stranger's package: pointers of two links, of which this one knows nothing but the Task protocol."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from morph_core.design import DesignSpace
from morph_core.protocol import Parameter
from morph_core.task import Hardware, Task, Transition


class Reach:
    """Where the tip is after a change of the joint angles."""

    def __init__(self, phi: np.ndarray) -> None:
        self.phi = phi  # (2,) or (N, 2) m

    def __call__(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        heading = np.cumsum(s[:, :2] + a, 1)
        return np.stack([(self.phi * np.cos(heading)).sum(1), (self.phi * np.sin(heading)).sum(1)], 1)


@dataclass(frozen=True)
class Pointer(Task):
    """Two links in a plane, moved joint by joint; s = joint angles.

    Task: bring the tip to the goal. Randomised: the joint angles at the start. Success: the tip is there once.
    """

    goal: tuple[float, float] = (0.2, 0.4)
    """m."""

    name: ClassVar[str] = "pointer"
    success_rule: ClassVar[str] = "the tip is there once."
    horizon: ClassVar[int] = 20
    control_dt: ClassVar[float] = 0.1
    state_size: ClassVar[int] = 2
    observation_size: ClassVar[int] = 2
    action_size: ClassVar[int] = 2
    z_size: ClassVar[int] = 2
    observation_units = (np.zeros(2), np.full(2, 3.0))  # rad
    action_units = np.full(2, 0.3)  # rad

    @property
    def design_space(self) -> DesignSpace:
        return DesignSpace(tuple(Parameter(f"rod_{i}", "m", 0.1, 0.6, 0.3, 0.1, 0.6, part=f"rod_{i}") for i in (1, 2)))

    def hw_phy(self, phi: np.ndarray) -> Hardware:
        return Reach(phi)

    def reset(self, hw_phy: Hardware, environments: int, rng: np.random.Generator) -> np.ndarray:
        return 0.1 * rng.standard_normal((environments, 2))

    def observe(self, s: np.ndarray) -> np.ndarray:
        return (s[:, :2] / 3).astype(np.float32)

    def sample_pairs(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        return rng.uniform(-3, 3, (count, 2)), 0.3 * rng.uniform(-1, 1, (count, 2))

    def step(self, hardware: Hardware, s: np.ndarray, action: np.ndarray) -> Transition:
        a = self.action_units * np.clip(action, -1, 1)
        z = hardware(s, a)
        distance = np.linalg.norm(z - self.goal, axis=1)
        there, never = distance < 0.05, np.zeros(len(s), bool)
        return Transition(
            s=s + a, a=a, z=z, reward=-distance, reward_terms={"distance": -distance}, terminated=there, diverged=never,
            success=there, contact=np.empty((len(s), 0, 3)),
        )  # fmt: skip

    def spec(self, phi: np.ndarray) -> mujoco.MjSpec:
        spec = mujoco.MjSpec()
        spec.worldbody.add_geom(name="foot", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.05, 0.05, 0.02])
        body = spec.worldbody
        for i, length in enumerate(phi):
            body = body.add_body(name=f"rod_{i + 1}", pos=[phi[0] if i else 0.0, 0, 0])
            body.add_joint(name=f"hinge_{i + 1}", axis=[0, 0, 1])
            rod = body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, length, 0, 0], size=[0.02, 0, 0])
            rod.rgba = [0.2, 0.4 + 0.3 * i, 0.8, 1]
        return spec

    def scene(self, phi: np.ndarray) -> mujoco.MjSpec:
        spec = self.spec(phi)
        spec.worldbody.add_geom(name="goal", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.05, 0, 0], pos=[*self.goal, 0])
        return spec

    def qpos(self, s: np.ndarray) -> np.ndarray:
        return s


@dataclass(frozen=True)
class Unnamed(Pointer):
    """The same pointer, which says nothing about its units."""

    name: ClassVar[str] = "unnamed"
    observation_units = None


class Simulated:
    """MuJoCo's own step with torques `a`: s = qpos, qvel."""

    def __init__(self, model: mujoco.MjModel, substeps: int) -> None:
        self.model, self.substeps = model, substeps

    def __call__(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        data = mujoco.MjData(self.model)
        after = []
        for row, torque in zip(s, a, strict=True):
            mujoco.mj_resetData(self.model, data)
            data.qpos[:], data.qvel[:], data.ctrl[:] = row[:2], row[2:], torque
            mujoco.mj_step(self.model, data, nstep=self.substeps)
            after.append(np.concatenate([data.qpos, data.qvel]))
        return np.array(after)


@dataclass(frozen=True)
class Swinging(Pointer):
    """The same links, driven by motors in MuJoCo; s = qpos, qvel."""

    name: ClassVar[str] = "swinging"
    state_size: ClassVar[int] = 4
    observation_size: ClassVar[int] = 4
    z_size: ClassVar[int] = 4
    observation_units = (np.zeros(4), np.array([3.0, 3.0, 10.0, 10.0]))  # rad, rad/s
    action_units = np.full(2, 0.5)  # N m

    def hw_phy(self, phi: np.ndarray) -> Hardware:
        return Simulated(self.scene(phi).compile(), round(self.control_dt / 0.002))

    def hw_phy_from(self, scene: mujoco.MjSpec, phi: np.ndarray) -> Hardware:
        return Simulated(scene.compile(), round(self.control_dt / 0.002))

    def reset(self, hw_phy: Hardware, environments: int, rng: np.random.Generator) -> np.ndarray:
        return np.pad(super().reset(hw_phy, environments, rng), ((0, 0), (0, 2)))

    def observe(self, s: np.ndarray) -> np.ndarray:
        return (s / self.observation_units[1]).astype(np.float32)

    def step(self, hardware: Hardware, s: np.ndarray, action: np.ndarray) -> Transition:
        a = self.action_units * np.clip(action, -1, 1)
        z = hardware(s, a)
        there, never = np.abs(z[:, 0] - 1) < 0.1, np.zeros(len(s), bool)
        cost = -np.abs(z[:, 0] - 1)
        return Transition(
            s=z, a=a, z=z, reward=cost, reward_terms={"angle": cost}, terminated=there, diverged=never, success=there,
            contact=np.empty((len(s), 0, 3)),
        )  # fmt: skip

    def spec(self, phi: np.ndarray) -> mujoco.MjSpec:
        spec = super().spec(phi)
        for i in (1, 2):
            spec.add_actuator(name=f"motor_{i}", target=f"hinge_{i}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        return spec

    def qpos(self, s: np.ndarray) -> np.ndarray:
        return s[:, :2]
