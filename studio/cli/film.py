"""The part of `morph-studio replay` that writes a film or a still of runs."""

import contextlib
import dataclasses
import re
import signal
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import tyro

from morph_core.history import History
from morph_core.protocol import Which
from morph_core.run_folder import ITERATION
from studio.cli.arguments import UsageError
from studio.cli.choice import open_run
from studio.cli.output import complain, say, write_json
from studio.limits import cores
from studio.settings import at_home

if TYPE_CHECKING:
    from studio.film.plan import Film

HEIGHTS, FPS, JOBS = (240, 2160), (5, 60), (1, 64)
"""Ranges of a film: height in pixels, frames per second, and processes that render it."""
ASPECTS, SIDE_BY_SIDE = (1.25, 2.4), (1.6, 2.8)
"""Smallest and largest width of a film as a multiple of its height, and of one with two scenes side by side."""
MOST_JOBS = 8
"""Processes that are started unasked, at most: each takes up to half a gigabyte of memory."""


@dataclass(frozen=True)
class FilmArguments:
    """What a film or a still is to be like."""

    video: Annotated[Path | None, tyro.conf.arg(metavar="FILE.mp4|FILE.gif")] = None
    """Film to write: the evolution of a run, or of two side by side; with --design, or as RUN@DESIGN, episodes.
    Interrupted, the same command goes on from the frames that are there."""
    still: Annotated[Path | None, tyro.conf.arg(metavar="FILE.svg|FILE.png")] = None
    """Still to write, on clear ground: a design in its start posture, or with --at a moment of its episode."""
    design: Annotated[str | None, tyro.conf.arg(metavar="best|latest|ITERATION")] = None
    """Design whose episode is filmed; of a still, the design that is shown, by default the best one."""
    episode: Annotated[Which | None, tyro.conf.arg(metavar="median|best|worst|failed")] = None
    """Name of the recorded episode that is filmed, by default the median one."""
    at: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """Moment of the episode that a still shows."""
    size: Annotated[str | None, tyro.conf.arg(metavar="WxH|WxHmm")] = None
    """Size of a film in pixels, by default 1920x1080, of a GIF 960x540; of a still on paper, such as 85x60mm, 3.4x2.4in
    or a width alone, by default 85mm."""
    fps: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Frames per second of a film, by default 30, of a GIF 20."""
    seconds: Annotated[float | None, tyro.conf.arg(metavar="S")] = None
    """Seconds that the evolution takes in a film, by default 0.2 for each iteration, and from 6 to 30."""
    dpi: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Pixels per inch of a still as PNG, by default 300."""
    scale_bar: bool = False
    """Draw a scale bar into a still."""
    jobs: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Processes that render a film, by default as many as there are cores, and at most 8."""

    @property
    def is_wanted(self) -> bool:
        """Whether a film or a still is to be written."""
        return self.video is not None or self.still is not None

    @property
    def given(self) -> list[str]:
        """Flags that were given beside those of the files."""
        fields = [f for f in dataclasses.fields(self) if f.name not in ("video", "still")]
        return [f"--{f.name.replace('_', '-')}" for f in fields if getattr(self, f.name) != f.default]


_OF_STILLS, _OF_FILMS = ("--at", "--dpi", "--scale-bar"), ("--fps", "--seconds", "--jobs")
"""Flags that mean something for stills alone, and for films alone."""


def write_film(runs: Path, words: Sequence[str], wanted: FilmArguments, *, json: bool) -> int:
    """Write a film or a still of the runs that words such as RUN or RUN@DESIGN name; return the exit status."""
    from studio.film.errors import FilmError

    if not words:
        raise UsageError("replay: RUN is missing; see --help")
    places = [_place(runs, word) for word in words]
    try:
        if wanted.video is not None and wanted.still is not None:
            raise UsageError("replay: give --video or --still, not both")
        if wanted.still is not None:
            return _write_still(places, wanted, at_home(str(wanted.still)), json=json)
        assert wanted.video is not None
        return _write_video(places, wanted, at_home(str(wanted.video)), json=json)
    except FilmError as error:
        complain(f"morph-studio: replay: {error}")
        return 1


def _place(runs: Path, word: str) -> tuple[History, str | None]:
    """Return the run and the design, None where none is named, of RUN or RUN@DESIGN."""
    run, at, design = word.rpartition("@")
    if at and (design in ("best", "latest") or ITERATION.fullmatch(design)):
        return open_run(runs, run), design
    return open_run(runs, word), None


def _refuse(wanted: FilmArguments, flags: Sequence[str], other: str) -> None:
    if unfit := [flag for flag in flags if flag in wanted.given]:
        raise UsageError(f"replay: {unfit[0]} goes with {other}")


# --- stills -----------------------------------------------------------------------------------------------------------


def _write_still(places: Sequence[tuple[History, str | None]], wanted: FilmArguments, out: Path, *, json: bool) -> int:
    from morph_core.durable import where_written, write_file
    from studio.film.plan import STILL_DPI, STILL_WIDTH
    from studio.film.still import DPI, Format, Still, read_size

    _refuse(wanted, _OF_FILMS, "--video")
    if len(places) != 1:
        raise UsageError(f"replay: a still shows one design, not {len(places)}")
    ending = out.suffix.lower()
    if ending not in (".svg", ".png"):
        raise UsageError(f'replay: a still ends in .svg or .png, not "{out.suffix[:20]}"')
    if not out.parent.is_dir():
        raise UsageError(f"replay: there is no folder {out.parent} to write into")
    dpi = STILL_DPI if wanted.dpi is None else wanted.dpi
    _check("--dpi", dpi, DPI)
    (history, design), form = places[0], Format(*read_size(wanted.size or f"{STILL_WIDTH:g}mm"), dpi, wanted.scale_bar)
    still = Still(history, design or wanted.design or "best", wanted.at, wanted.episode)
    content = still.svg(form) if ending == ".svg" else still.png(form)
    try:
        write_file(where_written(out), content)
    except OSError as error:
        complain(f"morph-studio: replay: can't write {out}: {error.strerror or error}")
        return 1
    _tell(out, {"path": str(out), "bytes": len(content)}, json=json)
    return 0


# --- films ------------------------------------------------------------------------------------------------------------


def _write_video(places: Sequence[tuple[History, str | None]], wanted: FilmArguments, out: Path, *, json: bool) -> int:
    from rich.progress import Progress

    from studio.cli.terminal import make_console
    from studio.film.reel import Reel

    jobs = min(len(cores()), MOST_JOBS) if wanted.jobs is None else wanted.jobs
    _check("--jobs", jobs, JOBS)
    film = _film(places, wanted, out)
    reel = Reel.of(film, out)
    done = 0
    console = make_console(stderr=True)
    with Progress(console=console, disable=json or not console.is_terminal, transient=True) as bar, _interruptible():
        task = bar.add_task(f"rendering {out.name}", total=reel.frames)

        def advance(frames: int) -> None:
            nonlocal done
            done += frames
            bar.update(task, completed=done)

        try:
            reel.render(jobs, advance)
            reel.join()
        except KeyboardInterrupt:
            kept = reel.frames - sum(len(part) for part in reel.missing())
            complain(
                f"stopped: {kept} of {reel.frames} frames stay in {reel.folder}; the same command goes on from them, "
                "and they can be removed"
            )
            return 130
    about = {"frames": reel.frames, "fps": film.fps, "width": film.width, "height": film.height}
    _tell(out, {"path": str(out), "bytes": out.stat().st_size, **about}, json=json)
    return 0


def _film(places: Sequence[tuple[History, str | None]], wanted: FilmArguments, out: Path) -> "Film":
    """Return the film that is wanted. UsageError and FilmError say what is allowed."""
    from studio.film.errors import FilmError
    from studio.film.plan import EVOLUTION, RATES, SIZES, plan_episode, plan_evolution
    from studio.film.reel import ENDINGS

    _refuse(wanted, _OF_STILLS, "--still")
    ending = out.suffix.lower()
    if ending not in ENDINGS:
        raise UsageError(f'replay: a film ends in {" or ".join(ENDINGS)}, not "{out.suffix[:20]}"')
    if len(places) > 2:
        raise UsageError(f"replay: a film shows one run or two side by side, not {len(places)}")
    size = _pixels(wanted.size, SIDE_BY_SIDE if len(places) > 1 else ASPECTS) if wanted.size else SIZES[ending]
    fps = RATES[ending] if wanted.fps is None else wanted.fps
    _check("--fps", fps, FPS)
    try:
        if wanted.design is None and wanted.episode is None and all(design is None for _, design in places):
            if wanted.seconds is not None:
                _check("--seconds", wanted.seconds, EVOLUTION)
            return plan_evolution([history for history, _ in places], size, fps, wanted.seconds)
        _refuse(wanted, ["--seconds"], "an evolution; an episode is filmed as long as it is")
        chosen = [(history, design or wanted.design or "best") for history, design in places]
        return plan_episode(chosen, wanted.episode, size, fps)
    except FilmError as error:
        raise UsageError(f"replay: {error}") from error


def _pixels(words: str, aspects: tuple[float, float]) -> tuple[int, int]:
    """Return the size in pixels of words such as 1920x1080. UsageError says what is allowed."""
    low, high = HEIGHTS
    narrow, wide = aspects
    if match := re.fullmatch(r"(\d{1,5})x(\d{1,5})", words.strip().lower()):
        width, height = int(match[1]), int(match[2])
        even = width % 2 == 0 and height % 2 == 0
        if even and low <= height <= high and narrow * height <= width <= wide * height:
            return width, height
    raise UsageError(
        f"replay: the --size of a film is width x height in even numbers of pixels, such as 1920x1080, with a height "
        f'from {low} to {high} and a width of {narrow:g} to {wide:g} times that, not "{words[:40]}"'
    )


def _check(flag: str, value: float, allowed: tuple[float, float]) -> None:
    low, high = allowed
    if not low <= value <= high:
        raise UsageError(f"replay: {flag} must be from {low:g} to {high:g}, not {value:g}")


def _tell(out: Path, document: dict[str, object], *, json: bool) -> None:
    if json:
        write_json(document)
    else:
        say(out)


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Let a request to end do what Ctrl-C does."""

    def stop(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 - the signature of a handler
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
