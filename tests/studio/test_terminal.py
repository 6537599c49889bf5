"""What a command that follows others writes on the terminal."""

import io

import pytest
from rich.console import Console
from rich.text import Text

from studio.cli import terminal
from studio.cli.terminal import Cadence, Screen, in_words


def test_a_log_file_gets_news_every_few_seconds_and_the_last_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now)
    cadence = Cadence(5.0)
    assert cadence.is_due("first", last=False)
    assert not cadence.is_due("second", last=False), "too soon"
    assert cadence.is_due("second", last=True)
    now = 106.0
    assert not cadence.is_due("second", last=False), "no news"
    assert not cadence.is_due("second", last=True), "told already"
    assert cadence.is_due("third", last=False)


@pytest.mark.parametrize("is_terminal", [False, True])
def test_lines_are_drawn_under_the_sentences_on_a_terminal_alone(is_terminal: bool) -> None:
    console = Console(file=io.StringIO(), force_terminal=is_terminal, width=80)
    with Screen(console, quiet=False) as screen:
        screen.draw(Text("half way"))
        screen.say("hello")
    said = console.file.getvalue()  # pyright: ignore
    assert "hello" in said
    assert ("half way" in said) == is_terminal


def test_a_quiet_screen_says_nothing() -> None:
    console = Console(file=io.StringIO(), force_terminal=False, width=80)
    with Screen(console, quiet=True) as screen:
        screen.say("hello")
    assert console.file.getvalue() == ""  # pyright: ignore


@pytest.mark.parametrize(("seconds", "words"), [(0.4, "ETA 0:00"), (59.6, "ETA 1:00"), (3723, "ETA 1:02:03")])
def test_what_is_left_reads_as_hours_minutes_and_seconds(seconds: float, words: str) -> None:
    assert in_words(seconds) == words
