"""A film or a still for the studio, made in a process that gives way to all others: `python -m studio.film ORDER`."""

import contextlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec

from morph_core.durable import write_file
from morph_core.history import History
from morph_core.run_folder import RunFolder
from studio.film.errors import FilmError
from studio.film.plan import RATES, SIZES, STILL_DPI, STILL_WIDTH, Film, plan_episode, plan_evolution
from studio.film.reel import Reel
from studio.film.still import Format, Still
from studio.filming import CPU_SECONDS, MOST_FRAMES, FilmWish, Order, Said


def main(words: Sequence[str]) -> int:
    """Make what the order says, tell how far it is, one line of JSON each, and return the exit status."""
    order = msgspec.json.decode(words[0], type=Order)
    give_way()
    try:
        histories = [History(RunFolder(Path(folder))) for folder in order.folders]
        make(order.wish, histories, Path(order.out))
    except (ValueError, OSError) as error:
        _say(Said(failed=str(error)))
        return 1
    return 0


def give_way() -> None:
    """Let all other processes have the processor first, and end this one when it has taken too much of it."""
    os.nice(19)
    with contextlib.suppress(ImportError):
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS + 10))


def make(wish: FilmWish, histories: Sequence[History], out: Path) -> None:
    """Make a film or a still. Raise FilmError where it can't be."""
    if wish.is_still:
        still = Still(histories[0], wish.design or "best", wish.at, wish.episode)
        _say(Said(frames=1))
        form = Format(STILL_WIDTH, None, STILL_DPI, bar=False)
        write_file(out, still.svg(form) if wish.format == "svg" else still.png(form))
        return
    reel, done = Reel.of(film_of(wish, histories), out), 0
    if reel.frames > MOST_FRAMES:
        reel.clear()
        raise FilmError(
            f"the film would have {reel.frames} frames, and in the studio {MOST_FRAMES} are the most; "
            "morph-studio replay --video makes longer ones"
        )
    _say(Said(frames=reel.frames))

    def tell(frames: int) -> None:
        nonlocal done
        done += frames
        _say(Said(frames=reel.frames, done=done))

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
