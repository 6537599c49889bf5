"""Run folders, a stand-in trainer and a real server for the studio's tests."""

import contextlib
import io
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import msgspec
import numpy as np
import pytest
import uvicorn
import viser
from fastapi import FastAPI

from morph_core.catalogue import make_method, make_task, read_method
from morph_core.config import recorded
from morph_core.history import History
from morph_core.protocol import (
    FORMAT,
    AnyCommand,
    AnyEvent,
    Evaluation,
    InjectDesign,
    Lock,
    Progress,
    RunRecord,
    SetAlpha,
    StateChanged,
    Status,
)
from morph_core.run_folder import EventLog, RunFolder, create_run, list_runs, process_alive, write_episode
from morph_core.what_if import Measured
from studio.app import create_app
from studio.branches import Member
from studio.bridge import MAX_MESSAGE
from studio.cancellation import Cancellation
from studio.desks import Presenting
from studio.export.bundle import Bundle
from studio.export.check import Check
from studio.export.design_file import Design, Value
from studio.filming import FilmState, FilmWish
from studio.new_run import StartRun, prepare_run
from studio.recordings import Recordings
from studio.runs import Runs
from studio.settings import Settings
from studio.viewer.take import Take
from studio.viewer.view import Seen, View
from studio.viewer.viewer import Viewer
from studio.what_if import SweepPoint, WhatIf, WhatIfs, Wish, sweep_designs
from tests.hands import write_hand_run

ROOT = Path(__file__).parents[2]
TOKEN = "a-token-of-the-tests"
FEW = 32
"""Number of episodes that prove a policy in the tests, which export often."""


@pytest.fixture(scope="session", autouse=True)
def few_episodes() -> Iterator[None]:
    """Let exports prove their policies in a few episodes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("studio.export.bundle.EPISODES", FEW)
        yield


NAME = "20260101-000000-reacher-morph-s0"

STAND_IN = """
import os, platform, sys, time
import psutil
from pathlib import Path
from morph_core.protocol import Acknowledged, Heartbeat, Pause, Resume, StateChanged, Stop
from morph_core.run_folder import EventLog, HeartbeatFile, RunFolder, hold

folder, mood = RunFolder(Path(sys.argv[1])), sys.argv[2]
if mood == "stillborn":
    raise ImportError("no module named torch, says the stand-in")
with hold(folder):
    log, heart = EventLog(folder), HeartbeatFile(folder)
    def beat(status):
        me = psutil.Process()
        heart.write(Heartbeat(platform.node(), me.pid, me.create_time(), time.time(), status, "collecting", 2, 100))
    status = "running"
    log.append(StateChanged(status="starting", iteration=0))
    log.append(StateChanged(status=status, iteration=0))
    beat(status)
    if mood == "dying":
        raise FloatingPointError("loss is NaN, says the stand-in")
    born = time.monotonic()
    while status != "stopped" and time.monotonic() < born + 60:  # no test leaves it behind for long
        for path, order in folder.pending():
            path.unlink()
            status = {Pause: "paused", Resume: "running", Stop: "stopped"}.get(type(order.command), status)
            log.append(Acknowledged(id=order.id, iteration=2, accepted=True, command=order.command))
            log.append(StateChanged(status=status, iteration=2))
        beat(status)
        time.sleep(0.02)
"""


def stand_in(
    folder: RunFolder, *, further: int | None = None, from_start: bool = False, mood: str = "healthy"
) -> subprocess.Popen[bytes]:
    """Start a process that keeps the trainer's side of the run folder, and learns nothing."""
    del further, from_start
    with (folder.path / "trainer.log").open("ab") as log:
        return subprocess.Popen(
            [sys.executable, "-c", STAND_IN, str(folder.path), mood],
            stdout=log, stderr=log, cwd=ROOT, start_new_session=True,
        )  # fmt: skip


def in_mood(mood: str) -> Callable[..., subprocess.Popen[bytes]]:
    """Return a `spawn` whose stand-ins are stillborn or dying."""
    return lambda folder, *, further=None, from_start=False: stand_in(
        folder, further=further, from_start=from_start, mood=mood
    )


