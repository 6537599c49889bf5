"""The album of designs behind the viewer's gallery: their pictures, and which of them are starred."""

from collections.abc import Sequence

from morph_core.history import History
from studio.runs import Runs
from studio.shelf.marks import Marks
from studio.shelf.thumbnails import Thumbnails


class Album:
    """Pictures and stars of the designs of all runs; it is thread-safe."""

    def __init__(self, runs: Runs, thumbnails: Thumbnails) -> None:
        self._runs = runs
        self._thumbnails = thumbnails

    def starred(self, history: History) -> Sequence[int]:
        """Return the iterations of a run whose designs are starred."""
        return self._runs.marks(history.folder).starred_designs

    def star(self, run_id: str, iteration: int, starred: bool) -> Marks:
        """Star a design, or take its star away; raise ValueError that says what is allowed."""
        return self._runs.star(run_id, str(iteration), starred)

    def picture(self, history: History, phi: Sequence[float]) -> bytes:
        """Return a PNG of a design. Raise ValueError if it can't be built."""
        return self._thumbnails.of(history.record.task, history.record.task_options, list(phi))
