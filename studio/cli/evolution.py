"""The part of `morph-studio replay` that writes the evolution of runs as one page."""

from collections.abc import Sequence
from pathlib import Path

from morph_core.history import History
from studio.cli.arguments import UsageError
from studio.cli.pages import check_place, write_page


def write_evolution(histories: Sequence[History], out: Path, *, json: bool) -> int:
    """Write evolution.html of 1 to 4 runs of one task; return the exit status. UsageError says what is allowed."""
    from rich.progress import Progress

    from studio.cli.terminal import make_console
    from studio.show.evolution import build_evolution, check_runs

    check_place(out, "replay")
    try:
        check_runs(histories)
    except ValueError as error:
        raise UsageError(f"replay: {error}") from error
    console = make_console(stderr=True)
    with Progress(console=console, disable=json or not console.is_terminal, transient=True) as bar:
        tasks = {history.folder.id: bar.add_task(history.folder.id, total=None) for history in histories}
        page = build_evolution(
            histories, lambda run, built, total: bar.update(tasks[run], completed=built, total=total)
        )
    return write_page(page, out, "replay", json=json)
