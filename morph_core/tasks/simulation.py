"""Hw-Phy of a hand: MuJoCo's transition, one simulation for each environment, each on the model of its own design."""

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import mujoco
import mujoco.batch
import numpy as np

from morph_core.task import Watch
from morph_core.tasks.hand import Hand

TIMESTEP = 0.01  # s
SUBSTEPS = 10
"""Physics steps per control step."""
SENSOR_SIZE = 4
"""Number of values that a contact sensor gives: how many contacts there are, and where (m) the strongest is."""
FASTEST = 100.0
"""Speed in m/s or rad/s beyond which a simulation has exploded."""


class Simulated(Protocol):
    """What the physics of a hand wants to know of a task."""

    @property
    def hand(self) -> Hand:
        """Hand that is simulated, without a design."""
        ...

    def scene(self, phi: np.ndarray) -> mujoco.MjSpec:
        """Return hand, object, table and contact sensors with design phi (d,)."""
        ...

    def set_design(self, scene: mujoco.MjSpec, phi: np.ndarray) -> None:
        """Give what `scene` made for another design the design phi (d,)."""
        ...

    def buildable(self, phi: np.ndarray) -> np.ndarray:
        """Tell (...) which designs (..., d) can be put together at all."""
        ...

    def split(self, s: np.ndarray) -> list[np.ndarray]:
        """Return qpos (N, nq), qvel (N, nv) and the warm start (N, nv) of states s."""
        ...

    def ctrl(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the servos' targets (N, joints) while a is executed from states s on."""
        ...

    def change(self, s: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return z (N, z_size) of a step from one state to another."""
        ...


@dataclass(frozen=True)
class Outcome:
    """What the physics did in one control step of N environments."""

    s: np.ndarray  # (N, state_size)
    z: np.ndarray  # (N, z_size), NaN where the simulation diverged
    sensors: np.ndarray  # (N, fingers, 2, SENSOR_SIZE): each distal link on the button, each finger on the object
    diverged: np.ndarray  # (N,) bool


class HandPhysics:
    """Hw-Phy of a hand, F_phi(s' | s, a): every environment on the compiled model of its own design.

    s holds MuJoCo's qpos, qvel and the solver's warm start: all that the next step depends on.
    """

    def __init__(self, task: Simulated, phi: np.ndarray, scene: mujoco.MjSpec | None = None) -> None:
        """Simulate the scene of each design phi (d,) or (N, d), or one `scene` that was made for phi (d,)."""
        self.phi = phi
        self.buildable = task.buildable(phi)  # () or (N,) bool
        self._task = task
        distinct, which = np.unique(np.atleast_2d(phi), axis=0, return_inverse=True)
        models = [scene.compile()] if scene else list(_compiled(task, distinct))
        self.watch: Watch | None = None
        self._models = [models[i] for i in which.reshape(-1)]
        self._batch: mujoco.batch.Batch | None = None

    def __call__(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        return self.run(s, a).z

    def run(self, s: np.ndarray, a: np.ndarray) -> Outcome:
        """Advance states s (N, state_size) by one control step with target changes a (N, action_size)."""
        task, batch = self._task, self._batch_of(len(s))
        fields = [batch.bind(name) for name in ("qpos", "qvel", "qacc_warmstart")]
        for live, part in zip(fields, task.split(s), strict=True):
            live[:] = part
        batch.bind("ctrl")[:] = task.ctrl(s, a)
        batch.bind("time")[:] = 0.0
        warnings = batch.warning
        warnings[:] = 0
        with _counted_warnings():
            self._advance(batch)
        after = np.concatenate(fields, 1)
        qvel = fields[1]
        with np.errstate(invalid="ignore"):
            calm = (np.abs(qvel) < FASTEST).all(1)
        diverged = warnings[..., 1].any(1) | ~np.isfinite(after).all(1) | ~calm
        after[diverged] = s[diverged]
        z = task.change(s, after)
        z[diverged] = np.nan
        sensors = batch.bind("sensordata").reshape(len(s), task.hand.fingers, 2, SENSOR_SIZE).copy()
        sensors[diverged] = 0.0
        return Outcome(after, z, sensors, diverged)

    def _advance(self, batch: mujoco.batch.Batch) -> None:
        """Advance all simulations by a control step, one physics step at a time where somebody watches."""
        if self.watch is None:
            batch.step(nstep=SUBSTEPS)
            return
        for _ in range(SUBSTEPS):
            before = batch.bind("qvel").copy()
            batch.step(nstep=1)
            self.watch(before, batch.bind("actuator_force").copy())

    def _batch_of(self, environments: int) -> mujoco.batch.Batch:
        if self._batch is None or self._batch.nsim != environments:
            if len(self._models) not in (1, environments):
                raise ValueError(f"{len(self._models)} designs don't fit {environments} environments")
            threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
            self._batch = mujoco.batch.Batch(self._models[0], environments, nthread=min(threads, environments))
            if len(self._models) > 1:
                self._batch.set_models(self._models)
        return self._batch


def _compiled(task: Simulated, designs: np.ndarray) -> Iterator[mujoco.MjModel]:
    """Yield the model of each design (N, d): one scene is given all of them, which takes a third of the time that as
    many scenes do. A task that has a scene of its own, and not how it is given a design, makes one for each."""
    if not issubclass(_definer(task, "set_design"), _definer(task, "scene")):
        yield from (task.scene(design).compile() for design in designs)
        return
    scene = task.scene(designs[0])
    for design in designs:
        task.set_design(scene, design)
        yield scene.compile()


def _definer(task: Simulated, name: str) -> type:
    """Return the class that defines a method of a task."""
    return next(kind for kind in type(task).__mro__ if name in vars(kind))


def set_physics(spec: mujoco.MjSpec) -> None:
    """Choose time step and solver: what was found to keep a grasp."""
    option = spec.option
    option.timestep = TIMESTEP
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 5
    option.iterations, option.ls_iterations = 100, 50  # with 20 and 10, one random episode in ten explodes
    # A diverged simulation must show: the automatic reset would return a plausible state.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET


def add_contact_sensor(spec: mujoco.MjSpec, kind: mujoco.mjtObj, finger: str, target: str) -> None:
    """Sense contacts of a body (mjOBJ_BODY), or of it and all it carries (mjOBJ_XBODY), with the body `target`."""
    fields = mujoco.mjtConDataField
    sensor = spec.add_sensor(
        name=f"{finger}_on_{target}", type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=kind, objname=finger,
        reftype=mujoco.mjtObj.mjOBJ_BODY, refname=target,
    )  # fmt: skip
    strongest = 2
    sensor.intprm = [1 << int(fields.mjCONDATA_FOUND) | 1 << int(fields.mjCONDATA_POS), strongest, 1]
    sensor.dim = SENSOR_SIZE


@contextlib.contextmanager
def _counted_warnings() -> Iterator[None]:
    """Keep MuJoCo's warnings off stderr and out of a MUJOCO_LOG.TXT: the batch counts them for each simulation."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
