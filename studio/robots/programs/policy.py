"""Hold the policy as a function, with numpy alone; `python policy.py` compares policy.onnx with it, by onnxruntime."""

from pathlib import Path

import numpy as np

here = Path(__file__).resolve().parent
with np.load(here / "policy.npz") as file:
    arrays = dict(file)
size, orientation = len(arrays["middle"]), int(arrays["orientation"])
ALLOWED = 1e-5
"""Largest difference between policy.onnx and `act` that is allowed, as a share of the largest action."""


def act(seen: np.ndarray) -> np.ndarray:
    """Return the actions (..., actions) for what is seen (..., size), in physical units: the mean of the policy."""
    x = np.array(seen, dtype=float)
    if orientation >= 0:  # q and -q are the same orientation
        x[..., orientation : orientation + 4] *= np.where(x[..., orientation : orientation + 1] < 0, -1, 1)
    x = ((x - arrays["middle"]) / arrays["spread"]).astype(np.float32)
    for i in range(3):
        x = x @ arrays[f"weight_{i}"].T + arrays[f"bias_{i}"]
        x = np.tanh(x) if i < 2 else x
    return arrays["action_scale"] * np.clip(x, -1, 1)


def compare(seen: np.ndarray) -> str:
    """Return how far policy.onnx is from `act` on what was seen (n, size); SystemExit where that is too far."""
    if not (here / "policy.onnx").exists():
        return "policy.onnx: this bundle has none"
    try:
        import onnxruntime
    except ImportError:
        return "policy.onnx: not compared with policy.npz: pip install onnxruntime"
    seen = np.array(seen, dtype=np.float32)
    session = onnxruntime.InferenceSession(str(here / "policy.onnx"), providers=["CPUExecutionProvider"])
    (found,) = session.run(["action"], {"observation": seen})
    off = float((np.abs(found - act(seen)) / np.maximum(arrays["action_scale"], 1e-300)).max(initial=0.0))
    said = (
        f"policy.onnx: within {off:.1e} of policy.npz on {len(seen)} observations, as a share of the largest action; "
        f"{ALLOWED:g} is allowed"
    )
    if not off <= ALLOWED:
        raise SystemExit(said)
    return said


if __name__ == "__main__":
    rng = np.random.default_rng(0)
    print(compare(arrays["middle"] + arrays["spread"] * rng.standard_normal((1000, size))))  # noqa: T201
