"""A recorded episode as it is played: its postures, and what was reached and touched."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Episode:
    """T steps of a recorded episode, T + 1 postures."""

    qpos: np.ndarray  # (T + 1, nq)
    success: np.ndarray  # (T,) bool
    milestones: dict[str, np.ndarray]  # each (T,) bool
    contact: np.ndarray  # (T, C, 3) m


def episode_in(recorded: dict[str, np.ndarray], nq: int) -> Episode:
    """Return a recorded episode, whatever else its file holds; ValueError if its arrays don't fit."""
    qpos = np.atleast_2d(np.asarray(recorded.get("qpos", np.zeros((0, nq))), float))
    steps = len(qpos) - 1
    if steps < 0 or not np.isfinite(qpos).all():
        raise ValueError("the recorded episode holds no finite postures")
    success = np.asarray(recorded.get("success", np.zeros(steps)), bool).reshape(-1)
    contact = np.asarray(recorded.get("contact", np.full((steps, 1, 3), np.nan)), float)
    contact = contact.reshape(len(contact), -1, 3) if contact.size else contact.reshape(len(contact), 0, 3)
    prefix = "milestones/"
    milestones = {
        name.removeprefix(prefix): np.asarray(reached, bool).reshape(-1)
        for name, reached in recorded.items()
        if name.startswith(prefix)
    }
    if any(len(array) != steps for array in (success, contact, *milestones.values())):
        raise ValueError("the recorded episode's success, milestones and contact don't fit its postures")
    return Episode(qpos, success, milestones, contact)
