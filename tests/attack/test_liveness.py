"""Who is alive is told by a heartbeat that changes, whatever clocks, hosts and process numbers say."""

import platform
import time
from types import SimpleNamespace

import msgspec
import psutil
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core import pulse
from morph_core.protocol import Heartbeat
from morph_core.pulse import BEATS_WITHIN, LOST_AFTER, Pulse, at_work

ME = psutil.Process()
NOBODY = 2**22 + 1
"""A number that no process has."""


class Clock:
    """Time that the test moves: `wall` may jump, `monotonic` only passes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wall, self.passed = time.time(), 100.0
        fake = SimpleNamespace(time=lambda: self.wall, monotonic=lambda: self.passed, sleep=self.wait)
        monkeypatch.setattr(pulse, "time", fake)

    def wait(self, seconds: float) -> None:
        self.wall += seconds
        self.passed += seconds


def beat(pid: int, started: float, at: float, host: str = "") -> Heartbeat:
    return Heartbeat(host or platform.node(), pid, started, at, "running", "learning", 1, 6)


WRITERS = {
    "another host": (7, 0.0, "cluster-node"),
    "another host whose trainer has a number of ours": (ME.pid, 0.0, "cluster-node"),
    "this host, its clock was set": (ME.pid, ME.create_time() - 3600, ""),
    "a container with the name of this host": (NOBODY, 0.0, ""),
}


@settings(max_examples=25, deadline=None)
@given(skew=st.floats(-1e9, 1e9), jump=st.floats(-1e7, 1e7), gap=st.floats(0.5, BEATS_WITHIN - 0.5))
@pytest.mark.parametrize("writer", WRITERS)
def test_what_changes_is_alive_whatever_the_clocks_say(writer: str, skew: float, jump: float, gap: float) -> None:
    pid, started, host = WRITERS[writer]
    with pytest.MonkeyPatch.context() as patch:
        clock, seen = Clock(patch), Pulse()
        for n in range(6):
            seen.see(beat(pid, started, clock.wall + skew, host))
            alive = seen.is_alive
            assert alive or n < 3  # until it has been seen to change
            clock.wait(gap)
            clock.wall += jump * (n == 3)
        clock.wait(LOST_AFTER + 1)
        assert not seen.is_alive  # it stands still


def test_a_process_that_is_there_is_alive_however_long_the_machine_slept(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, seen = Clock(monkeypatch), Pulse()
    seen.see(beat(ME.pid, ME.create_time(), clock.wall))
    clock.wall += 1e6
    assert seen.is_alive


def test_the_last_word_of_a_process_that_is_gone_is_no_life(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, seen = Clock(monkeypatch), Pulse()
    seen.see(beat(NOBODY, 0.0, clock.wall))
    assert not seen.is_alive
    seen.see(beat(NOBODY, 0.0, clock.wall + 1))
    assert not seen.is_alive


def test_a_number_that_was_given_to_another_process_is_dead_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, seen = Clock(monkeypatch), Pulse()
    seen.see(beat(ME.pid, ME.create_time() - 1000, clock.wall - 60))
    assert not seen.is_alive
    seen = Pulse()
    seen.see(beat(ME.pid, ME.create_time() - 1000, clock.wall))
    clock.wait(BEATS_WITHIN + 0.1)
    assert not seen.is_alive


@pytest.mark.parametrize("writer", list(WRITERS)[:3])
@pytest.mark.parametrize("changes", [True, False])
def test_before_a_second_trainer_starts_the_heartbeat_is_watched(
    monkeypatch: pytest.MonkeyPatch, writer: str, changes: bool
) -> None:
    pid, started, host = WRITERS[writer]
    clock = Clock(monkeypatch)
    stands = clock.wall - 1000
    assert at_work(lambda: beat(pid, started, clock.wall if changes else stands, host)) == changes


def test_a_trainer_whose_last_word_comes_while_it_is_watched_is_not_at_work(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    first = beat(ME.pid, ME.create_time() - 1000, clock.wall, "elsewhere")
    last = msgspec.structs.replace(first, status="finished", time=clock.wall + 1)
    words = iter([first])
    assert not at_work(lambda: next(words, last))