def make_run(runs: Path, name: str = NAME, ended: Status | None = "stopped") -> RunFolder:
    """Return a run folder with three iterations, an evaluation and a rollout; without `ended`, before its start."""
    task = make_task("reacher")
    record = RunRecord(
        id=name, task="reacher", method="morph", seed=0, iterations=100,
        config=recorded(make_method("morph", task)), format=FORMAT,
        parameters=list(task.design_space.parameters), versions={"python": "3"}, created=time.time(),
    )  # fmt: skip
    folder = create_run(runs, record)
    if ended is None:
        return folder
    log = EventLog(folder)
    log.append(StateChanged(status="starting", iteration=0))
    for i in (1, 2, 3):
        phi = [3.0 - 0.1 * i] * 5
        log.append(
            Progress(iteration=i, env_steps=100 * i, phi=phi, episode_return=-1.0, success=0.1 * i, policy_std=0.5)
        )
    name = write_episode(folder, 3, {"qpos": np.zeros((4, 5)), "phi": np.full(5, 2.7)})
    log.append(
        Evaluation(
            iteration=3, env_steps=300, phi=[2.7] * 5, sampled_success=0.5, sampled_return=0.0,
            deterministic_success=0.25, deterministic_return=0.0, episode=name,
        )
    )  # fmt: skip
    log.append(StateChanged(status=ended, iteration=3, message="as asked"))
    log.close()
    return folder


def append(folder: RunFolder, *events: AnyEvent) -> None:
    """Write events to the log of a run."""
    log = EventLog(folder)
    for event in events:
        log.append(event)
    log.close()


def progress(iteration: int, **values: object) -> Progress:
    """Return what an iteration of the reacher records."""
    known = {"env_steps": 100, "phi": [2.0] * 5, "episode_return": -1.0, "success": 0.0, "policy_std": 0.5}
    return Progress(iteration=iteration, **(known | values))  # pyright: ignore[reportArgumentType]


