"""`morph-studio replay`: a run done again from its seed and its log and compared, or seen again as a page or a film."""

import contextlib
import json
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import tyro

from morph_core.history import History
from studio.cli.arguments import RunsArguments, UsageError, parse
from studio.cli.choice import open_run
from studio.cli.evolution import write_evolution
from studio.cli.film import FilmArguments, write_film
from studio.cli.output import complain, say, write_json
from studio.new_run import PACKAGES, git_state
from studio.trainers import trainer_environment
from studio.versions import versions_of


@dataclass(frozen=True)
class ReplayArguments(RunsArguments):
    """Do a run again from its seed and its log, and compare phi of each iteration with what it wrote; or write its
    whole evolution as one HTML file, a film of it, or a still.

    The run itself is only read. Ctrl-C ends the replay with what was found so far. The exit status is 0 where phi is
    the same to the last bit, 1 where it differs.
    """

    run: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN...")] = ()
    """Run to replay: its name, or the path of its folder. With --html up to four runs of one task, side by side,
    with --video two; there, as with --still, RUN@DESIGN names a design of it."""
    check: bool = False
    """Compare phi of each iteration, and report the first that differs."""
    html: Annotated[Path | None, tyro.conf.arg(metavar="PATH.html")] = None
    """File to write, which opens from disk without a network: bodies, traces and episodes of all iterations."""
    film: Annotated[FilmArguments, tyro.conf.OmitArgPrefixes] = FilmArguments()
    until: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Last iteration to compare, by default the last recorded one."""
    json: bool = False
    """Print one JSON document at the end and nothing else."""


def main(words: Sequence[str]) -> int:
    """Run `morph-studio replay` with these words; return the exit status. UsageError says what is allowed."""
    arguments = parse(ReplayArguments, words, "replay")
    if not arguments.run:
        raise UsageError("replay: RUN is missing; see --help")
    film = arguments.film
    if [arguments.check, arguments.html is not None, film.is_wanted].count(True) != 1:
        raise UsageError(
            "replay: give one of --check, which compares phi with what the run wrote, --html PATH.html, which writes "
            "the evolution as one page, --video FILE.mp4, which films it, and --still FILE.svg"
        )
    if film.given and not film.is_wanted:
        raise UsageError(f"replay: {film.given[0]} goes with --video or --still")
    if film.is_wanted:
        if arguments.until is not None:
            raise UsageError("replay: --until goes with --check")
        return write_film(arguments.runs, arguments.run, film, json=arguments.json)
    histories = [open_run(arguments.runs, run) for run in arguments.run]
    if arguments.html is not None:
        if arguments.until is not None:
            raise UsageError("replay: --until goes with --check; the page holds the whole evolution")
        return write_evolution(histories, arguments.html, json=arguments.json)
    if len(histories) > 1:
        raise UsageError(f"replay: --check compares one run, not {len(histories)}")
    return _check(histories[0], arguments)


def _check(history: History, arguments: ReplayArguments) -> int:
    """Compare a run with what it wrote; return the exit status."""
    last = history.iteration if arguments.until is None else arguments.until
    if not history.begins_at < last <= history.iteration:
        first = history.begins_at + 1
        allowed = f"{first} to {history.iteration}" if first <= history.iteration else "it has no iteration yet"
        raise UsageError(f"replay: --until must be an iteration of {history.folder.id} ({allowed}), not {last}")
    with _replaying(history, last) as (process, signals):
        reached, found = _read(process, history, last, quiet=arguments.json)
        trouble = process.communicate()[1].strip().splitlines()
    if signals:
        complain(f"stopped: phi is the same up to iteration {reached}")
        return 130
    if found is None:
        reason = trouble[-1] if trouble else f"the replay ended with {process.returncode}"
        complain(f"morph-studio: replay: {reason.removeprefix('morph_core.replay: ')}")
        return 2 if process.returncode == 2 else 1
    document = _document(history, found, last)
    if arguments.json:
        write_json(document)
    else:
        for line in _sentences(document):
            say(line)
    return 1 if document["difference"] else 0


@contextlib.contextmanager
def _replaying(history: History, last: int) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """Replay in a process of its own, which needs torch; it ends when we are told to end, by the signals collected."""
    signals: list[int] = []
    process: subprocess.Popen[str] | None = None

    def end(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 - the signature of a handler
        signals.append(number)
        if process is not None:
            process.kill()  # it writes nothing

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "morph_core.replay", "--run", str(history.folder.path.resolve()),
         "--until", str(last)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding="utf-8", errors="replace", env=trainer_environment(),
        start_new_session=True,
    )  # fmt: skip
    try:
        yield process, signals
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        process.kill()
        process.wait()


def _read(
    process: subprocess.Popen[str], history: History, last: int, *, quiet: bool
) -> tuple[int, dict[str, Any] | None]:
    """Show how far the replay is; return the last iteration that was the same, and what was found at the end."""
    from rich.progress import Progress

    from studio.cli.terminal import make_console

    reached, lines = history.begins_at, process.stdout
    assert lines is not None
    console = make_console(stderr=True)
    with Progress(console=console, disable=quiet or not console.is_terminal, transient=True) as bar:
        task = bar.add_task(f"replaying {history.folder.id}", total=last, completed=reached)
        for line in lines:
            said = json.loads(line)
            if "compared" in said:
                return reached, said
            reached = said["iteration"]
            bar.update(task, completed=reached)
    return reached, None


# --- what was found ---------------------------------------------------------------------------------------------------


def _document(history: History, found: dict[str, Any], last: int) -> dict[str, Any]:
    """Return what was found, with what may explain a difference."""
    then, now = history.record.versions, versions_of(*PACKAGES)
    revision, _ = git_state()
    versions = {name: [then[name], now[name]] for name in then if name in now and then[name] != now[name]}
    if history.record.git_revision and revision and history.record.git_revision != revision:
        versions["revision of morph-studio"] = [history.record.git_revision[:10], revision[:10]]
    return found | {
        "until": last,
        "difference": found["difference"] and found["difference"] | {"names": history.design_space.names},
        "other_processors": [p for p in found["recorded_on"] if p != found["replayed_on"]],
        "other_versions": versions,
    }


def _sentences(document: dict[str, Any]) -> Iterator[str]:
    """Yield what was found, in words."""
    difference = document["difference"]
    if difference is None:
        yield f"{document['run']}: {document['compared']} iterations replayed, phi is the same to the last bit"
    else:
        yield f"{document['run']}: phi differs first in iteration {difference['iteration']}"
        for name, recorded, replayed in zip(
            difference["names"], difference["recorded"], difference["replayed"], strict=True
        ):
            if recorded != replayed:
                yield f"  {name}: {recorded!r} recorded, {replayed!r} replayed"
    here = _in_words(document["replayed_on"])
    for other in document["other_processors"]:
        known = f"recorded on {_in_words(other)}" if other["name"] else "the run does not say on which processor it ran"
        yield f"{known}, replayed on {here}: results may differ in their last bits, and so in their course"
    for name, (then, now) in document["other_versions"].items():
        yield f"recorded with {name} {then}, replayed with {now}: results may differ"


def _in_words(processor: dict[str, str]) -> str:
    return f"{processor['name']} ({processor['instruction_set']})"
