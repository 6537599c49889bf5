"""Commands that were sent to runs and have no answer yet."""

import threading
from collections.abc import Mapping, Sequence

from morph_core.history import History
from morph_core.protocol import AnyCommand


class Pending:
    """The commands of one browser that wait for an answer, by run. It is thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: dict[str, list[tuple[AnyCommand, int]]] = {}
        """Each with the number of answers that the run had given before it was sent."""

    def add(self, run_id: str, command: AnyCommand, answered: int) -> None:
        """Keep in mind a command that was sent to a run which had given so many answers before."""
        with self._lock:
            self._open.setdefault(run_id, []).append((command, answered))

    def of(self, run_id: str) -> Sequence[AnyCommand]:
        """Return the commands to a run that have no answer yet, oldest first."""
        with self._lock:
            return [command for command, _ in self._open.get(run_id, [])]

    def settle(self, histories: Mapping[str, History]) -> None:
        """Forget the commands that were answered; each answer is that to one command."""
        with self._lock:
            for run_id, history in histories.items():
                if run_id in self._open:
                    self._open[run_id] = _unanswered(self._open[run_id], history)


def _unanswered(pending: Sequence[tuple[AnyCommand, int]], history: History) -> list[tuple[AnyCommand, int]]:
    """Return the commands without an answer, each with the number of the first answer that may be its own: what was
    answered once does not answer an equal command again."""
    left, used = [], []
    for command, asked_at in pending:
        first = max([asked_at, *(i + 1 for i, answered in used if answered == command)])
        answers = ((i, event.command) for i, event in enumerate(history.acknowledged))
        answer = next(((i, answered) for i, answered in answers if i >= first and answered == command), None)
        if answer:
            used.append(answer)
        else:
            left.append((command, first))
    return left
