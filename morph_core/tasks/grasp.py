"""What the hands' tasks share: control, observation, and the paper's reward for lifting and pressing."""

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar, Literal

import mujoco
import numpy as np

from morph_core.config import LARGEST_WEIGHT, NotNegative, Settings, most
from morph_core.design import DesignSpace
from morph_core.explorations.design import Design
from morph_core.methods.direct import Direct
from morph_core.methods.no_hw_opt import NoHwOpt
from morph_core.methods.proxy import Morph
from morph_core.parts import Ppo, ProxyFit, Schedule
from morph_core.searches.cma import Cma
from morph_core.searches.cma_debiased import CmaDebiased
from morph_core.searches.drift import Drift
from morph_core.spread import ExploredDesigns
from morph_core.task import Hardware, Task, Transition
from morph_core.tasks import palette
from morph_core.tasks.hand import OBJECT_CONTACT, TABLE_CONTACT, Hand
from morph_core.tasks.printed import Servo
from morph_core.tasks.servos import SERVOS, ServoLimits
from morph_core.tasks.simulation import SUBSTEPS, TIMESTEP, HandPhysics, add_contact_sensor, set_physics

OBJECT_FRICTION = (0.8, 0.02, 0.0005)
TABLE_FRICTION = (0.8, 0.01, 0.0005)
PRESSED = 0.5
"""The share of the travel beyond which a button counts as pressed."""
BUTTON_DAMPING, BUTTON_ARMATURE, BUTTON_MASS = 1.0, 0.01, 0.01  # N s/m, kg, kg
PALM_MIDDLE, PALM_SPREAD = 0.35, 0.15  # m: the palm's height, as the policy sees it
JOINT_MIDDLE, JOINT_SPREAD = 0.55, 0.7  # rad: the fingers' joints
POSE_MIDDLE, POSE_SPREAD = (0, 0, 0.15, 1, 0, 0, 0), (0.1, 0.1, 0.15, 0.3, 0.3, 0.3, 0.3)  # m, and a quaternion
Grasp = Literal["any_two", "two_besides_presser"]

Z_PALM, Z_JOINT, Z_POSITION, Z_ROTATION = 0.03, 0.15, 0.02, 0.1
"""Typical changes of palm (m), joints (rad), object position (m) and rotation (rad) in a control step: units of z."""

# What works for the hands; docs/hands.md has the figures.
_DESIGNS = ExploredDesigns(sigma=1.0, sigma_end=0.2, hold=0.4, correlation=0.5, utility="log_rank", advantage_limit=5.0)
_NO_HW_OPT = NoHwOpt(
    hidden=128,
    schedule=Schedule(iterations=80),
    ppo=Ppo(gamma=0.97, minibatches=5, entropy_coef=0.003, std=0.6, std_end=0.3, restart_interval=30),
)
_DIRECT = Direct(**vars(_NO_HW_OPT), step=0.5, freeze_success=0.5, designs=_DESIGNS)
_MORPH = Morph(
    **vars(_NO_HW_OPT),
    design_interval=2,
    freeze_success=0.5,
    proxy=ProxyFit(prefit=10, pairs=512),
    exploration=Design(**vars(_DESIGNS), kappa=1.0, drift_clip=0.2, finish="policy"),
    # A tenth of the steps that 256 pairs, 24 designs each and a ridge of 1 take, for steps of phi as long and alike.
    search=Drift(pairs=128, designs=4, groups=16, drift_clip=0.2, ridge=0.25),
)
_CMA = Cma(pairs=256, population=10, generations=6)
_CMA_DEBIASED = CmaDebiased(pairs=128, drift_clip=0.2)


@dataclass(frozen=True)
class Columns:
    """Where the quantities of a hand and its object are in s, which begins with MuJoCo's qpos."""

    joints: slice
    """The palm's height (m) and the fingers' joints (rad)."""
    position: slice
    """The position of the object (m)."""
    orientation: slice
    """The quaternion of the object."""
    button: int
    """How far the button is out (m): 0, or negative where it is pressed."""

    @classmethod
    def of(cls, joints: int) -> "Columns":
        """Return the columns of a hand with so many joints."""
        return cls(slice(joints), slice(joints, joints + 3), slice(joints + 3, joints + 7), joints + 7)

    @property
    def moved(self) -> slice:
        """Columns of joints and object position, which change by plain differences."""
        return slice(self.position.stop)

    @property
    def seen(self) -> slice:
        """Columns of joints and object pose, which the policy sees."""
        return slice(self.orientation.stop)


