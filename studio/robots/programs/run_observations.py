"""Answer what the policy sees with its actions, with numpy alone: `python run_policy.py < observations.txt`.

Each line of the input holds the numbers that the task's `observe` makes of a state, each line of the output the mean of
the policy in [-1, 1].
"""

import sys

import numpy as np
from policy import act, compare, size

seen = []
for line in sys.stdin:
    numbers = np.array(line.split(), dtype=float)
    if len(numbers) != size:
        raise SystemExit(f"a line must hold the {size} numbers that the policy sees, not {len(numbers)}")
    seen.append(numbers)
    print(*act(numbers).tolist(), flush=True)  # noqa: T201
print(compare(np.reshape(seen, (-1, size))), file=sys.stderr)  # noqa: T201
