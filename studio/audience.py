"""The audience: spectators who see what one browser shows, and can do nothing else."""

import logging
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Literal, Protocol

import anyio
import anyio.to_thread
import msgspec
import numpy as np
from viser._messages import (
    SetCameraFovMessage,
    SetCameraLookAtMessage,
    SetCameraPositionMessage,
    SetCameraUpDirectionMessage,
)
from viser.infra import Message

from morph_core.history import History
from studio.desks import Presenting
from studio.invitation import AUDIENCE, Invitation
from studio.seldom import Seldom
from studio.viewer.presented import Presented, curves_of
from studio.viewer.scene import seen_elsewhere
from studio.viewer.scene_copy import SceneCopy, frame_of, removal_of

MOST = 60
"""Largest number of spectators at once."""
MOST_OFFERED = 8
"""Number of runs that spectators may look at by themselves: the last ones that were shown since the link was made."""
SCENES_A_SECOND = 15.0
"""Most often that a spectator's scene is brought up to date; a slow one takes what it can."""
_HALF_A_FRAME = 0.003
"""Seconds until the next look at a scene of which a frame is just being written."""
_WORDS_INTERVAL = 0.2
"""Seconds between two looks at what is said of the scene."""
_CURVES_EVERY = 5
"""Number of those looks between two at the curves."""
_LEFT_AFTER = 3.0
"""Seconds without the presenter's browser after which it is said to have left: a reload takes less."""
_KEEP_ALIVE = 15.0
"""Seconds of silence after which something is sent: proxies cut silent connections."""
FULL = f"{MOST} people are watching already, and there is no place for more. It is tried again by itself."
ENDED = "The presenter has ended this link. Ask for a new one."

Phase = Literal["waiting", "on", "left"]
_log = logging.getLogger(__name__)


class Stage(msgspec.Struct, frozen=True, kw_only=True):
    """What spectators are told."""

    phase: Phase
    """Whether the presenter's browser has not come yet, is there, or has left."""
    watching: int
    seen: Presented
    runs: tuple[str, ...] = ()
    """Runs that a spectator may look at alone: those that were shown since the link was made, the newest first."""


class AudienceState(msgspec.Struct, frozen=True, kw_only=True):
    """The audience as the presenter sees it."""

    open: bool
    """Whether there is a link by which spectators come in."""
    link: str | None = None
    """The link, relative to the address of the studio; None while there is none."""
    presenter: str | None = None
    """Key of the browser that is watched; None for the one that has been there longest."""
    phase: Phase = "waiting"
    watching: int = 0
    most: int = MOST


class Presents(Protocol):
    """What the audience needs of those who show runs to browsers."""

    def presenting(self, key: str | None) -> Presenting | None:
        """Return the browser of this key, by default the one that has been there longest; None where there is none."""
        ...


@dataclass(eq=False)
class Seat:
    """One spectator's page."""

    key: str
    follows: bool = True
    """Whether its camera is the presenter's."""
    aspect: float | None = None
    """Width / height of its scene; None until its browser has told."""
    socket: object = None
    """The websocket that its scene goes to; an earlier one ends."""
    ended: str = ""
    """Why it has been taken away, in words; empty while it has not."""


@dataclass(frozen=True)
class _Pose:
    """Where the presenter's camera stands, and how."""

    position: tuple[float, ...]  # (3,) m
    target: tuple[float, ...]  # (3,) m
    up: tuple[float, ...]  # (3,)
    fov: float
    aspect: float
    """Width / height of the presenter's scene."""

    def seen_by(self, aspect: float) -> list[Message]:
        """Return the messages that point the camera of a spectator whose scene has another shape."""
        position, target = seen_elsewhere(np.array(self.position), np.array(self.target), self.aspect, aspect)
        return [
            SetCameraFovMessage(self.fov),
            SetCameraUpDirectionMessage(_three(self.up)),
            SetCameraPositionMessage(_three(position)),
            SetCameraLookAtMessage(_three(target)),
        ]


class _Bell:
    """A bell that wakes all who wait for it, again and again."""

    def __init__(self) -> None:
        self.next = anyio.Event()

    def ring(self) -> None:
        """Wake all who wait for the next ring."""
        self.next, now = anyio.Event(), self.next
        now.set()


