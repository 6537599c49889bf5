"""The paper's reacher: a planar arm of five links that threads a zig-zag tunnel."""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar, Literal

import mujoco
import numpy as np
from msgspec import Meta

from morph_core.config import LARGEST_WEIGHT, NotNegative, Settings, most
from morph_core.design import DesignSpace
from morph_core.methods.direct import Direct
from morph_core.methods.no_hw_opt import NoHwOpt
from morph_core.methods.proxy import Morph
from morph_core.parts import Ppo
from morph_core.protocol import Parameter
from morph_core.task import Hardware, HardwareOfEpisodes, Task, Transition
from morph_core.tasks import palette
from morph_core.tasks.arm import LINK_RADIUS, Arm

LINKS = 5
TOLERANCE = 1e-4
"""m: a link counts as inside a wall beyond this depth."""
OUTLINE_RESOLUTION = 0.15
"""m: largest move of the arm between two postures that are tested for collision where only z is known: wider ones let
corners pass."""
OUTLINE_MARGIN = 0.2
"""m: what the outline of a proxy may move further than that of a rigid arm."""
ANGLE_SPREAD, TIP_SPREAD = 3.0, 5.0  # rad, m: as the policy sees joint angles and tip
WALL_HEIGHT = 0.3  # m, across the plane
WALL_MARGIN = 1.2  # m: how much of the solid is shown beyond the corridor
_PPO = Ppo(initial_weights="orthogonal")


