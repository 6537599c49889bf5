"""What a command that follows others writes on the terminal: sentences, and under them lines that are drawn anew."""

import time
from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderableType
from rich.live import Live
from rich.segment import Segment
from rich.text import Text

from studio.cli.output import visible

_WIDE = 200
"""Width of what goes into a pipe or a file, which has none: names stay whole."""


class _Console(Console):
    """A console that shows what files hold and obeys none of it: neither its markup nor its control characters."""

    def on_broken_pipe(self) -> None:
        """Pass the error on: a reader who has seen enough is no failure, in whatever way a command prints."""
        raise  # it is called where the error is handled

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render an object, its control characters written out; the console's own keep their effect."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=visible(segment.text))


def make_console(*, stderr: bool = False, soft_wrap: bool = False) -> Console:
    """Return the console of a command, on stdout or stderr."""
    console = _Console(stderr=stderr, soft_wrap=soft_wrap, markup=False, emoji=False, highlight=False)
    if not stderr and not console.is_terminal:
        console.width = _WIDE
    return console


class Screen:
    """Sentences and, on a terminal, lines under them that are drawn anew; in a log file the sentences alone."""

    def __init__(self, console: Console, quiet: bool) -> None:
        self.console = console
        self._quiet = quiet
        self._live = Live(console=console, transient=True)

    def __enter__(self) -> "Screen":
        if self.console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def say(self, sentence: str) -> None:
        """Print a sentence, unless the command is to be quiet."""
        if not self._quiet:
            self.console.print(Text(sentence))

    def draw(self, lines: RenderableType) -> None:
        """Put these lines under the sentences, in place of those that were there."""
        self._live.update(lines, refresh=True)


class Cadence:
    """When a log file gets its next line: where there is news, and not more often than every few seconds."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._next = time.monotonic()
        self._told: object = None

    def is_due(self, news: object, last: bool) -> bool:
        """Tell whether `news` is to be told now; what is told `last` does not wait."""
        if news == self._told or (time.monotonic() < self._next and not last):
            return False
        self._told, self._next = news, time.monotonic() + self._seconds
        return True


def in_words(seconds: float) -> str:
    """Return the time that is left, such as "ETA 1:02:03"."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"ETA {hours}:{minutes:02d}:{seconds:02d}" if hours else f"ETA {minutes}:{seconds:02d}"
