"""The recorded runs that come with the studio: one of each task, to be watched without waiting, changed by nobody."""

import functools
import threading
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

import msgspec

from morph_core import inside
from morph_core.history import History
from morph_core.protocol import Whole
from morph_core.run_folder import RunFolder, RunFolderError
from morph_core.what_if import wilson_interval

ABOUT = "recorded.json"
"""File in the folder of a recorded run that says where it comes from."""
PREFIX = "recorded-"
"""Beginning of the names of recorded runs; that of the task follows."""
_ABOUT_BYTES = 1 << 16


class Origin(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Content of recorded.json: where a recorded run comes from, how it was chosen, and what is left out of it."""

    run: str
    """Name that the run had when it was trained."""
    command: str
    """Command that trains it again."""
    settings: str
    """Words on how its settings differ from what is the default for its task."""
    processor: str
    versions: dict[str, str]
    """Versions of what its results depend on."""
    revision: str
    """Revision of the repository that it was trained with; empty where nobody wrote it down."""
    seconds: float
    """Time from the start of the training to its end."""
    successes: Whole
    """Successful episodes of the sampled policy in the last evaluation on Hw-Phy."""
    episodes: Whole
    """Episodes of that evaluation."""
    chosen: str
    """Sentence on how it was chosen among runs of the same settings, and what they came to."""
    kept: str
    """Sentence on what the recording keeps of the run."""
    made_by: str
    """Command that made the recording of the run."""

    @property
    def outcome(self) -> str:
        """Return the final success in words, with its interval at 95 %."""
        low, high = wilson_interval(self.successes, self.episodes)
        share = self.successes / self.episodes
        return (
            f"{100 * share:.0f} % success at its end: {self.successes} of {self.episodes} episodes "
            f"({100 * low:.0f} to {100 * high:.0f} %)"
        )


class Recording:
    """A recorded run: its history, and where it comes from."""

    def __init__(self, folder: RunFolder) -> None:
        """Read the run; raise RunFolderError that says what is wrong with it."""
        try:
            self.history = History(folder)
            self.origin = msgspec.json.decode(inside.read(folder.path, ABOUT, _ABOUT_BYTES), type=Origin)
        except (OSError, ValueError, RecursionError) as error:
            raise RunFolderError(
                f"the recorded run {folder.id} can't be read: {error}; install morph-studio anew to see it"
            ) from error
        if not self.history.progress or not self.origin.episodes:
            raise RunFolderError(f"the recorded run {folder.id} is empty; install morph-studio anew to see it")

    @property
    def label(self) -> str:
        """Return the words that stand wherever the run is seen."""
        return f"recorded: {self.history.iteration} iterations, {_minutes(self.origin.seconds)} of training"


class Recordings:
    """The recorded runs of a folder, each read when it is first asked for. It is thread-safe."""

    def __init__(self, folder: Path | None = None) -> None:
        """Take the runs of `folder`, by default those that come with the studio."""
        self._folder = Path(str(files("studio") / "recorded")) if folder is None else folder
        self._lock = threading.Lock()
        self._read = functools.cache(Recording)

    def names(self) -> Sequence[str]:
        """Return the names of all recorded runs, by the names of their tasks."""
        if not self._folder.is_dir():
            return []
        return sorted(path.name for path in self._folder.glob(f"{PREFIX}*") if path.is_dir())

    def __contains__(self, run_id: object) -> bool:
        return isinstance(run_id, str) and run_id.startswith(PREFIX) and run_id in self.names()

    def get(self, run_id: str) -> Recording:
        """Return a recorded run by its name; raise RunFolderError if there is no such one, or it can't be read."""
        names = self.names()
        if run_id not in names:
            raise RunFolderError(f'there is no recorded run "{run_id[:80]}"; choose from: {", ".join(names) or "none"}')
        with self._lock:
            return self._read(RunFolder(self._folder / run_id))

    def of(self, task: str) -> Recording | None:
        """Return the recorded run of a task, None where there is none; raise RunFolderError if it can't be read."""
        name = f"{PREFIX}{task}"
        return self.get(name) if name in self else None

    def refuse(self, run_id: str, what: str) -> None:
        """Raise ValueError if the run is a recorded one, which can't be asked for `what`, such as "resumed"."""
        if run_id in self:
            raise ValueError(
                f"{run_id} is a recorded run, which comes with the studio: it can be watched, not {what}; Start it "
                "live trains one of your own"
            )


def _minutes(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{round(seconds)} s" if seconds < 60 else "1 minute" if minutes == 1 else f"{minutes} minutes"
