"""What a policy asks of each joint's drive: force and speed at every step of the physics, over many episodes."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from morph_core.task import Hardware, WatchedHardware

SHARE = 95.0
"""Per cent of all instants at which a drive must be at least as strong and as fast as the percentiles say."""


@dataclass
class Recorder:
    """The speeds and forces of all simulations at every step of the physics."""

    speeds: list[np.ndarray] = field(default_factory=list)
    """Speeds of the joints (N, nv) at the start of each step, in m/s or rad/s."""
    forces: list[np.ndarray] = field(default_factory=list)
    """Forces of the actuators (N, nu) in each step, in N or N m."""
    kept: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    """Episodes (N,) that count, which are those that did not diverge."""

    def __call__(self, speeds: np.ndarray, forces: np.ndarray) -> None:
        self.speeds.append(speeds)
        self.forces.append(forces)

    def watch(self, hardware: Hardware) -> None:
        """Record what happens from now on, where the hardware can be watched."""
        if isinstance(hardware, WatchedHardware):
            hardware.watch = self


@dataclass(frozen=True)
class Need:
    """What one joint's drive does at each instant of all episodes."""

    joint: str
    slides: bool
    """Whether the joint slides: forces are in N then, speeds in m/s."""
    force: np.ndarray  # (instants,) N m or N, signed
    speed: np.ndarray  # (instants,) rad/s or m/s, signed


def needs_of(recorder: Recorder, model: mujoco.MjModel, joints: Sequence[str]) -> list[Need]:
    """Return what was asked of the actuators of these joints; [] where nothing was recorded."""
    if not recorder.forces or not recorder.kept.any():
        return []
    speeds, forces = (
        np.stack(steps)[:, recorder.kept].reshape(-1, steps[0].shape[1]) for steps in (recorder.speeds, recorder.forces)
    )
    found = []
    for name in joints:
        joint = model.joint(name).id
        (actuator,) = np.flatnonzero(model.actuator_trnid[:, 0] == joint)
        slides = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
        found.append(Need(name, slides, forces[:, actuator], speeds[:, model.jnt_dofadr[joint]]))
    return found


def peak(values: np.ndarray) -> float:
    """Return the largest size of values (n,)."""
    return float(np.abs(values).max())


def percentile(values: np.ndarray) -> float:
    """Return the smallest size of values (n,) that `SHARE` per cent of them do not exceed."""
    return float(np.percentile(np.abs(values), SHARE, method="inverted_cdf"))


def on_load_line(force: np.ndarray, speed: np.ndarray, stall: float, no_load: float) -> np.ndarray:
    """Return which share (n,) of what a motor can do it does at each instant, with `force` (n,) at `speed` (n,).

    The force that a DC motor has left falls in a straight line from `stall` at rest to nothing at `no_load`. Where it
    brakes, it has all its force at any speed.
    """
    pull, turn = np.abs(force) / stall, np.abs(speed) / no_load
    return np.where(force * speed > 0, pull + turn, np.maximum(pull, turn))
