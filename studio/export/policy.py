"""The policy of a checkpoint as plain arrays, run with numpy alone; and its success on a robot read from files."""

import io
import math
from dataclasses import dataclass
from typing import Any, cast

import msgspec
import numpy as np
import safetensors
from safetensors.numpy import load

from morph_core import inside
from morph_core.history import History
from morph_core.rollout import collect
from morph_core.run_folder import WEIGHTS_BYTES
from morph_core.task import Hardware, Task
from studio.export.demand import Recorder
from studio.export.errors import ExportError
from studio.robots.robot import Program

LAYERS = 3
HARD_BOX = "policy/hard_box"
"""Name of the task's own box among the tensors of a checkpoint whose policy sees phi."""
SMALLEST_STD, LARGEST_STD = 0.02, 2.0
"""Limits of the standard deviation, as in `morph_core.networks`, which needs torch."""


@dataclass(frozen=True)
class Policy:
    """Policy pi_theta(a | s) = N(mean, std^2), in units of the largest action; the mean has tanh between its layers."""

    weights: list[np.ndarray]
    biases: list[np.ndarray]
    std: np.ndarray  # (action_size,)
    iteration: int
    """Iteration of the checkpoint from which the policy was read."""

    def act(self, observation: np.ndarray, rng: np.random.Generator | None) -> np.ndarray:
        """Return actions (N, action_size) for observations (N, o); the mean where `rng` is None."""
        x = observation
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = np.einsum("ni,oi->no", x, weight) + bias  # BLAS waits for its threads on a busy machine
            x = np.tanh(x) if i < len(self.weights) - 1 else x
        return x if rng is None else x + self.std * rng.standard_normal(x.shape, dtype=np.float32)

    def command(self, seen: np.ndarray, program: Program) -> np.ndarray:
        """Return what a `program` gives (N, a) for what it sees (N, o), both in physical units: the mean, cut off."""
        units, x = program.units, np.array(seen, dtype=float)
        if (w := program.orientation) is not None:
            x[:, w : w + 4] *= np.where(x[:, w : w + 1] < 0, -1, 1)
        mean = self.act(((x - units["middle"]) / units["spread"]).astype(np.float32), None)
        return units["action_scale"] * np.clip(mean, -1, 1)


class Score(msgspec.Struct, frozen=True):
    """How often the sampled policy reached the goal."""

    episodes: int
    success: float
    where: str = ""

    def allowed(self, other: "Score") -> float:
        """Return how far the success of this score and of `other` may lie apart by chance: three standard deviations,
        and one episode."""
        n, m = self.episodes, other.episodes
        share = (self.success * n + other.success * m + 1) / (n + m + 2)
        return 3 * math.sqrt(share * (1 - share) * (1 / n + 1 / m)) + 1 / min(n, m)


def policy_at(history: History, iteration: int, phi: np.ndarray) -> Policy | None:
    """Return the policy of the newest checkpoint up to `iteration` as it is on design phi (d,), or None; ExportError
    if it is damaged."""
    saved = [i for i in history.folder.checkpoint_iterations() if i <= iteration]
    if not saved:
        return None
    path = f"checkpoints/{saved[-1]:06d}/weights.safetensors"
    try:
        tensors = load(inside.read(history.folder.path, path, WEIGHTS_BYTES))
        weights = [tensors[f"policy/mean.{2 * i}.weight"] for i in range(LAYERS)]
        biases = [tensors[f"policy/mean.{2 * i}.bias"] for i in range(LAYERS)]
        if HARD_BOX in tensors:
            weights[0], biases[0] = _told(weights[0], biases[0], tensors[HARD_BOX], phi)
        std = np.clip(np.exp(tensors["policy/log_std"]), SMALLEST_STD, LARGEST_STD)
    except (OSError, KeyError, ValueError, safetensors.SafetensorError) as error:
        raise ExportError(f"the policy of checkpoint {saved[-1]} can't be read: {error}") from error
    if not all(np.isfinite(array).all() for array in (*weights, *biases, std)):
        raise ExportError(f"the policy of checkpoint {saved[-1]} holds numbers that are not finite")
    return Policy(weights, biases, std, saved[-1])


def _told(weight: np.ndarray, bias: np.ndarray, box: np.ndarray, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return weight and bias of a first layer that sees phi (d,) as those of one that sees the observation alone.

    What it sees of phi is each entry's place in the task's own `box` (2, d), from -1 to 1.
    """
    seen = (2 * (phi - box[0]) / (box[1] - box[0]) - 1).astype(np.float32)
    return weight[:, : -len(phi)], bias + weight[:, -len(phi) :] @ seen


def policy_files(policy: Policy, program: Program, horizon: int) -> dict[str, bytes]:
    """Return policy.npz and the program that runs it for `horizon` control steps."""
    orientation = -1 if program.orientation is None else program.orientation
    arrays: dict[str, np.ndarray] = {"std": policy.std, "horizon": np.array(horizon)}
    arrays |= {"orientation": np.array(orientation), **program.units}
    for i, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        arrays |= {f"weight_{i}": weight, f"bias_{i}": bias}
    arrays |= program.arrays
    buffer = io.BytesIO()
    np.savez(buffer, **cast(dict[str, Any], arrays))
    return {"policy.npz": buffer.getvalue(), **program.sources}


def read_policy(content: bytes) -> Policy:
    """Return the policy of a policy.npz; raise ValueError or KeyError for anything else. Nothing is unpickled."""
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        weights, biases = ([arrays[f"{name}_{i}"] for i in range(LAYERS)] for name in ("weight", "bias"))
        return Policy(weights, biases, arrays["std"], 0)


def score(
    task: Task,
    policy: Policy,
    hardware: Hardware,
    episodes: int,
    where: str,
    seed: int = 0,
    recorder: Recorder | None = None,
) -> Score:
    """Run the sampled policy on `hardware`; episodes whose simulation diverges have failed.

    A `recorder` is shown what the hardware does, where that can be watched.
    """
    rng = np.random.default_rng(seed)
    start = task.reset(hardware, episodes, rng)
    if recorder:
        recorder.watch(hardware)
    rollout = collect(task, lambda seen: policy.act(seen, rng), hardware, start)
    if recorder:
        recorder.kept = rollout.kept
    return Score(episodes, float(rollout.successes.sum()) / episodes, where)
