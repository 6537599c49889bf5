"""A viewer for each browser: run, iteration and ticks are its own; what it asks of a run goes to the one run of all."""

import logging
import threading
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import msgspec
import viser

from morph_core.history import History
from morph_core.protocol import Status
from studio.credentials import KEY
from studio.seldom import Seldom
from studio.viewer import wording
from studio.viewer.scene_copy import SceneCopy
from studio.viewer.view import Seen, View
from studio.viewer.viewer import Viewer

MOST = 8
"""Largest number of browsers that are shown runs at once; another one waits until one of them leaves."""
KEPT = 64
"""Largest number of views that are kept for browsers that are not connected."""

log = logging.getLogger(__name__)


@dataclass
class _Desk:
    """One browser: its viewer, None while that is being made, and the run that it begins with."""

    client: viser.ClientHandle
    key: str | None
    scene: SceneCopy
    viewer: Viewer | None = None
    begin: View | None = None
    trouble: Seldom = field(default_factory=lambda: Seldom(log))


@dataclass(frozen=True)
class Presenting:
    """The browser that an audience watches."""

    client: viser.ClientHandle
    viewer: Viewer
    scene: SceneCopy


class Desks:
    """The viewers of all browsers on a viser server. Its methods may be called from any thread."""

    def __init__(self, server: viser.ViserServer, make: Callable[[viser.ClientHandle], Viewer]) -> None:
        """Give each browser that comes a viewer of its own, made by `make`, and end it when the browser leaves."""
        # What is drawn in the moment in which a browser leaves reaches nobody, and viser warns of it.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
        self._make = make
        self._lock = threading.Lock()
        self._desks: dict[int, _Desk] = {}
        self._waiting: dict[int, viser.ClientHandle] = {}
        self._kept: dict[str, View] = {}  # least recently used first
        server.on_client_connect(self._seat)
        server.on_client_disconnect(self._leave)

    @property
    def selected(self) -> frozenset[str]:
        """Return the names of the runs that are on some browser's screen."""
        return frozenset(run for _, viewer in self._seated() for run in viewer.runs_on_screen)

    def show(
        self, histories: Mapping[str, History], statuses: Mapping[str, tuple[Status, str]], current: str | None
    ) -> None:
        """Show every browser the runs as they are now; one that comes without a choice opens the run `current`."""
        for desk, viewer in self._seated():
            try:
                begin, desk.begin = desk.begin, None
                if begin is not None:
                    viewer.put_back(begin if begin.run else msgspec.structs.replace(begin, run=current, iteration=None))
                viewer.show(histories, statuses)
            except Exception:  # one browser's trouble is not another's, and may come again five times a second
                desk.trouble.warn(f"showing the runs to browser {desk.client.client_id} failed", traceback=True)

    def turn_to(self, run_id: str, iteration: int | None) -> None:
        """Let every browser show this run, and the design of an iteration."""
        for _, viewer in self._seated():
            viewer.open(run_id, iteration)

    def seen(self, key: str) -> Seen:
        """Return what the browser of this key shows, or showed last; one that waits counts as connected."""
        with self._lock:
            desk = next((desk for desk in reversed(self._desks.values()) if desk.key == key), None)
            kept = self._kept.get(key, View())
            waiting = list(self._waiting.values())
        begun = desk is not None and desk.viewer is not None and desk.begin is None
        view = desk.viewer.view if desk is not None and desk.viewer is not None and begun else kept
        return Seen(**msgspec.structs.asdict(view), connected=desk is not None or key in map(key_of, waiting))

    def put(self, key: str, view: View) -> None:
        """Let the browser of this key show something, now or as soon as it comes."""
        self._keep(key, view)
        for desk, viewer in self._seated():
            if desk.key == key and desk.begin is not None:
                desk.begin = view  # else what it was to begin with would come after this
            elif desk.key == key:
                viewer.put_back(view)

    def presenting(self, key: str | None) -> Presenting | None:
        """Return the browser of this key, by default the one that has been there longest; None where there is none."""
        seated = self._seated()
        found = seated[:1] if key is None else [one for one in seated if one[0].key == key][-1:]
        return next((Presenting(desk.client, viewer, desk.scene) for desk, viewer in found), None)

    def stop(self) -> None:
        """End all viewers."""
        for _, viewer in self._seated():
            viewer.stop()

    def _seated(self) -> list[tuple[_Desk, Viewer]]:
        with self._lock:
            return [(desk, desk.viewer) for desk in self._desks.values() if desk.viewer is not None]

    def _keep(self, key: str, view: View) -> None:
        with self._lock:
            self._kept.pop(key, None)
            self._kept[key] = view
            while len(self._kept) > KEPT:
                del self._kept[next(iter(self._kept))]

    def _seat(self, client: viser.ClientHandle) -> None:
        """Make the viewer of a browser that has come, or let it wait where there are too many."""
        desk = _Desk(client, key_of(client), SceneCopy(client))
        with self._lock:
            full = len(self._desks) >= MOST
            if full:
                self._waiting[client.client_id] = client
            else:
                self._desks[client.client_id] = desk
        if full:
            client.gui.add_html(wording.alert(f"{MOST} browsers are open already: close one, and this one begins"))
            return
        try:
            viewer = self._make(client)
        except Exception:
            log.exception("the viewer of browser %s could not be made", client.client_id)
            self._leave(client)
            return
        with self._lock:
            desk.begin = self._kept.get(desk.key or "", View())
            desk.viewer = viewer
            left = client.client_id not in self._desks
        if left:
            viewer.stop()

    def _leave(self, client: viser.ClientHandle) -> None:
        """End the viewer of a browser that has gone, and let in one that waits."""
        with self._lock:
            self._waiting.pop(client.client_id, None)
            desk = self._desks.pop(client.client_id, None)
            following = self._waiting.pop(next(iter(self._waiting)), None) if desk and self._waiting else None
        if desk is not None and desk.viewer is not None:
            if desk.key is not None and desk.begin is None:
                self._keep(desk.key, desk.viewer.view)
            desk.viewer.stop()
        if following is not None:
            following.gui.reset()
            self._seat(following)


def key_of(client: viser.ClientHandle) -> str | None:
    """Return the key that came with a browser's websocket, or None.

    viser hands on nothing of a websocket's address; the version is pinned and tests/studio/test_desks.py holds it to
    this.
    """
    connection = client._viser_server._websock_server._live_connections.get(client.client_id)
    key = connection.request.path.partition("?")[2] if connection is not None and connection.request else ""
    return key if KEY.fullmatch(key) else None
