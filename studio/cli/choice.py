"""The run that RUN names: a name inside the folder of runs, or a path."""

from pathlib import Path

from morph_core.history import History
from morph_core.run_folder import ITERATION, RunFolder, RunFolderError, find_run
from studio.cli.arguments import UsageError
from studio.settings import at_home


def open_run(runs: Path, run: str) -> History:
    """Return the run. Raise UsageError that lists the choices, or says why the folder can't be read."""
    path = at_home(run)
    try:
        if path.is_absolute() or len(path.parts) > 1 or (path / "run.json").is_file():
            return History(RunFolder(path.resolve()))
        return History(find_run(runs, run))
    except (RunFolderError, OSError) as error:
        raise UsageError(str(error)) from error
    except ValueError as error:  # a run.json whose numbers contradict each other
        raise UsageError(f"{run} can't be read: {error}") from error


def place_of(runs: Path, word: str, option: str) -> tuple[History, int | None]:
    """Return the run of RUN or RUN@ITERATION, and the iteration, None where none is named.

    UsageError says what is allowed.
    """
    run, at, iteration = word.rpartition("@")
    if not at or "/" in iteration:
        return open_run(runs, word), None
    if not ITERATION.fullmatch(iteration):
        raise UsageError(f'{option} takes RUN or RUN@ITERATION, with a whole number, not "{word[:80]}"')
    return open_run(runs, run), int(iteration)


def check_design(history: History, which: str) -> None:
    """Raise UsageError that says what is allowed unless `which` is a design of the run."""
    try:
        history.design(which)
    except RunFolderError as error:
        raise UsageError(str(error)) from error