@dataclass(frozen=True)
class GraspTask(Settings, Task):
    """A hand that grasps an object, lifts it and presses its button. Stateless; its subclasses say which object.

    An action changes the targets of the palm's and the fingers' servos, ten times a second.
    """

    grasp: Grasp = "any_two"
    """Rule by which the object is in the hand: it has risen with two fingers on it or its button ("any_two"), or with
    two on its body besides the one that presses ("two_besides_presser")."""
    servo: Servo = "none"
    """The servo for which the palm has pockets, one above each finger: they cost mass, and fingers need more room."""
    servo_limits: ServoLimits = "none"
    """The real servo, one for each joint of a finger, within whose limits the hand learns: its stall torque limits the
    joint's torque (4 N m without one), its no-load speed how far a target may move in a control step."""
    initial_length: Annotated[NotNegative, most(1.0, "no link is longer")] = 0.12
    """m: length of both links of every finger of the initial design."""
    lift_height: Annotated[NotNegative, most(1.0, "the palm rises no higher")] = 0.05
    """m: height above the table from which on the object is in the hand if enough fingers touch it."""
    goal_height: Annotated[NotNegative, most(1.0, "the palm rises no higher")] = 0.30
    """p_goal: height in m above the middle of the table to which the object is to be lifted."""
    distance_weight: Annotated[NotNegative, LARGEST_WEIGHT] = 0.3
    """Reward per metre between object and p_goal (enters with a minus), capped at its value at the start. Without the
    cap a shove, which the first touch nearly always is, costs reward, and the policy learns not to touch."""
    contact_weight: Annotated[NotNegative, LARGEST_WEIGHT] = 0.3
    """beta_0: reward while a distal link touches the button and the object is off the table. If it is larger, or is
    paid on the table too, the policy stays there pressing and never lifts."""
    height_weight: Annotated[NotNegative, LARGEST_WEIGHT] = 8.0
    """beta_1: reward per metre between object and table, up to `height_limit`."""
    height_limit: Annotated[NotNegative, most(1.0, "the palm rises no higher")] = 0.27
    """m: height above the table beyond which more of it pays nothing."""
    goal_bonus: Annotated[NotNegative, LARGEST_WEIGHT] = 10.0
    """beta_2: reward while a distal link presses the button and the object is in the hand."""
    reward_scale: Annotated[NotNegative, LARGEST_WEIGHT] = 0.2
    """Factor by which all weights and the bonus are multiplied."""
    palm_step: Annotated[NotNegative, most(1.0, "the palm has no longer way")] = 0.05
    """m: largest change of the palm's target per control step."""
    joint_step: Annotated[NotNegative, most(6.3, "a joint turns by less than a full turn")] = 0.3
    """rad: largest change of a joint's target per control step."""
    initial_closing: Annotated[NotNegative, most(1.0, "it is a share")] = 0.3
    """Speed at which an untrained policy moves the proximal joints inward, as a share of `joint_step`. Flailing about
    the start posture lifts the object in none of 256 episodes, closing and rising in one of seven at .26 m."""
    initial_curling: Annotated[NotNegative, most(1.0, "it is a share")] = 0.1
    """Speed at which an untrained policy curls the distal joints, as a share of `joint_step`."""
    initial_rising: Annotated[NotNegative, most(1.0, "it is a share")] = 0.15
    """Speed at which an untrained policy moves the palm upward, as a share of `palm_step`."""
    start_noise: Annotated[NotNegative, most(0.6, "the object is turned by at most half a turn")] = 0.01
    """m: largest distance of the object from the middle at the start; its largest turn is 5 rad per metre of this."""
    travel: Annotated[NotNegative, most(1.0, "no button is longer")] = 0.02
    """m: distance by which the button can be pressed in."""
    stiffness: Annotated[NotNegative, most(1e4, "a stiffer spring swings faster than a step of the simulation")] = 60.0
    """N/m: the stiffness of the button's spring."""

    horizon: ClassVar[int] = 40
    control_dt: ClassVar[float] = TIMESTEP * SUBSTEPS

    name: ClassVar[str]
    title: ClassVar[str]
    object_noun: ClassVar[str]
    """Noun by which a sentence calls the object."""
    fingers: ClassVar[int]
    runs_on_proxy: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.hand.design_space.lo[-1], self.hand.design_space.hi[-1]
        if not low <= self.initial_length <= high:
            raise ValueError(f"initial_length must lie inside [{low:g}, {high:g}] m, not {self.initial_length:g}")

    @property
    def tuned(self) -> tuple[Settings, ...]:
        return (_MORPH, _DIRECT, _NO_HW_OPT, _CMA, _CMA_DEBIASED)

    @property
    @abstractmethod
    def half_extents(self) -> np.ndarray:
        """Half-extents (3,) in m of the box round the object, which lies flat on the table, its frame in the middle."""

    @abstractmethod
    def add_object(self, spec: mujoco.MjSpec) -> None:
        """Add the bodies "object", with a free joint, and inside it "button", with a sprung slide."""

    @property
    def success_rule(self) -> str:
        return (
            f"held: in at least half of the last ten control steps a distal link presses the button while the "
            f"{self.object_noun} is in the hand, {100 * self.lift_height:g} cm above the table with two fingers on it, "
            f"or two besides the one that presses."
        )

    @property
    def hand(self) -> Hand:
        """The hand, without a design: what all designs of the task share."""
        return Hand(self.fingers, self.initial_length, servo=self.servo, servo_limits=self.servo_limits)

    @property
    def robot(self) -> Hand:
        return self.hand

    @cached_property
    def columns(self) -> Columns:
        """Columns of s in which joints, object and button are."""
        return Columns.of(self.hand.joints)

    @property
    def design_space(self) -> DesignSpace:
        return self.hand.design_space

    @property
    def _nq(self) -> int:
        return self.columns.button + 1

    @property
    def _nv(self) -> int:
        return self._nq - 1

    @property
    def state_size(self) -> int:
        return self._nq + 2 * self._nv

    @property
    def observation_size(self) -> int:
        return self.columns.seen.stop

    @cached_property
    def observation_units(self) -> tuple[np.ndarray, np.ndarray]:
        fingers = self.hand.joints - 1
        middle = np.array([PALM_MIDDLE, *[JOINT_MIDDLE] * fingers, *POSE_MIDDLE])
        return middle, np.array([PALM_SPREAD, *[JOINT_SPREAD] * fingers, *POSE_SPREAD])

    @property
    def action_size(self) -> int:
        return self.hand.joints

    @property
    def initial_action(self) -> np.ndarray:
        return np.array([self.initial_rising, *[-self.initial_closing, self.initial_curling] * self.fingers])

    @property
    def z_size(self) -> int:
        return self.hand.joints + 6

    @property
    def action_units(self) -> np.ndarray:
        """Largest change of each servo's target (action_size,), in m or rad."""
        step = self.joint_step
        if self.servo_limits != "none":
            step = min(step, SERVOS[self.servo_limits].no_load_speed * self.control_dt)
        return np.array([self.palm_step, *[step] * (2 * self.fingers)])

    def split(self, s: np.ndarray) -> list[np.ndarray]:
        """Return qpos (N, nq), qvel (N, nv) and the warm start (N, nv) of states s."""
        return np.split(s, [self._nq, self._nq + self._nv], 1)

    def change(self, s: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return z (N, z_size): the change of joints, object position and orientation in their typical units."""
        moved, orientation = self.columns.moved, self.columns.orientation
        difference = np.empty((len(s), self.z_size))
        difference[:, moved] = after[:, moved] - s[:, moved]
        difference[:, moved.stop :] = _rotation_between(s[:, orientation], after[:, orientation])
        units = np.array([Z_PALM, *[Z_JOINT] * (self.hand.joints - 1), *[Z_POSITION] * 3, *[Z_ROTATION] * 3])
        return difference / units

    def clearance(self, s: np.ndarray) -> np.ndarray:
        """Return how far (N,) m the lowest corner of the box round the object is above the table.

        The paper's z_obj. The height of its middle would reward a seesaw: a finger that presses on the overhanging
        button levers the rest up, and learning ends there.
        """
        w, x, y, z = s[:, self.columns.orientation].T
        up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1)  # the frame's axes' z
        return s[:, self.columns.position][:, 2] - np.abs(up) @ self.half_extents

    def buildable(self, phi: np.ndarray) -> np.ndarray:
        return ~self.hand.interpenetrates(phi)

    def check_buildable(self, phi: np.ndarray) -> None:
        self.hand.check_spacing(phi)

    def hw_phy(self, phi: np.ndarray) -> HandPhysics:
        return HandPhysics(self, np.asarray(phi, dtype=float))

    def hw_phy_from(self, scene: mujoco.MjSpec, phi: np.ndarray) -> HandPhysics:
        return HandPhysics(self, np.asarray(phi, dtype=float), scene)

    def reset(self, hw_phy: Hardware, environments: int, rng: np.random.Generator) -> np.ndarray:
        physics, at = _physics(hw_phy), self.columns
        s = np.zeros((environments, self.state_size))
        position, quaternion = s[:, at.position], s[:, at.orientation]
        s[:, at.joints] = self.hand.start(physics.phi)
        position[:, :2] = rng.uniform(-self.start_noise, self.start_noise, (environments, 2))
        position[:, 2] = self.half_extents[2]
        turn = 5 * rng.uniform(-self.start_noise, self.start_noise, environments)
        quaternion[:, 0], quaternion[:, 3] = np.cos(turn / 2), np.sin(turn / 2)
        return s

    def observe(self, s: np.ndarray) -> np.ndarray:
        x = s[:, self.columns.seen].copy()
        quaternion = x[:, self.columns.orientation]
        quaternion *= np.where(quaternion[:, :1] < 0, -1.0, 1.0)  # q and -q are the same orientation
        middle, spread = self.observation_units
        return ((x - middle) / spread).astype(np.float32)

    def sample_pairs(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        k, nominal = self.hand.joints, self.hw_phy(self.design_space.initial)
        s = self.reset(nominal, count, rng)
        low, high = self.hand.joint_range.T
        s[:, self.columns.joints] = rng.uniform(low, high, (count, k))
        return s, self.action_units * rng.uniform(-1, 1, (count, k))

    def step(self, hardware: Hardware, s: np.ndarray, action: np.ndarray) -> Transition:
        physics = _physics(hardware)
        a = self.action_units * np.clip(action, -1, 1)
        outcome = physics.run(s, a)
        position, button = outcome.s[:, self.columns.position], outcome.s[:, self.columns.button]
        risen = self.clearance(outcome.s)
        on_button, on_body = np.moveaxis(outcome.sensors[..., 0] > 0, 2, 0)  # (N, fingers) each
        contact = on_button.any(1)
        pressed = contact & (button < -PRESSED * self.travel)
        lifted = (risen > self.lift_height) & ((on_button | on_body).sum(1) >= 2)
        goal = pressed & lifted
        if self.grasp == "two_besides_presser":
            holders = on_body.sum(1, keepdims=True) - on_body  # besides each finger
            goal &= np.any(on_button & (holders >= 2), axis=1)
        distance = np.linalg.norm(position - np.array([0, 0, self.goal_height]), axis=1)
        at_start = abs(self.goal_height - self.half_extents[2])
        terms = {
            "distance": -self.distance_weight * np.minimum(distance, at_start),
            "contact": self.contact_weight * (contact & (risen > 0.01)),
            "height": self.height_weight * np.clip(risen, 0, self.height_limit),
            "goal": self.goal_bonus * goal,
        }
        terms = {name: self.reward_scale * term for name, term in terms.items()}
        return Transition(
            s=outcome.s,
            a=a,
            z=outcome.z,
            reward=sum(terms.values(), np.zeros(len(s))),
            reward_terms=terms,
            terminated=np.zeros(len(s), dtype=bool),
            diverged=outcome.diverged | ~physics.buildable,
            success=goal,
            milestones={"lifted": lifted, "pressed": pressed},
            contact=_contact_points(outcome.sensors),
        )

    def solved(self, reached: np.ndarray) -> np.ndarray:
        """Tell (N,) which episodes held the goal: `reached` (T, N) in at least half of the last ten control steps."""
        return reached[-10:].mean(0) >= 0.5

    def spec(self, phi: np.ndarray) -> mujoco.MjSpec:
        return self.hand.spec(phi, self.name)

    def scene(self, phi: np.ndarray) -> mujoco.MjSpec:
        spec = self.spec(phi)
        spec.delete(spec.key("start"))  # of the hand alone: it does not fit the scene's qpos
        set_physics(spec)
        table = spec.worldbody.add_geom(
            name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.6, 0.6, 0.1], friction=TABLE_FRICTION, condim=4,
            rgba=palette.TABLE,
        )  # fmt: skip
        table.contype, table.conaffinity = TABLE_CONTACT
        self.add_object(spec)
        goal = spec.worldbody.add_geom(
            name="goal", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.02, 0, 0], pos=[0, 0, self.goal_height],
            rgba=palette.GOAL,
        )  # fmt: skip
        goal.contype = goal.conaffinity = 0
        for i in range(1, self.fingers + 1):
            add_contact_sensor(spec, mujoco.mjtObj.mjOBJ_BODY, f"finger_{i}_distal", "button")
            add_contact_sensor(spec, mujoco.mjtObj.mjOBJ_XBODY, f"finger_{i}_proximal", "object")
        return spec

    def set_design(self, scene: mujoco.MjSpec, phi: np.ndarray) -> None:
        """Give the hand in a scene the design phi (d,)."""
        self.hand.set_design(scene, phi)

    def qpos(self, s: np.ndarray) -> np.ndarray:
        return s[:, : self._nq]

    def qvel(self, s: np.ndarray) -> np.ndarray:
        return s[:, self._nq : self._nq + self._nv]

    def ctrl(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        return np.clip(s[:, : self.hand.joints] + a, *self.hand.joint_range.T)


def add_free_body(spec: mujoco.MjSpec, height: float) -> mujoco.MjsBody:
    """Return a new body "object", free to move."""
    body = spec.worldbody.add_body(name="object", pos=[0, 0, height])
    body.add_freejoint()
    return body


def add_button(
    body: mujoco.MjsBody,
    position: list[float],
    axis: list[float],
    half_size: list[float],
    travel: float,
    stiffness: float,
) -> None:
    """Add a sprung button, a box that slides against `axis` by at most `travel` m."""
    button = body.add_body(name="button", pos=position)
    button.add_joint(
        name="button", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, range=[-travel, 0], stiffness=[stiffness, 0, 0],
        damping=[BUTTON_DAMPING, 0, 0], armature=BUTTON_ARMATURE,
    )  # fmt: skip
    plate = button.add_geom(
        name="button", type=mujoco.mjtGeom.mjGEOM_BOX, size=half_size, mass=BUTTON_MASS, friction=OBJECT_FRICTION,
        condim=4, rgba=palette.BUTTON,
    )  # fmt: skip
    plate.contype, plate.conaffinity = 0, OBJECT_CONTACT[1]


def _contact_points(sensors: np.ndarray) -> np.ndarray:
    """Return where (N, fingers, 3) m each finger touches: the button, else the object, else NaN."""
    points = np.where(sensors[:, :, :1, 0] > 0, sensors[:, :, 0, 1:], sensors[:, :, 1, 1:])
    return np.where(np.any(sensors[..., :1] > 0, axis=2), points, np.nan)


def _physics(hardware: Hardware) -> HandPhysics:
    if not isinstance(hardware, HandPhysics):
        raise ValueError('hands run in MuJoCo, not in the proxy\'s world: explore by "design"')
    return hardware


def _rotation_between(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (N, 3) rad, in the world frame, that turn quaternions (N, 4) into others."""
    w, v = before[:, :1], before[:, 1:]
    w2, v2 = after[:, :1], after[:, 1:]
    real = w2 * w + (v2 * v).sum(1, keepdims=True)  # after * conjugate(before)
    imaginary = w * v2 - w2 * v
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # minus v2 x v; np.cross takes five times as long
        imaginary[:, i] -= v2[:, j] * v[:, k] - v2[:, k] * v[:, j]
    imaginary = np.where(real < 0, -imaginary, imaginary)
    sine = np.linalg.norm(imaginary, axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, np.abs(real))
    return imaginary * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 2.0)
