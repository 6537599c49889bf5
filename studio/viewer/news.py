"""News of runs: that one has reached its goal, has failed or has ended, each told once to each browser."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

from morph_core.history import History
from morph_core.protocol import Status
from studio.viewer import wording

GOAL = 0.95
"""Success on Hw-Phy, with the sampled policy, from which a run counts as having reached its goal; as in studies."""


@dataclass(frozen=True)
class Piece:
    """One piece of news."""

    title: str
    sentence: str
    colour: Literal["green", "blue", "red", "gray"]


class News:
    """What one browser has been told of the runs."""

    def __init__(self) -> None:
        self._told: dict[str, Status] = {}
        self._evaluated: dict[str, int] = {}
        self._reached: set[str] = set()

    def look(self, histories: Mapping[str, History], statuses: Mapping[str, tuple[Status, str]]) -> list[Piece]:
        """Return what has happened since the last look; of a run that is seen for the first time, nothing."""
        news = [piece for name, history in histories.items() for piece in self._of(name, history, *statuses[name])]
        for name, (status, _) in statuses.items():
            self._told[name] = status
        return news

    def _of(self, name: str, history: History, status: Status, message: str) -> Iterator[Piece]:
        before = self._told.get(name)
        seen, self._evaluated[name] = self._evaluated.get(name, 0), len(history.evaluations)
        goal = next((e for e in history.evaluations[seen:] if e.sampled_success >= GOAL), None)
        if goal is not None and name not in self._reached:
            self._reached.add(name)
            if before is not None:
                success = wording.percent(goal.sampled_success)
                yield Piece("Goal reached", f"{name}: {success} success at iteration {goal.iteration}", "green")
        if before in (None, status):
            return
        if status in ("failed", "lost"):
            yield Piece(f"Run {status}", f"{name}: {message or 'no reason was recorded'}", "red")
        elif status in ("finished", "stopped"):
            last = history.evaluations[-1] if history.evaluations else None
            success = f", {wording.percent(last.sampled_success)} success" if last else ""
            yield Piece(f"Run {status}", f"{name}: iteration {history.iteration}{success}", "blue")