def make_hand_run(runs: Path, task: str, name: str = "20260101-000000-hand-direct-s0") -> RunFolder:
    """Return a run folder of a hand: one iteration whose first finger grew and moved, and its evaluation."""
    phi = make_task(task).design_space.initial.tolist()
    phi[0], phi[len(phi) // 2] = 0.1, phi[len(phi) // 2] + 0.05
    events = (
        Progress(
            iteration=1, env_steps=5120, phi=phi, episode_return=-1.0, success=0.0, policy_std=0.5,
            relabelled_steps=1024, diverged=3,
        ),
        Evaluation(
            iteration=1, env_steps=5120, phi=phi, sampled_success=0.25, sampled_return=0.0, deterministic_success=0.5,
            deterministic_return=0.0, milestones={"lifted": 0.75, "pressed": 0.5}, diverged=2,
        ),
    )  # fmt: skip
    return write_hand_run(runs, task, phi, name, iterations=10, events=events)


def design_of(history: History, phi: list[float]) -> Design:
    """Return what design.json of a bundle says of phi."""
    parameters = [
        Value(name=p.name, value=value, unit=p.unit, lo=p.lo, hi=p.hi, locked_at=None, hard_lo=p.hard_lo,
              hard_hi=p.hard_hi, initial=p.initial)
        for p, value in zip(history.record.parameters, phi, strict=True)
    ]  # fmt: skip
    return Design(
        task=history.record.task, task_options={}, robot="robot", run=history.folder.id, design="best", iteration=1,
        parameters=parameters,
    )  # fmt: skip


def eventually(claim: Callable[[], object], seconds: float = 30.0) -> object:
    """Return the first true value of `claim`, or its last value after `seconds`: many, for a machine that does much
    else."""
    deadline = time.monotonic() + seconds
    while not (value := claim()) and time.monotonic() < deadline:
        time.sleep(0.02)
    return value


@dataclass
class Oracle:
    """Answers to what-if questions without a policy: success is the first entry of phi over its highest value."""

    warm: int = 0
    asked: list[Wish] = field(default_factory=list)
    refusal: str | None = None
    patience: float = 0.0
    """Seconds that an answer takes."""

    def warm_up(self) -> None:
        self.warm += 1

    def evaluate(
        self,
        history: History,
        wish: Wish,
        cancellation: Cancellation,
        on_played: Callable[[bytes], None] | None = None,
    ) -> WhatIf:
        self.asked.append(wish)
        if self.refusal:
            raise ValueError(self.refusal)
        phi = wish.phi if isinstance(wish.phi, list) else history.design(wish.design)[1].tolist()
        if on_played:
            arrays = io.BytesIO()
            np.savez(arrays, qpos=np.zeros((4, len(phi))), phi=np.array(phi))
            on_played(arrays.getvalue())
        eventually(lambda: cancellation.is_set, self.patience)
        cancellation.check()
        named = dict(zip(history.design_space.names, phi, strict=True))
        return WhatIf(
            **msgspec.structs.asdict(self.measured(history, phi)), run=history.folder.id, iteration=int(wish.design),
            policy_iteration=2, note="", policy=wish.policy, seed=0, phi=named,
        )  # fmt: skip

    def sweep(self, history: History, wish: Wish, cancellation: Cancellation) -> Iterator[SweepPoint]:
        phi = wish.phi
        assert isinstance(phi, list)
        designs = sweep_designs(history.design_space.whole, np.array(phi))
        for number, (i, other) in enumerate(designs, 1):
            p = history.record.parameters[i]
            eventually(lambda: cancellation.is_set, self.patience)
            cancellation.check()
            known = {"parameter": p.name, "unit": p.unit, "value": float(other[i])}
            measured = self.measured(history, other.tolist())
            yield SweepPoint(number=number, of=len(designs), measured=measured, **known)

    @staticmethod
    def measured(history: History, phi: list[float]) -> Measured:
        share = phi[0] / history.record.parameters[0].hard_hi
        return Measured(
            episodes=128, success=share, success_interval=(share / 2, share), episode_return=-share,
            return_interval=(-1.0, 0.0), reward_terms={"distance": -share}, milestones={}, diverged=0,
        )  # fmt: skip


@dataclass
class Stars:
    """Stars in memory, and pictures of nothing, of which it notes the designs."""

    stars: dict[str, set[int]] = field(default_factory=dict)
    drawn: list[Sequence[float]] = field(default_factory=list)
    refusal: str | None = None

    def starred(self, history: History) -> list[int]:
        return sorted(self.stars.get(history.folder.id, set()))

    def star(self, run_id: str, iteration: int, starred: bool) -> None:
        if self.refusal:
            raise ValueError(self.refusal)
        stars = self.stars.setdefault(run_id, set())
        stars.add(iteration) if starred else stars.discard(iteration)

    def picture(self, history: History, phi: Sequence[float]) -> bytes:
        if self.refusal:
            raise ValueError(self.refusal)
        self.drawn.append(phi)
        return b"a picture"


@dataclass
class Neighbours:
    """The runs that a design may be compared with; those of `names` are called something by people."""

    histories: dict[str, History] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)

    def of_task(self, task: str) -> dict[str, str]:
        return {name: self.names.get(name, "") for name, h in self.histories.items() if h.record.task == task}

    def get(self, run_id: str) -> History:
        return self.histories[run_id]


@dataclass
class Cutter:
    """Films that nobody makes: a test says how far they are."""

    state: FilmState = field(default_factory=FilmState)
    wishes: list[FilmWish] = field(default_factory=list)
    refusal: str | None = None
    path: Path | None = None

    def start(self, wish: FilmWish) -> FilmState:
        if self.refusal:
            raise ValueError(self.refusal)
        self.wishes.append(wish)
        self.state = FilmState(state="making", number=len(self.wishes), wish=wish, name=wish.file_name)
        return self.state

    def cancel(self) -> FilmState:
        self.state = msgspec.structs.replace(self.state, state="cancelled")
        return self.state

    def file(self, number: int) -> Path | None:
        return self.path if number == self.state.number else None