@dataclass(frozen=True)
class Tunnel:
    """A corridor of constant vertical gap along a piecewise-linear centre line; solid above and below it."""

    xs: tuple[float, ...]
    """m: where the centre line bends; solid only for xs[0] <= x <= xs[-1]."""
    ys: tuple[float, ...]
    """m: height of the centre line at each bend."""
    gap: float
    """m: the vertical width of the corridor."""
    goal: tuple[float, float]
    goal_radius: float
    start_headings: tuple[float, ...]
    """degrees: absolute angles of the links at the start."""

    @cached_property
    def _slopes(self) -> list[float]:
        return (np.diff(self.ys) / np.diff(self.xs)).tolist()

    @cached_property
    def _changes(self) -> list[float]:
        return np.diff(self._slopes).tolist()

    def centre(self, x: np.ndarray) -> np.ndarray:
        """Return the height of the centre line at x (...), constant outside the tunnel."""
        return self._centre_inside(np.clip(x, self.xs[0], self.xs[-1]))

    def _centre_inside(self, x: np.ndarray) -> np.ndarray:
        height = self.ys[0] + self._slopes[0] * (x - self.xs[0])
        for bend, change in zip(self.xs[1:-1], self._changes, strict=True):
            height += change * np.maximum(x - bend, 0.0)
        return height

    def depth_at_points(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return how deep each point (...) stands in a wall, m: vertical, negative in free space, -inf outside."""
        depth = np.abs(y - self.centre(x)) - self.gap / 2
        depth[(x < self.xs[0]) | (x > self.xs[-1])] = -np.inf
        return depth

    def depth_at_bend(self, x: np.ndarray, y: np.ndarray, bend: int) -> tuple[np.ndarray, np.ndarray]:
        """Return depth and height (P - 1, ...) m of each link between points (P, ...) where it crosses a bend's x."""
        before = x < self.xs[bend]
        crossed = before[1:] != before[:-1]
        run = np.where(crossed, x[1:] - x[:-1], x.dtype.type(1))
        height = y[:-1] + (self.xs[bend] - x[:-1]) / run * (y[1:] - y[:-1])
        depth = np.abs(height - self.ys[bend]) - self.gap / 2
        return np.where(crossed, depth, -np.inf), height

    def depth(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the largest depth (...) m of points (P, ...) joined by links.

        Walls and links are straight between bends and joints, so that the largest depth is at one of these.
        """
        depth = self.depth_at_points(x, y).max(0)
        for bend in range(len(self.xs)):
            at_bend, _ = self.depth_at_bend(x, y, bend)
            depth = np.maximum(depth, at_bend.max(0, initial=-np.inf))
        return depth

    def touches(self, x: np.ndarray, y: np.ndarray, limit: float) -> np.ndarray:
        """Return where `depth(x, y) >= limit` (...), several times faster."""
        half_gap = self.gap / 2
        touches = (x >= self.xs[0]) & (x <= self.xs[-1]) & (np.abs(y - self._centre_inside(x)) - half_gap >= limit)
        run, rise = x[1:] - x[:-1], y[1:] - y[:-1]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # of links that don't cross the bend
            for bend_x, bend_y in zip(self.xs, self.ys, strict=True):
                before = x < bend_x
                crosses = before[1:] != before[:-1]
                if crosses.any():
                    height = y[:-1] + (bend_x - x[:-1]) / run * rise
                    touches[1:] |= crosses & (np.abs(height - bend_y) - half_gap >= limit)
        return np.any(touches, axis=0)

    def deepest(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return where (N, 2) each outline of joined points (P, N) is deepest in a wall."""
        depths, xs, ys = [self.depth_at_points(x, y)], [x], [y]
        for bend, at in enumerate(self.xs):
            depth, height = self.depth_at_bend(x, y, bend)
            depths.append(depth)
            xs.append(np.full_like(height, at))
            ys.append(height)
        worst = np.concatenate(depths).argmax(0), np.arange(x.shape[1])
        return np.stack([np.concatenate(xs)[worst], np.concatenate(ys)[worst]], -1)


TUNNELS = {
    # Made for this project: tighter than the bend is high, so that three-metre links can't turn the corner.
    "zigzag": Tunnel((1.0, 2.5, 4.0), (3.0, 4.2, 3.0), 1.1, (4.4, 2.8), 0.4, (180.0, 150.0, 120.0, 90.0, 90.0)),
    # Measured from the paper's figure.
    "paper": Tunnel(
        (1.0, 2.5, 4.0, 5.5, 7.0), (3.0, 4.5, 3.0, 4.5, 3.0), 3.0, (7.0, 3.0), 0.5, (180.0, 180.0, 90.0, 0.0, 0.0)
    ),
}


class ForwardKinematics:
    """Hw-Phy of the reacher: where the joints stand after a change of the joint angles; linear in phi."""

    def __init__(self, phi: np.ndarray, tip_only: bool) -> None:
        self.phi = phi  # (d,) or (N, d) m
        self.tip_only = tip_only

    def __call__(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        joints = self.outline(s[:, :LINKS] + a)[:, 1:]
        return joints[:, -1] if self.tip_only else joints.reshape(len(s), -1)

    def outline(self, q: np.ndarray) -> np.ndarray:
        """Return base, joints and tip (N, 6, 2) m at joint angles q (N, 5) rad."""
        heading = np.cumsum(q, -1)
        points = np.zeros((*q.shape[:-1], LINKS + 1, 2))
        np.cumsum(self.phi * np.cos(heading), -1, out=points[..., 1:, 0])
        np.cumsum(self.phi * np.sin(heading), -1, out=points[..., 1:, 1])
        return points

    def jacobian(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return dz/dphi (N, z_size, 5) for states s (N, state_size) and executed actions a (N, 5)."""
        heading = np.cumsum(s[:, :LINKS] + a, -1)
        direction = np.stack([np.cos(heading), np.sin(heading)], -1)  # (N, link, 2)
        reaches = np.tri(LINKS)  # joint i is carried by the links up to i
        full = np.einsum("il,nlc->nicl", reaches, direction)
        return full[:, -1] if self.tip_only else full.reshape(len(s), -1, LINKS)


@dataclass(frozen=True)
class Reacher(Settings, Task):
    """Five links, base fixed; s = joint angles, tip, and whether the design can't start at all.

    Task: bring the tip into the goal behind a zig-zag tunnel; the whole arm collides with its walls, through the
    whole of each move. An action changes the five joint angles; the joints move one after another, the distal ones
    first, each until its target or until a link touches a wall.
    Randomised: the start posture, by `start_noise` per joint.
    Success: the tip is inside the goal's radius; that ends the episode.
    """

    tunnel: Literal["zigzag", "paper"] = "zigzag"
    """Tunnel that the arm has to thread: made for this project, or measured from the paper's figure."""
    z: Literal["joints", "tip"] = "joints"
    """z: output of the hardware, which is all joint positions, or the paper's end-effector alone."""
    action_scale: Annotated[NotNegative, most(6.3, "a joint angle changes by at most a full turn")] = 0.2
    """rad: largest change of a joint angle per control step."""
    start_noise: Annotated[NotNegative, most(3.2, "a start posture is turned by at most half a turn")] = 0.05
    """rad: standard deviation of each joint angle at the start."""
    sweep_resolution: Annotated[float, Meta(ge=1e-3), most(1.0, "the arm would jump through the walls")] = 0.015
    """m: largest move of any point of the arm between two postures that are tested for collision."""
    distance_weight: Annotated[NotNegative, LARGEST_WEIGHT] = 1.0
    """Reward per metre between tip and goal (enters with a minus)."""
    centre_weight: Annotated[NotNegative, LARGEST_WEIGHT] = 0.5
    """beta_0: reward per metre between tip and centre line, at most `centre_limit` (enters with a minus)."""
    centre_limit: Annotated[NotNegative, most(100.0, "the arm reaches no further")] = 4.0
    """m: distance to the centre line beyond which more of it counts no more."""
    collision_weight: Annotated[NotNegative, LARGEST_WEIGHT] = 0.2
    """beta_1: reward for a move that contact stops altogether (enters with a minus)."""
    goal_bonus: Annotated[NotNegative, LARGEST_WEIGHT] = 10.0
    """beta_2: reward for touching the goal."""
    stuck_cost: Annotated[NotNegative, LARGEST_WEIGHT] = 10.0
    """Cost of each step of a design whose start posture reaches into the tunnel or a wall."""
    reward_scale: Annotated[NotNegative, LARGEST_WEIGHT] = 0.02
    """Factor by which all weights, bonuses and costs are multiplied: returns of order one suit the critic."""

    name: ClassVar[str] = "reacher"
    title: ClassVar[str] = "5-link arm through a zig-zag tunnel"
    success_rule: ClassVar[str] = "the tip is inside the goal's radius; that ends the episode."
    horizon: ClassVar[int] = 60
    control_dt: ClassVar[float] = 0.1
    state_size: ClassVar[int] = LINKS + 3
    observation_size: ClassVar[int] = 3 * LINKS + 2
    action_size: ClassVar[int] = LINKS
    proxy_input_size: ClassVar[int] = 2 * LINKS
    z_scale: ClassVar[float] = 3.0
    z_unit: ClassVar[str] = "m"

    @property
    def tuned(self) -> tuple[Settings, ...]:
        return (Morph(ppo=_PPO), Direct(ppo=_PPO), NoHwOpt(ppo=_PPO))

    @property
    def design_space(self) -> DesignSpace:
        return DesignSpace(
            tuple(
                Parameter(f"link_{i}", "m", lo=0.05, hi=5.0, initial=3.0, hard_lo=0.05, hard_hi=5.0, part=f"link_{i}")
                for i in range(1, LINKS + 1)
            )
        )

    @property
    def z_size(self) -> int:
        return 2 if self.z == "tip" else 2 * LINKS

    @property
    def walls(self) -> Tunnel:
        """Tunnel that is chosen, whose walls the arm collides with."""
        return TUNNELS[self.tunnel]

    @property
    def start(self) -> np.ndarray:
        """Joint angles (5,) in rad of the start posture."""
        return np.diff(np.deg2rad(self.walls.start_headings), prepend=0.0)

    @cached_property
    def observation_units(self) -> tuple[np.ndarray, np.ndarray]:
        spread = np.array([*[1.0] * (2 * LINKS), *[ANGLE_SPREAD] * LINKS, *[TIP_SPREAD] * 2])
        return np.zeros(len(spread)), spread

    @property
    def action_units(self) -> np.ndarray:
        """Largest change (5,) in rad of each joint angle in a control step."""
        return np.full(LINKS, self.action_scale)

    @property
    def robot(self) -> Arm:
        return Arm(self.start)

    def hw_phy(self, phi: np.ndarray) -> ForwardKinematics:
        return ForwardKinematics(np.asarray(phi, dtype=float), self.z == "tip")

    def hw_phy_from(self, scene: mujoco.MjSpec, phi: np.ndarray) -> ForwardKinematics:
        return self.hw_phy(self.robot.lengths_of(scene.compile()))

    def reset(self, hw_phy: Hardware, environments: int, rng: np.random.Generator) -> np.ndarray:
        noise = self.start_noise * rng.standard_normal((environments, LINKS))
        outline = self._outline(hw_phy, self._state(np.tile(self.start, (environments, 1))), np.zeros_like(noise))
        stuck = (outline[..., 0] > self.walls.xs[0]).any(-1)
        # A start beyond the mouth could stand through the tunnel already; noise alone must never put it there.
        for _ in range(8):
            outline = self._outline(hw_phy, self._state(self.start + noise), np.zeros_like(noise))
            noise[(outline[..., 0] > self.walls.xs[0]).any(-1)] /= 2
        noise[(outline[..., 0] > self.walls.xs[0]).any(-1)] = 0.0
        s = self._state(self.start + noise)
        s[:, LINKS : LINKS + 2] = self._outline(hw_phy, s, np.zeros_like(noise))[:, -1]
        s[:, -1] = stuck
        return s

    def observe(self, s: np.ndarray) -> np.ndarray:
        heading = np.cumsum(s[:, :LINKS], -1)
        joints_and_tip = s[:, : LINKS + 2]
        middle, spread = self.observation_units
        x = np.concatenate([np.sin(heading), np.cos(heading), joints_and_tip], 1)
        return ((x - middle) / spread).astype(np.float32)

    def proxy_input(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        # Sines and cosines of absolute angles make the kinematics linear in the features: easy for the proxy.
        heading = np.cumsum(s[:, :LINKS] + a, -1)
        return np.concatenate([np.sin(heading), np.cos(heading)], 1, dtype=np.float32)

    def sample_pairs(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        near = self.start + 0.8 * rng.standard_normal((count // 2, LINKS))
        anywhere = rng.uniform(-1, 1, (count - count // 2, LINKS)) * np.array([3.1, 3.5, 3.5, 3.5, 3.5])
        return self._state(np.concatenate([near, anywhere])), self.action_scale * rng.uniform(-1, 1, (count, LINKS))

    def step(self, hardware: Hardware, s: np.ndarray, action: np.ndarray) -> Transition:
        stuck = s[:, -1] > 0
        wish = np.where(stuck[:, None], 0.0, self.action_scale * np.clip(action, -1, 1))
        if isinstance(hardware, ForwardKinematics):
            a, blocked, contact = self._sweep(hardware, s[:, :LINKS], wish)
        elif isinstance(hardware, HardwareOfEpisodes):
            a, blocked, contact = self._sweep_outline(hardware, s, wish)
        else:
            a, blocked, contact = self._stop_at_end(hardware, s, wish)
        z = hardware(s, a)
        tip = z[:, -2:]
        after = np.concatenate([s[:, :LINKS] + a, tip, s[:, -1:]], 1)
        distance = np.linalg.norm(tip - np.array(self.walls.goal), axis=1)
        off_centre = np.abs(tip[:, 1] - self.walls.centre(tip[:, 0]))
        touch = (distance < self.walls.goal_radius) & ~stuck & (blocked < 1)
        terms = {
            "distance": -self.distance_weight * distance,
            "centre": -self.centre_weight * np.minimum(off_centre, self.centre_limit),
            "collision": -self.collision_weight * blocked,
            "goal": self.goal_bonus * touch,
        }
        terms = {name: np.where(stuck, 0.0, term) for name, term in terms.items()} | {"stuck": -self.stuck_cost * stuck}
        terms = {name: self.reward_scale * term for name, term in terms.items()}
        return Transition(
            s=after,
            a=a,
            z=z,
            reward=sum(terms.values(), np.zeros(len(s))),
            reward_terms=terms,
            terminated=touch,
            diverged=np.zeros_like(touch),
            success=touch,
            contact=contact[:, None],
        )

    def _sweep(self, arm: ForwardKinematics, q: np.ndarray, wish: np.ndarray) -> tuple[np.ndarray, ...]:
        """Move the joints one after another, the distal ones first, each until its target or contact.

        Return the executed changes (N, 5) rad, the share of the joints' moves that contact took (N,), and where the
        arm was stopped (N, 3) m.
        """
        # Much of a run's time is spent here: joints first and in single precision, numpy is several times faster.
        points = np.ascontiguousarray(arm.outline(q).T, np.float32)  # (2, 6, N)
        angle = wish.T.astype(np.float32)  # (5, N)
        done = np.ones_like(angle)  # share of each joint's move
        refused = np.full_like(points, np.nan)  # the last posture in contact
        for j in reversed(range(LINKS)):
            pivot, carried = points[:, j], points[:, j:] - points[:, j : j + 1]
            square = carried * carried
            swing = np.abs(angle[j]) * np.sqrt((square[0] + square[1]).max(0))
            near = (points[0, j:].max(0) + swing > self.walls.xs[0]).nonzero()[0]  # the others can't reach a wall
            if len(near):
                # Each environment has its own number of postures, so that none depends on what the others do.
                n = np.maximum(1, np.ceil(swing[near] / np.float32(self.sweep_resolution)))
                count = n.astype(int)
                end = count.cumsum()
                begin = end - count
                posture = np.arange(end[-1])
                part = (posture - (begin - 1).repeat(count)).astype(np.float32) / n.repeat(count)
                centre, spokes = pivot[:, near].repeat(count, 1), carried[:, :, near].repeat(count, 2)
                swept = _turned(centre, spokes, part * angle[j, near].repeat(count))
                touches = self.walls.touches(swept[0], swept[1], TOLERANCE)
                first = np.minimum.reduceat(np.where(touches, posture, end[-1]), begin)
                done[j, near] = (np.minimum(first, end) - begin) / n
                stopped = (first < end).nonzero()[0]
                refused[:, :j, near[stopped]] = points[:, :j, near[stopped]]
                refused[:, j:, near[stopped]] = swept[:, :, first[stopped]]
            points[:, j:] = _turned(pivot, carried, done[j] * angle[j])
        return done.T * wish, 1 - done.mean(0, dtype=float), self._contact(*refused)

    def _sweep_outline(self, hardware: HardwareOfEpisodes, s: np.ndarray, wish: np.ndarray) -> tuple[np.ndarray, ...]:
        """Do what `_sweep` does for hardware that is known only by its z: the outline on the way is what it says of the
        part of the move done so far."""
        a, done = wish.copy(), np.ones_like(wish)
        refused = np.full((len(s), 1 if self.z == "tip" else LINKS + 1, 2), np.nan)  # the last posture in contact
        outline = self._outline(hardware, s, np.zeros_like(wish))
        reach = self._reach(outline, 0)
        swing = np.abs(wish).sum(1) * reach + OUTLINE_MARGIN
        near = (outline[..., 0].max(1) + swing > self.walls.xs[0]).nonzero()[0]  # the others can't reach a wall
        some, moved, rows = hardware.of(near), np.zeros_like(wish[near]), np.arange(len(near))
        outline = outline[near]
        for j in reversed(range(LINKS) if len(near) else ()):
            n = np.maximum(1, np.ceil(np.abs(wish[near, j]) * self._reach(outline, j) / OUTLINE_RESOLUTION)).astype(int)
            tried = np.repeat(moved[None], n.max(), 0)  # (n, near, 5)
            tried[..., j] = np.minimum(np.arange(1, n.max() + 1)[:, None] / n, 1) * wish[near, j]
            on_the_way = self._outline(some, np.tile(s[near], (n.max(), 1)), tried.reshape(-1, LINKS))
            x, y = (np.ascontiguousarray(c.T) for c in np.moveaxis(on_the_way, -1, 0))
            free = (self.walls.depth(x, y) <= TOLERANCE).reshape(n.max(), len(near))
            steps = np.minimum(np.logical_and.accumulate(free, 0).sum(0), n)
            on_the_way = on_the_way.reshape(*free.shape, *on_the_way.shape[1:])
            stopped = (steps < n).nonzero()[0]
            refused[near[stopped]] = on_the_way[steps[stopped], stopped]
            outline = np.where((steps > 0)[:, None, None], on_the_way[np.maximum(steps - 1, 0), rows], outline)
            done[near, j] = steps / n
            moved[:, j] = steps / n * wish[near, j]
        a[near] = moved
        return a, 1 - done.mean(1), self._contact(*refused.T)

    def _reach(self, outline: np.ndarray, joint: int) -> np.ndarray:
        """Return how far (N,) the points of outlines (N, P, 2) that a joint carries are away from it, at most."""
        if self.z == "tip":
            return np.full(len(outline), TIP_SPREAD)
        return np.linalg.norm(outline[:, joint + 1 :] - outline[:, joint : joint + 1], axis=-1).max(1)

    def _stop_at_end(self, hardware: Hardware, s: np.ndarray, wish: np.ndarray) -> tuple[np.ndarray, ...]:
        """Refuse moves that would end inside a wall: all that a hardware known only by its z can tell."""
        x, y = self._outline(hardware, s, wish).T
        refused = self.walls.depth(x, y) > TOLERANCE
        contact = self._contact(np.where(refused, x, np.nan), y)
        return np.where(refused[:, None], 0.0, wish), refused.astype(float), contact

    def _contact(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return where outlines (P, N) are deepest in a wall: (N, 3) m, NaN where x is."""
        contact = np.full((x.shape[1], 3), np.nan)
        hit = np.isfinite(x[0]).nonzero()[0]
        if len(hit):
            contact[hit, :2] = self.walls.deepest(x[:, hit], y[:, hit])
            contact[hit, 2] = 0.0
        return contact

    def _outline(self, hardware: Hardware, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the points (N, P, 2) that can collide: of the whole arm, or, in the world of a tip, just that."""
        if isinstance(hardware, ForwardKinematics):
            return hardware.outline(s[:, :LINKS] + a)
        z = hardware(s, a).reshape(len(s), -1, 2)
        return z if self.z == "tip" else np.pad(z, ((0, 0), (1, 0), (0, 0)))

    @staticmethod
    def _state(q: np.ndarray) -> np.ndarray:
        return np.pad(q, ((0, 0), (0, 3)))

    def spec(self, phi: np.ndarray) -> mujoco.MjSpec:
        return self.robot.spec(phi, self.name)

    def scene(self, phi: np.ndarray) -> mujoco.MjSpec:
        spec = self.spec(phi)
        walls = self.walls
        bottom, top = min(walls.ys) - walls.gap / 2 - WALL_MARGIN, max(walls.ys) + walls.gap / 2 + WALL_MARGIN
        for side, sign, edge in (("lower", -1, bottom), ("upper", 1, top)):
            for k in range(len(walls.xs) - 1):
                face = [(walls.xs[i], walls.ys[i] + sign * walls.gap / 2) for i in (k, k + 1)]
                corners = [*face, (walls.xs[k + 1], edge), (walls.xs[k], edge)]
                name = f"wall_{side}_{k + 1}"
                vertices = [(x, y, z) for z in (-WALL_HEIGHT / 2, WALL_HEIGHT / 2) for x, y in corners]
                spec.add_mesh(name=name, uservert=np.ravel(vertices))
                geom = spec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
                geom.rgba, geom.contype, geom.conaffinity = palette.WALL, 2, 1
        goal = spec.worldbody.add_geom(
            name="goal", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[walls.goal_radius, LINK_RADIUS / 2, 0],
            pos=[*walls.goal, 0], rgba=palette.GOAL,
        )  # fmt: skip
        goal.contype = goal.conaffinity = 0
        return spec

    def qpos(self, s: np.ndarray) -> np.ndarray:
        return s[:, :LINKS]


def _turned(pivot: np.ndarray, carried: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the points (2, P, N) that `carried` (2, P, N) about a pivot (2, N) come to, turned by angle (N,)."""
    turned, across = carried * np.cos(angle), carried * np.sin(angle)
    turned[0] += pivot[0]
    turned[0] -= across[1]
    across[0] += pivot[1]
    turned[1] += across[0]
    return turned
