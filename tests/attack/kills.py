"""kill -9 of the trainer at random moments: nothing that was said is lost, and the end is that of a run never killed.

Said is every event that a reader has seen whole, and every command that was answered. phi is compared to the last bit.
"""

import contextlib
import random
import signal
import tempfile
import time
from pathlib import Path

from morph_core.history import History
from morph_core.protocol import Acknowledged, AnyEvent, Progress, SetAlpha, SetBound, SetProjection
from morph_core.run_folder import RunFolder
from tests.attack.outcome import Outcome
from tests.core.conftest import make_run, small_method
from tests.forked import Forked, trainer

SHARE = 5
"""Largest number of iterations between two kills, so that the run lives for all of them."""
KILLS_A_RUN = 10
_PATIENCE = 600.0


def attack_kills(kills: int, seed: int, quiet: bool = False) -> Outcome:
    """Kill the trainers of small runs of the reacher so many times."""
    outcome, rng, number = Outcome("kills", kills, "kills", seed, quiet=quiet), random.Random(seed), 0
    with tempfile.TemporaryDirectory() as name:
        while outcome.tried < kills and not outcome.failed:
            _compare(Path(name), number, rng, min(KILLS_A_RUN, kills - outcome.tried), outcome)
            number += 1
    outcome.figures["runs"] = float(number)
    return outcome.end()


def _compare(runs: Path, number: int, rng: random.Random, kills: int, outcome: Outcome) -> None:
    """Run a seed to its end without a kill and with some, with the same commands, and compare both."""
    seed = rng.randrange(2**32)
    whole, killed = (
        make_run(runs, f"{name}-{number}", small_method("morph"), seed=seed, iterations=kills * SHARE + 10)
        for name in ("whole", "killed")
    )
    for folder in (whole, killed):
        for command in (SetAlpha(2.5), SetBound("link_1", 1.0, 4.0), SetProjection("one_sided")):
            folder.send(command)
    if (status := trainer(whole).wait(_PATIENCE)) != 0:
        outcome.fault(f"seed {seed}: the run that was never killed ended with {status}")
        return
    began = time.monotonic()
    first = trainer(killed)
    _wait(killed, 1, _PATIENCE)
    start = time.monotonic() - began
    _kill(killed, first, outcome)
    for kill in range(1, kills):
        life = trainer(killed)
        if rng.random() < 0.5:
            killed.send(SetAlpha(2.5), "an attack")  # changes nothing, and wants an answer
        _wait(killed, (kill + 1) * SHARE, rng.uniform(0, 2 * start))
        _kill(killed, life, outcome)
    if (status := trainer(killed).wait(_PATIENCE)) != 0:
        outcome.fault(f"seed {seed}: the run that was killed can't be taken up again: {History(killed).message}")
        return
    for what in differences(History(whole), History(killed)):
        outcome.fault(f"seed {seed}: {what}")
    if left := list(killed.pending()):
        outcome.fault(f"seed {seed}: {len(left)} commands were never answered")
    redone = sum(isinstance(e, Progress) for e in History(killed).events) - len(History(whole).progress)
    outcome.figures["iterations done again"] = redone + float(outcome.figures.get("iterations done again", 0))


def _kill(folder: RunFolder, process: Forked, outcome: Outcome) -> None:
    """Kill a trainer, and note what of its log is not there any more."""
    seen = folder.read_events()[0]
    with contextlib.suppress(ProcessLookupError):
        process.send_signal(signal.SIGKILL)
    if (status := process.wait(_PATIENCE)) != -signal.SIGKILL:
        outcome.fault(f"the trainer had ended with {status} before kill {outcome.tried + 1}: {History(folder).message}")
    outcome.add()
    for what in lost(seen, folder.read_events()[0]):
        outcome.fault(f"kill {outcome.tried}: {what}")


def lost(before: list[AnyEvent], after: list[AnyEvent]) -> list[str]:
    """Return in words what a log had and has no more, or has in another order."""
    if after[: len(before)] == before:
        return []
    return [f"{event.seq} {type(event).__name__} is lost" for event in before if event not in after] or ["out of order"]


def differences(whole: History, killed: History) -> list[str]:
    """Return in words where the run that was killed differs from the one that was not."""
    said = []
    if whole.status != "finished" or killed.status != "finished":
        said.append(f"they ended {whole.status} and {killed.status}: {killed.message}")
    for name, of in (("phi", "phi"), ("return", "episode_return"), ("divergence", "divergence")):
        a, b = ([getattr(p, of) for p in history.progress] for history in (whole, killed))
        if a != b:
            first = next((i for i, (x, y) in enumerate(zip(a, b, strict=False), 1) if x != y), min(len(a), len(b)) + 1)
            said.append(f"{name} differs from iteration {first} on")
    numbers = [event.seq for event in killed.events]
    if numbers != list(range(1, len(numbers) + 1)):
        said.append("the numbers of its events have gaps")
    answers = [e.id for e in killed.events if isinstance(e, Acknowledged)]
    if len(set(answers)) != len(answers):
        said.append("a command was answered twice")
    return said


def _wait(folder: RunFolder, iterations: int, seconds: float) -> None:
    """Wait until a run has done so many iterations, or for some seconds."""
    history, until = History(folder), time.monotonic() + seconds
    while history.iteration < iterations and time.monotonic() < until:
        time.sleep(0.005)
        history.poll()