@dataclass
class Page:
    """A viewer, and what it has asked for."""

    server: viser.ViserServer
    viewer: Viewer
    commands: list[tuple[str, AnyCommand]] = field(default_factory=list)
    started: list[StartRun] = field(default_factory=list)
    resumed: list[str] = field(default_factory=list)
    exported: list[tuple[str, str, list[str]]] = field(default_factory=list)
    servos: list[str] = field(default_factory=list)
    printers: list[str | None] = field(default_factory=list)
    changed: list[list[float]] = field(default_factory=list)
    """Designs changed by hand that were exported."""
    branched: list[tuple[str, int, list[float]]] = field(default_factory=list)
    answers: Oracle = field(default_factory=Oracle)
    album: Stars = field(default_factory=Stars)
    others: Neighbours = field(default_factory=Neighbours)
    films: Cutter = field(default_factory=Cutter)
    refusal: str | None = None
    family: Member | None = None

    def show(self, folder: RunFolder, status: Status | None = None, message: str = "") -> History:
        history = History(folder)
        state = (status or history.status, message or history.message)
        self.viewer.show({folder.id: history}, {folder.id: state}, folder.id)
        return history

    def take(self, wanted: Callable[[Take], bool] = lambda _: True) -> Take:
        """Return what is on the scene once it is as wanted."""
        take = eventually(lambda: (t := self.viewer.player.take) and wanted(t) and t)
        assert isinstance(take, Take)
        return take


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)

    def heed(ask: Callable[[], None]) -> None:
        if page.refusal:
            raise ValueError(page.refusal)
        ask()

    def start(request: StartRun) -> str:
        heed(lambda: page.started.append(request))
        return NAME

    def export(
        run_id: str,
        which: str,
        formats: Sequence[str] | None,
        phi: list[float] | None,
        servo: str | None,
        printer: str | None,
    ) -> Bundle:
        heed(lambda: page.exported.append((run_id, which, list(formats or []))))
        page.servos += [servo] if servo else []
        page.printers.append(printer)
        page.changed += [phi] if phi is not None else []
        return Bundle("design.zip", {"robot.xml": b"xml", "robot.urdf": b"urdf"}, [Check("masses", 0.0, 0.0)], b"zip")

    def branch(run_id: str, iteration: int, phi: list[float]) -> str:
        heed(lambda: page.branched.append((run_id, iteration, phi)))
        return NAME

    answers, album, others, films = Oracle(), Stars(), Neighbours(), Cutter()
    viewer = Viewer(
        server,
        on_command=lambda run_id, command, _: heed(lambda: page.commands.append((run_id, command))),
        on_start=start,
        on_resume=lambda run_id: heed(lambda: page.resumed.append(run_id)),
        on_branch=branch,
        on_export=export,
        answers=answers,
        family=lambda _: page.family,
        album=album,
        others=others,
        films=films,
        recordings=Recordings(tmp_path / "recordings"),
    )
    page = Page(server, viewer, answers=answers, album=album, others=others, films=films)
    yield page
    viewer.stop()
    server.stop()


@dataclass
class Blackboard:
    """Desks that write down what they are shown; `broken` makes them raise."""

    server: viser.ViserServer
    runs: Runs
    what_ifs: WhatIfs
    shown: list[tuple[list[str], dict[str, tuple[Status, str]], str | None]] = field(default_factory=list)
    turned_to: list[tuple[str, int | None]] = field(default_factory=list)
    broken: bool = False
    selected: frozenset[str] = frozenset()
    views: dict[str, View] = field(default_factory=dict)
    presents: Presenting | None = None
    """The browser that an audience watches."""

    def show(
        self, histories: Mapping[str, History], statuses: Mapping[str, tuple[Status, str]], current: str | None
    ) -> None:
        if self.broken:
            raise RuntimeError("the viewer is broken, says the test")
        self.shown.append((list(histories), dict(statuses), current))

    def turn_to(self, run_id: str, iteration: int | None) -> None:
        self.turned_to.append((run_id, iteration))

    def seen(self, key: str) -> Seen:
        return Seen(**msgspec.structs.asdict(self.views.get(key, View())), connected=key in self.views)

    def put(self, key: str, view: View) -> None:
        self.views[key] = view

    def presenting(self, key: str | None) -> Presenting | None:
        del key
        return self.presents

    def stop(self) -> None:
        self.shown.append(([], {}, None))


