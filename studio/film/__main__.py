"""A film or a still for the studio, made in a process that gives way to all others: `python -m studio.film ORDER`."""

import contextlib
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec
import psutil

from morph_core.durable import write_file
from morph_core.history import History
from morph_core.run_folder import RunFolder
from studio.film.errors import DiskFullError, FilmError
from studio.film.plan import RATES, SIZES, STILL_DPI, STILL_WIDTH, Film, plan_episode, plan_evolution
from studio.film.reel import Reel
from studio.film.still import Format, Still
from studio.filming import CPU_SECONDS, MOST_FRAMES, FilmWish, Order, Said

_AUTOGROUP = Path("/proc/self/autogroup")
"""Where Linux is told how nice a session is: by default it divides the processor among sessions, and niceness counts
within one alone."""
_BUSY = 0.25
"""Share of all processors from which on other work would notice what a film does to caches and shared cores."""
_REST = 4.0
"""How much longer than it has worked a film rests then: at full speed it took 7 % from a training on a shared core."""


def main(words: Sequence[str]) -> int:
    """Make what the order says, tell how far it is, one line of JSON each, and return the exit status."""
    order = msgspec.json.decode(words[0], type=Order)
    give_way()
    try:
        histories = [History(RunFolder(Path(folder))) for folder in order.folders]
        make(order.wish, histories, Path(order.out))
    except DiskFullError:
        where = Path(order.out).parent.parent
        _say(Said(failed=f"the disk of {where} has no room for it: make room, or wish for a smaller or a shorter film"))
        return 1
    except ValueError as error:
        _say(Said(failed=str(error)))
        return 1
    except OSError as error:
        _say(Said(failed=f"the disk does not take it: {error.strerror or error}"))
        return 1
    return 0


def give_way() -> None:
    """Let other processes of the session go first, and end this one when it has taken too much of the processor."""
    os.nice(19)
    with contextlib.suppress(ImportError):
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS + 10))


def take_what_is_left() -> None:
    """Have the processor where no other session wants it; processes that are started take that over, as long as they
    stay in this session."""
    with contextlib.suppress(OSError):  # no Linux, or sessions share the processor alike with their threads
        _AUTOGROUP.write_text("19", encoding="ascii")
    with contextlib.suppress(AttributeError, OSError):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


class Rests:
    """Pauses of a film beside work that keeps the processors busy."""

    def __init__(self) -> None:
        """Begin to watch."""
        self._worked, self._seen = time.process_time(), self._others()

    def take(self) -> bool:
        """Sleep if other work has kept the processors busy since the last time; tell whether it has."""
        worked, (at, busy) = time.process_time() - self._worked, self._others()
        busy = busy - self._seen[1] > _BUSY * (psutil.cpu_count() or 1) * (at - self._seen[0])
        if busy:
            time.sleep(_REST * worked)
        self._worked, self._seen = time.process_time(), self._others()
        return busy

    @staticmethod
    def _others() -> tuple[float, float]:
        """Return the time by the clock, and what work that is not nice, as we are, has taken of the processors."""
        return time.monotonic(), psutil.cpu_times().user


def make(wish: FilmWish, histories: Sequence[History], out: Path) -> None:
    """Make a film or a still. Raise FilmError where it can't be."""
    if wish.is_still:
        still = Still(histories[0], wish.design or "best", wish.at, wish.episode)
        _say(Said(frames=1))
        form = Format(STILL_WIDTH, None, STILL_DPI, bar=False)
        write_file(out, still.svg(form) if wish.format == "svg" else still.png(form))
        return
    reel, done, rests = Reel.of(film_of(wish, histories), out), 0, Rests()
    if reel.frames > MOST_FRAMES:
        reel.clear()
        raise FilmError(
            f"the film would have {reel.frames} frames, and in the studio {MOST_FRAMES} are the most; "
            "morph-studio replay --video makes longer ones"
        )
    _say(Said(frames=reel.frames))
    take_what_is_left()  # from here on, as nobody waits any more to be told whether there can be a film

    def tell(frames: int) -> None:
        nonlocal done
        done += frames
        _say(Said(frames=reel.frames, done=done, resting=rests.take()))

    reel.render(1, tell)
    reel.join()


def film_of(wish: FilmWish, histories: Sequence[History]) -> Film:
    """Return the film that is wished for. Raise FilmError where a run holds nothing to be shown."""
    ending = f".{wish.format}"
    size = (wish.height * 16 // 9, wish.height) if wish.height else SIZES[ending]
    if not wish.shows_episodes:
        return plan_evolution(histories, size, RATES[ending], wish.seconds)
    designs = [wish.design or "best", wish.beside_design or "best"]
    return plan_episode(list(zip(histories, designs, strict=False)), wish.episode, size, RATES[ending])


def _say(said: Said) -> None:
    sys.stdout.buffer.write(msgspec.json.encode(said) + b"\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