class Audience:
    """The spectators, what they are sent, and the link by which they came.

    It lives in the server's event loop. Each frame of the scene is encoded once, for all who have seen as much before.
    """

    def __init__(self, invitation: Invitation) -> None:
        self._invitation = invitation
        self._seats: dict[str, Seat] = {}
        self._presenter: str | None = None
        self._phase: Phase = "waiting"
        self._gone_since: float | None = None
        self._scene: SceneCopy | None = None
        self._messages: list[tuple[int, Message]] = []
        self._count = 0
        """Number of the newest message of the scene that is sent."""
        self._frames: dict[tuple[int, bool], bytes] = {}
        """What was encoded since the scene has last moved, by how much of it is known and whether it is the first."""
        self._pose: _Pose | None = None
        self._seen = Presented()
        self._stage = b""
        self._curves = b""
        self._curves_of: tuple[str, int] | None = None
        self._offered: tuple[str, ...] = ()
        self._moved, self._said, self._came = _Bell(), _Bell(), _Bell()

    # --- for the presenter ---

    @property
    def state(self) -> AudienceState:
        """Return how the audience is."""
        ticket = self._invitation.ticket
        return AudienceState(
            open=ticket is not None,
            link=f"{AUDIENCE[1:]}?link={ticket}" if ticket else None,
            presenter=self._presenter,
            phase=self._phase,
            watching=len(self._seats),
        )

    def open(self, presenter: str | None = None) -> AudienceState:
        """Let spectators in by a link, a new one where there is none, and let them watch the browser of a key."""
        self._invitation.open()
        if presenter != self._presenter:
            self._presenter, self._phase, self._gone_since = presenter, "waiting", None
        return self.state

    def close(self) -> AudienceState:
        """Void the link, and send all spectators away."""
        self._invitation.revoke()
        self._phase, self._scene, self._messages, self._count, self._pose = "waiting", None, [], 0, None
        self._offered = ()
        self.dismiss(ENDED)
        return self.state

    def dismiss(self, why: str) -> None:
        """Take all seats away."""
        for seat in self._seats.values():
            seat.ended = why
        self._seats.clear()
        self._moved.ring()
        self._said.ring()

    # --- for spectators ---

    @property
    def offered(self) -> tuple[str, ...]:
        """Return the runs that were shown since the link was made, the newest first: others are nobody's business."""
        return self._offered

    def take_seat(self, key: str) -> Seat | None:
        """Return the seat of a page that has come, or has come again; None where there is none left."""
        before = self._seats.pop(key, None)
        if before is None and len(self._seats) >= MOST:
            return None
        if before is not None:
            before.ended = "Your page has come again."
        if not self._seats:
            self._stage = self._curves = b""  # nobody has kept them up to date
            self._curves_of = None
        seat = self._seats[key] = Seat(key)
        for bell in (self._moved, self._said, self._came):
            bell.ring()
        return seat

    def leave(self, seat: Seat) -> None:
        """Give a seat back."""
        if self._seats.get(seat.key) is seat:
            del self._seats[seat.key]
        seat.ended = seat.ended or "Your page has left."
        self._moved.ring()

    def seat(self, key: str) -> Seat | None:
        """Return the seat that a page has taken, or None."""
        return self._seats.get(key)

    def follow(self, seat: Seat, follows: bool) -> None:
        """Let a spectator's camera be the presenter's, or its own."""
        seat.follows = follows
        self._moved.ring()

    def hear(self, seat: Seat, aspect: float) -> None:
        """Take in the shape of a spectator's scene."""
        if seat.aspect is None or abs(aspect - seat.aspect) > 0.01 * seat.aspect:
            seat.aspect = aspect
            self._moved.ring()

    async def words(self, seat: Seat) -> AsyncIterator[bytes]:
        """Yield what is said of the scene as server-sent events, the newest of each kind, until the seat is gone."""
        stage, curves = b"", b""
        yield b"retry: 2000\n\n"
        while not seat.ended:
            following = self._said.next
            if stage != self._stage:
                stage = self._stage
                yield b"event: stage\ndata: %s\n\n" % stage
            if curves != self._curves:
                curves = self._curves
                yield b"event: curves\ndata: %s\n\n" % curves
            with anyio.move_on_after(_KEEP_ALIVE) as waiting:
                await following.wait()
            if waiting.cancelled_caught:
                yield b": still here\n\n"
        yield said("ended", seat.ended)

    async def scenes(self, seat: Seat, socket: object) -> AsyncIterator[bytes]:
        """Yield the frames of the scene for one websocket until its seat is gone, or has another one.

        Whoever takes them slowly gets fewer of them, each with all that has changed.
        """
        seat.socket = socket
        self._moved.ring()  # an earlier one ends
        scene: SceneCopy | None = None
        messages: list[tuple[int, Message]] = []
        known, first, pointed = 0, True, None
        while not seat.ended and seat.socket is socket:
            following = self._moved.next
            if self._scene is not scene:
                if messages:
                    yield frame_of(removal_of(messages))
                scene, known, pointed = self._scene, 0, None
            if scene is not None and known < self._count:
                frame, messages, known = self._frame(known, first), self._messages, self._count
                first = False
                yield frame
                continue  # more may have happened while it was sent
            pose = (self._pose, seat.aspect) if seat.follows and self._pose and seat.aspect else None
            if pose != pointed:
                pointed = pose
                if self._pose is not None and pose is not None and seat.aspect is not None:
                    yield frame_of(self._pose.seen_by(seat.aspect))
                    continue
            await following.wait()

    def _frame(self, known: int, first: bool) -> bytes:
        """Return what has happened since message number `known`."""
        frame = self._frames.get((known, first))
        if frame is None:
            new = [message for count, message in self._messages if count > known]
            frame = self._frames[known, first] = frame_of(new, first=first)
        return frame

    # --- at work ---

    async def run(self, desks: Presents, stopping: anyio.Event) -> None:
        """Watch the presenter's browser for as long as anybody watches it; send all away when the server stops."""
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._watch_scene, desks)
            tasks.start_soon(self._watch_words, desks)
            await stopping.wait()
            self.dismiss("The studio has been stopped.")
            tasks.cancel_scope.cancel()

    async def _somebody(self) -> None:
        while not self._seats:
            await self._came.next.wait()

    async def _watch_scene(self, desks: Presents) -> None:
        trouble = Seldom(_log)
        while True:
            await self._somebody()
            whole = True
            try:
                whole = self._look(desks.presenting(self._presenter))
            except Exception:
                trouble.warn("the scene could not be shown to the audience", traceback=True)
            await anyio.sleep(1 / SCENES_A_SECOND if whole else _HALF_A_FRAME)

    def _look(self, presenting: Presenting | None) -> bool:
        """Take in what is in the presenter's scene; return whether it was whole."""
        self._note(presenting is not None)
        if presenting is None:
            return True
        moved = False
        camera = presenting.client.camera
        places = (tuple(camera.position), tuple(camera.look_at), tuple(camera.up_direction))
        pose = _Pose(*places, float(camera.fov), float(camera.aspect))
        if pose != self._pose:
            self._pose, moved = pose, True
        if presenting.scene is not self._scene or presenting.scene.count != self._count:
            messages = presenting.scene.taken()
            if messages is None:
                return False
            self._scene, self._messages, moved = presenting.scene, messages, True
            self._count = max((count for count, _ in messages), default=0)
            self._frames.clear()
        if moved:
            self._moved.ring()
        return True

    def _note(self, is_there: bool) -> None:
        """Keep in mind whether the presenter's browser is there, and since when it is not."""
        now = anyio.current_time()
        if is_there:
            self._phase, self._gone_since = "on", None
        elif self._gone_since is None:
            self._gone_since = now
        elif self._phase == "on" and now - self._gone_since > _LEFT_AFTER:
            self._phase = "left"

    async def _watch_words(self, desks: Presents) -> None:
        turn, trouble = 0, Seldom(_log)
        while True:
            await self._somebody()
            turn += 1
            try:
                await self._listen(desks.presenting(self._presenter), turn % _CURVES_EVERY == 1)
            except Exception:
                trouble.warn("what is shown could not be said to the audience", traceback=True)
            await anyio.sleep(_WORDS_INTERVAL)

    async def _listen(self, presenting: Presenting | None, with_curves: bool) -> None:
        """Take in what the presenter's browser says of its scene."""
        if self._phase == "waiting":
            self._seen = Presented()
        history: History | None = None
        if presenting is not None:
            self._seen, history = await anyio.to_thread.run_sync(lambda: presenting.viewer.presented)
        if history is not None and self._invitation.ticket:  # the link may have been ended meanwhile
            run = history.folder.id
            self._offered = (run, *(other for other in self._offered if other != run))[:MOST_OFFERED]
        stage = msgspec.json.encode(
            Stage(phase=self._phase, watching=len(self._seats), seen=self._seen, runs=self._offered)
        )
        curves, of = self._curves, (history.folder.id, len(history.evaluations)) if history else None
        if with_curves and presenting is not None and of != self._curves_of:
            curves = msgspec.json.encode(await anyio.to_thread.run_sync(curves_of, history) if history else None)
            self._curves_of = of
        if (stage, curves) != (self._stage, self._curves):
            self._stage, self._curves = stage, curves
            self._said.ring()


def said(event: str, words: str) -> bytes:
    """Return a sentence as a server-sent event."""
    return b"event: %s\ndata: %s\n\n" % (event.encode(), msgspec.json.encode(words))


def _three(values: object) -> tuple[float, float, float]:
    x, y, z = np.asarray(values, float).tolist()
    return x, y, z