@dataclass
class Served:
    """A running server, and a client that knows its token."""

    app: FastAPI
    port: int
    client: httpx.Client
    viewers: list[Blackboard]

    @property
    def viewer(self) -> Blackboard:
        return self.viewers[0]

    @property
    def runs(self) -> Runs:
        return self.app.state.runs


@contextlib.contextmanager
def serving(settings: Settings, spawn: Callable[..., subprocess.Popen[bytes]] = stand_in) -> Iterator[Served]:
    """Serve the real application on a free port; end the stand-ins it has started."""
    viewers: list[Blackboard] = []

    def desks(server: viser.ViserServer, runs: Runs, what_ifs: WhatIfs, *_: object) -> Blackboard:
        viewers.append(Blackboard(server, runs, what_ifs))
        return viewers[0]

    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    app = create_app(settings, runs=Runs(settings.runs, spawn), desks=desks)
    config = uvicorn.Config(
        app, log_level="error", ws_max_size=MAX_MESSAGE, timeout_graceful_shutdown=1, proxy_headers=False
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    assert eventually(lambda: server.started)
    headers = {"Authorization": f"Bearer {TOKEN}"}
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", headers=headers, timeout=120) as client:
            yield Served(app, port, client, viewers)
    finally:
        server.should_exit = True
        thread.join(10)
        end_trainers(settings.runs)


def end_trainers(runs: Path) -> None:
    for name in list_runs(runs):
        beat = RunFolder(runs / name).heartbeat()
        if beat and process_alive(beat.pid, beat.process_started):
            os.kill(beat.pid, signal.SIGKILL)


@pytest.fixture
def runs_folder(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path / "runs"
    end_trainers(tmp_path / "runs")


@pytest.fixture
def settings(runs_folder: Path, tmp_path: Path) -> Settings:
    return Settings(port=0, runs=runs_folder, token=TOKEN, hosts=(), state=tmp_path / "state")


@pytest.fixture
def served(settings: Settings) -> Iterator[Served]:
    with serving(settings) as running:
        yield running


def add_checkpoint(folder: RunFolder, iteration: int) -> None:
    """Give a run the checkpoint of an iteration, with the weights of a policy that has learnt nothing."""
    from morph_core.checkpoint import save_checkpoint  # torch: only where it is needed
    from morph_core.state import start

    record = folder.record()
    task = make_task(record.task, record.task_options)
    state = start(task, read_method(record), 0)
    state.iteration = iteration
    save_checkpoint(folder, state, 0.0)


TINY = {
    "trajectories": 4,
    "ppo": {"epochs": 1, "minibatches": 1},
    "proxy.prefit": 5,
    "search.generations": 2,
    "hidden": 8,
    "evaluation": {"interval": 2, "episodes": 2},
}


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A finished run of four iterations with two checkpoints, steered before the first; nobody changes it."""
    from morph_core.train import Trainer  # torch: only where it is needed

    wish = StartRun(task="reacher", iterations=4, seed=5, settings=TINY, task_options={"tunnel": "paper"})
    folder = prepare_run(tmp_path_factory.mktemp("runs"), wish)
    folder.send(SetAlpha(2.5), "a test")
    folder.send(Lock("link_5", 2.75))
    folder.send(InjectDesign([9.0] * 5))
    Trainer(folder).run()
    (folder.path / "heartbeat.json").unlink()  # it says that this process is the trainer, which others would end
    return folder


@pytest.fixture
def parent(trained: RunFolder, tmp_path: Path) -> RunFolder:
    """A copy of that run in a folder of its own."""
    shutil.copytree(trained.path, tmp_path / "here" / trained.id)
    return RunFolder(tmp_path / "here" / trained.id)
