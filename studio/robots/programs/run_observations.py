"""Answer what the policy sees with its actions, with numpy alone: `python run_policy.py < observations.txt`.

Each line of the input holds the numbers that the task's `observe` makes of a state, each line of the output the mean of
the policy in [-1, 1].
"""

import sys
from pathlib import Path

import numpy as np

policy = np.load(Path(__file__).resolve().parent / "policy.npz")
size = policy["weight_0"].shape[1]


def act(seen: np.ndarray) -> np.ndarray:
    """Return the actions for what is seen (size,): the mean of the policy."""
    x = seen.astype(np.float32)
    for i in range(3):
        x = policy[f"weight_{i}"] @ x + policy[f"bias_{i}"]
        x = np.tanh(x) if i < 2 else x
    return np.clip(x, -1, 1)


for line in sys.stdin:
    numbers = np.array(line.split(), dtype=float)
    if len(numbers) != size:
        raise SystemExit(f"a line must hold the {size} numbers that the policy sees, not {len(numbers)}")
    print(*act(numbers).tolist(), flush=True)  # noqa: T201
