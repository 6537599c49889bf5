"""The viewer: one page of panels round the scene. It shows runs, and asks for what people want by callbacks."""

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import viser

from morph_core.history import History
from morph_core.origin import origin_at
from morph_core.protocol import AnyCommand, InjectDesign, Status
from studio.branches import Member
from studio.export.bundle import Bundle
from studio.export.design_file import phi_for, read_design
from studio.new_run import StartRun, again
from studio.recordings import Recording, Recordings
from studio.viewer import wording
from studio.viewer.compare import ComparePanel, Others
from studio.viewer.design import DesignPanel
from studio.viewer.export import ExportPanel
from studio.viewer.fresh import FreshEpisodes
from studio.viewer.gallery import Album, GalleryPanel
from studio.viewer.keys import Deed, Do, add_deeds
from studio.viewer.legend import legend_of
from studio.viewer.log import LogPanel
from studio.viewer.looks import LooksPanel
from studio.viewer.news import News
from studio.viewer.playback import PlaybackPanel
from studio.viewer.player import Player
from studio.viewer.presented import Presented, presented, title_of
from studio.viewer.recorded import RecordedPanel
from studio.viewer.run import MORE, NOT_LIVE, RunPanel
from studio.viewer.scene import Host, clients_of, light_up
from studio.viewer.stage import Stage
from studio.viewer.start import StartPanel
from studio.viewer.steer import SteerPanel
from studio.viewer.take import Shot
from studio.viewer.timeline import TimelinePanel
from studio.viewer.traces import TracesPanel
from studio.viewer.view import Remembered, View, put_back, ticks_of
from studio.viewer.what_if import Answers, WhatIfPanel

_START_PATIENCE = 5.0
"""Seconds after which a run that has not shown up is reported: one that was started is there at once."""
_BODY_FIRST = 0.2
"""Longest time in seconds for which the panels wait until the body of another design stands in the scene."""

_TRAIN = "train it live"
_GONE = "Choose another run, or bring this one back on the page of all runs: then it is shown again."

log = logging.getLogger(__name__)


class Viewer:
    """The panels and the scene of one browser, or of all that a viser server has; `show` is called a few times a second
    with fresh histories.

    `on_command(run_id, command, sender)`, `on_start(request)` -> run id, `on_resume(run_id)`,
    `on_branch(run_id, iteration, phi)` -> run id and `on_export(run_id, which, formats, phi or None for the recorded
    one, servo or None, printer or None)` do what people ask for; they refuse by a ValueError, whose sentence is shown.
    `answers` say how good a policy is on a changed design, `family(run_id)` is the tree in which a run stands, `album`
    has pictures and stars, `others` are all runs that a design may be compared with, and `recordings` those that come
    with the studio.
    """

    def __init__(
        self,
        host: Host,
        *,
        on_command: Callable[[str, AnyCommand, str], object],
        on_start: Callable[[StartRun], str],
        on_resume: Callable[[str], None],
        on_branch: Callable[[str, int, list[float]], str],
        on_export: Callable[[str, str, Sequence[str] | None, list[float] | None, str | None, str | None], Bundle],
        answers: Answers,
        family: Callable[[str], Member | None],
        album: Album,
        others: Others,
        recordings: Recordings,
    ) -> None:
        self._host = host
        self._recordings = recordings
        self._wants_film: bool | None = None
        """Whether the start page plays the recorded run; until it was asked, where there is no other run."""
        self._on_command = on_command
        self._on_start = on_start
        self._on_resume = on_resume
        self._on_branch = on_branch
        self._on_export = on_export
        self._family = family
        self._album = album
        self._tree: tuple[object, Member | None] = (None, None)
        self._turns = 0
        self._is_told = False
        """Whether the viewer has been told of the runs: until then nobody knows what is to be seen."""
        self._known: set[str] = set()
        self._lock = threading.RLock()
        self._is_built = False
        """Whether all panels are there: what a browser says before changes nothing on screen."""
        self._histories: Mapping[str, History] = {}
        self._statuses: Mapping[str, tuple[Status, str]] = {}
        self._suggested: str | None = None
        self._sought: int | None = None
        self._selected: str | None = None
        self._awaited_since = 0.0
        self._pending: dict[str, list[tuple[AnyCommand, int]]] = {}
        gui = host.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(47, 127, 209))
        gui.set_panel_label("Run and playback")
        light_up(host)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(350)
        self.notice = gui.add_html("", visible=False)
        self.recorded = RecordedPanel(
            gui,
            on_film=self._want_film,
            on_open=self._open_recorded,
            on_live=self._train_live,
            on_present=lambda _: self.present(True),
        )
        self.start = StartPanel(gui, on_start=self._start, on_preview=self._refresh)
        self.tabs = gui.add_tab_group()
        with self.tabs.add_tab("Run", viser.Icon.ACTIVITY):
            self.run = RunPanel(gui, send=self._send, on_resume=self._resume, on_branch=self._open_branch)
        with self.tabs.add_tab("Log", viser.Icon.HISTORY):
            self.log = LogPanel(gui, on_open=self.select)
        with self.tabs.add_tab("Export", viser.Icon.DOWNLOAD):
            self.export = ExportPanel(gui, on_export=self._export, on_import=self._import)
        left = gui.add_panel()
        left.dock_left()
        left.set_width(390)
        self.traces = TracesPanel(gui, left.add_tab("Traces", viser.Icon.CHART_LINE))
        with left.add_tab("Steer", viser.Icon.ADJUSTMENTS):
            ways = gui.add_tab_group()
            with ways.add_tab("Bounds and locks", viser.Icon.LOCK):
                self.design = DesignPanel(gui, send=self._send)
            with ways.add_tab("Algorithm", viser.Icon.MATH_FUNCTION):
                self.steer = SteerPanel(gui, send=self._send)
        gallery = left.add_tab("Gallery", viser.Icon.PHOTO)
        self.gallery = GalleryPanel(gui, gallery, album, on_turn=self._turn_to)
        with left.add_tab("What if", viser.Icon.HAND_MOVE):
            self.what_if = WhatIfPanel(
                gui,
                answers=answers,
                on_open=lambda: self.timeline.hold(),
                on_change=self._show_scene,
                on_inject=self._inject,
                on_branch=self._branch,
                on_export=self._export_changed,
                on_refusal=self.refuse,
            )
        self.fresh = FreshEpisodes(answers, on_news=self._refresh)
        self.player = Player(host, on_time=self._show_time, on_error=lambda sentence: self.refuse(sentence, None))
        self.stage = Stage(host, self.player, usual_speed=lambda: self.playback.speed.value)
        self.timeline = TimelinePanel(
            gui,
            on_choice=self._turn,
            on_move=self._show_scene,
            on_inject=self._inject,
            on_star=self._star,
            on_refusal=self.refuse,
            unrecorded=self.fresh.words,
        )
        self.playback = PlaybackPanel(gui, self.player, on_choice=self._turn, on_refusal=self.refuse)
        self.playback.panel.dock_below(left)
        with self.timeline.panel.add_tab("A/B", viser.Icon.ARROWS_LEFT_RIGHT):
            self.compare = ComparePanel(
                gui, others=others, fresh=self.fresh, on_choice=self._turn, on_refusal=self.refuse
            )
        look = self.timeline.panel.add_tab("Look", viser.Icon.PALETTE)
        self.looks = LooksPanel(gui, look, on_choice=self._refresh)
        self.timeline.panel.dock_below(gui.main_panel)
        add_deeds(gui, self._deeds())
        self._news = News()
        self._is_built = True
        self._refresh()

    @property
    def selected(self) -> str | None:
        """Return the name of the run on screen, or None while the start panel is there."""
        return self._selected

    @property
    def runs_on_screen(self) -> frozenset[str]:
        """Return the names of the run on screen and of the one that it is compared with."""
        return frozenset(run for run in (self._selected, self.compare.second_run) if run is not None)

    def show(
        self,
        histories: Mapping[str, History],
        statuses: Mapping[str, tuple[Status, str]],
        current: str | None = None,
    ) -> None:
        """Show the runs as they are now; whenever `current` changes, the run of that name is opened."""
        with self._lock:
            self._histories, self._statuses, self._is_told = dict(histories), dict(statuses), True
            self._known |= self._histories.keys()
            if current != self._suggested:
                self._suggested = current
                if current is not None:
                    self._selected = current
            self._settle_pending()
            self._refresh()
        for piece in self._news.look(self._histories, self._statuses):
            for client in clients_of(self._host):
                client.add_notification(piece.title, piece.sentence, color=piece.colour, auto_close_seconds=15.0)

    def turn_to(self, iteration: int) -> None:
        """Show the design of an iteration of the run on screen, now or as soon as the run is known."""
        with self._lock:
            self._sought = iteration
            self._refresh()

    def open(self, run_id: str | None, iteration: int | None = None) -> None:
        """Open the run of that name, or the start panel if it is None, and show the design of an iteration."""
        with self._lock:
            self.start.branch_from(None)
            self.select(run_id)
            if iteration is not None:
                self.turn_to(iteration)

    @property
    def presented(self) -> tuple[Presented, History | None]:
        """Return what is shown, for those who only look, and the run that is, if one is."""
        with self._lock:
            film = self.stage.film
            if film is not None:
                status = self._statuses.get(film[0].folder.id, (film[0].status, ""))[0]
                return presented(*film, status, self._labelled(film[0], "its evolution in short"), self.player), film[0]
            history = self._histories.get(self._selected or "")
            if history is None:
                shot = self.player.take.shot if self.player.take else None
                title = title_of(shot.task, shot.options) if shot else ""
                return Presented(title=title, doing="a new run is being prepared" if shot else ""), None
            status, _ = self._statuses.get(history.folder.id, (history.status, ""))
            shown = self._shown_design(history)[0]
            return presented(history, shown, status, self._labelled(history, self._doing), self.player), history

    def _labelled(self, history: History, words: str) -> str:
        """Return words on what is seen of a run, after those that stand wherever a recorded run is seen."""
        run_id = history.folder.id
        return f"{self._recordings.get(run_id).label} · {words}" if run_id in self._recordings else words

    @property
    def _doing(self) -> str:
        """Return words on what the body in the scene does."""
        if self.what_if.is_changed:
            return "a body changed by hand"
        if self.timeline.evolution.playing:
            return "the evolution of the body, in its start posture"
        beside = ", beside a second design" if self.compare.second_run else ""
        take = self.player.take
        return ("playing an episode" if take and take.duration else "in its start posture") + beside

    @property
    def view(self) -> View:
        """Return what is seen, as it can be put back."""
        held = self._selected is not None and not self.timeline.follow.value
        shown = self._sought if self._sought is not None else self.timeline.shown_iteration if held else None
        ticks = ticks_of(self._remembered) | self.player.camera.ticks
        return View(run=self._selected, iteration=shown, ticks=ticks, presents=self.stage.presents)

    def put_back(self, view: View) -> None:
        """Show what `view` says."""
        with self._lock:
            put_back(self._remembered, view.ticks)
            self.player.camera.put_back(view.ticks)
            self.present(view.presents)
            self.open(view.run, view.iteration)

    def present(self, presents: bool) -> None:
        """Begin presenter's mode, in which the page shows the scene alone under large words, or leave it."""
        with self._lock:
            self.stage.present(presents)
            self._refresh()

    def select(self, run_id: str | None) -> None:
        """Open the run of that name, or the start panel if it is None."""
        with self._lock:
            self._selected, self._sought = run_id, None
            self._awaited_since = time.monotonic()
            self.tell(None)
            self._refresh()

    def refuse(self, sentence: str, client: viser.ClientHandle | None) -> None:
        """Say why something was not done, to the one who asked and above the panels."""
        self.tell(sentence)
        if client is not None:
            client.add_notification("Not done", sentence, color="red", auto_close_seconds=10.0)

    def tell(self, sentence: str | None) -> None:
        """Show a sentence above the panels; None takes the last one away."""
        self.notice.visible = sentence is not None
        self.notice.content = wording.alert(sentence) if sentence else ""

    def stop(self) -> None:
        """End the viewer's threads; the server is left to whoever started it."""
        self.what_if.stop()
        self.fresh.stop()
        self.stage.stop()
        self.timeline.stop()
        self.gallery.stop()
        self.player.stop()

    @property
    def _remembered(self) -> dict[str, Remembered]:
        """The inputs whose values are a person's habits, by the names under which they are kept."""
        panels = self.timeline, self.looks, self.playback, self.what_if
        return {name: handle for panel in panels for name, handle in panel.remembered.items()}

    # --- what people ask for ---

    def _send(self, commands: Callable[[], Sequence[AnyCommand]], client: viser.ClientHandle | None) -> None:
        run_id = self._selected
        if run_id is None:
            self.refuse("there is no run to steer: start or choose one", client)
            return
        history = self._histories.get(run_id)
        answered = len(history.acknowledged) if history else 0
        try:
            wanted = commands()  # all are checked before the first one leaves
            for command in wanted:
                self._on_command(run_id, command, _sender(client))
                with self._lock:
                    self._pending.setdefault(run_id, []).append((command, answered))
        except (ValueError, OSError) as error:
            self.refuse(str(error), client)
            return
        self.tell(None if wanted else "nothing was changed: nothing to apply")
        self._refresh()

    def _start(self, request: StartRun, client: viser.ClientHandle | None) -> None:
        del client
        started = self._on_start(request)
        self.start.branch_from(None)
        self.select(started)

    def _train_live(self, client: viser.ClientHandle | None) -> None:
        """Start what the start panel says, or the run on screen once again, unless it is being trained."""
        history = self._histories.get(self._selected or "")
        if self._selected and (history is None or self._is_live(history)):
            return
        try:
            self.select(self._on_start(again(history.record) if history else self.start.request()))
        except (ValueError, OSError) as error:
            self.refuse(str(error), client)

    def _want_film(self, wants: bool) -> None:
        with self._lock:
            self._wants_film = wants
            self._refresh()

    def _open_recorded(self, client: viser.ClientHandle | None) -> None:
        recording = self._recording_of_start()
        if recording:
            self.select(recording.history.folder.id)

    def _open_branch(self, client: viser.ClientHandle | None) -> None:
        """Open the form for a run that begins where the timeline stands."""
        history = self._histories.get(self._selected or "")
        if history is None:
            self.refuse("there is no run to branch from: start or choose one", client)
            return
        try:
            self.start.branch_from(origin_at(history, self._shown_design(history)[0]))
        except (ValueError, TypeError) as error:
            self.refuse(str(error), client)
            return
        self.select(None)

    def _resume(self, client: viser.ClientHandle | None) -> None:
        run_id = self._selected
        if run_id is None:
            return
        try:
            self._on_resume(run_id)
        except (ValueError, OSError) as error:
            self.refuse(str(error), client)
        else:
            self.tell(None)

    def _inject(self, phi: Callable[[], list[float]], client: viser.ClientHandle | None) -> None:
        self._send(lambda: [InjectDesign(phi())], client)

    def _star(self, iteration: int, starred: bool, client: viser.ClientHandle | None) -> None:
        if self._selected is None:
            return
        try:
            self._album.star(self._selected, iteration, starred)
        except (ValueError, OSError) as error:
            self.refuse(str(error), client)
        self._refresh()

    def _export(self, which: str, formats: Sequence[str], servo: str | None, printer: str | None) -> Bundle:
        run_id = self._selected
        if run_id is None:
            raise ValueError("there is no run to export from: start or choose one")
        return self._on_export(run_id, which, formats, None, servo, printer)

    def _branch(self, iteration: int, phi: list[float], client: viser.ClientHandle | None) -> None:
        run_id = self._selected
        if run_id is None:
            return
        try:
            self.select(self._on_branch(run_id, iteration, phi))
        except (ValueError, OSError) as error:
            self.refuse(str(error), client)

    def _export_changed(self, iteration: int, phi: list[float], client: viser.ClientHandle) -> None:
        run_id = self._selected
        if run_id is None:
            return
        try:
            bundle = self._on_export(run_id, str(iteration), None, phi, None, None)
        except (ValueError, OSError) as error:
            self.refuse(str(error), client)
        else:
            client.send_file_download(bundle.name, bundle.content, save_immediately=True)

    def _import(self, content: bytes, client: viser.ClientHandle | None) -> None:
        history = self._histories.get(self._selected or "")

        def command() -> list[AnyCommand]:
            if history is None:
                raise ValueError("there is no run that could go on from it: start or choose one")
            phi = phi_for(read_design(content), history.record.task, history.design_space)
            return [InjectDesign(phi.tolist())]

        self._send(command, client)

    def _deeds(self) -> list[Deed]:
        """Return what the command palette offers; the page's help names the keys."""
        icon, timeline, playback = viser.Icon, self.timeline, self.playback
        return [
            Deed("Play or pause the episode", lambda _: playback.toggle_playback(), ("space", "K"), icon.PLAYER_PLAY),
            Deed("One frame back", lambda _: playback.step(-1), (",",)),
            Deed("One frame on", lambda _: playback.step(1), (".",)),
            Deed("One iteration back", lambda _: timeline.step(-1), ("arrowleft",), icon.ARROW_LEFT),
            Deed("One iteration on", lambda _: timeline.step(1), ("arrowright",), icon.ARROW_RIGHT),
            Deed("Live: follow the latest design", lambda _: timeline.toggle_follow(), ("L",), icon.PLAYER_TRACK_NEXT),
            Deed("Play or pause the evolution", lambda _: timeline.toggle_evolution(), ("E",), icon.MOVIE),
            Deed("Star the shown design", self._at_a_run(timeline.toggle_star), ("S",), icon.STAR),
            Deed("Branch from the shown iteration", self._at_a_run(self._open_branch), ("B",), icon.GIT_BRANCH),
            Deed("Pause or resume the run", self._at_a_run(self.run.toggle), ("P",), icon.PLAYER_PAUSE),
            Deed("New run", lambda _: self.open(None), ("N",), icon.PLUS),
            Deed("Presenter's mode", lambda _: self.present(not self.stage.presents), ("F",), icon.PRESENTATION),
            Deed("Leave presenter's mode", lambda _: self.present(False), ("escape",)),
            Deed("Train live, in presenter's mode", self._in_presenters_mode(self._train_live), ("enter",)),
            Deed("Show the whole scene", lambda _: self.player.camera.look_at_all(), ("R",), icon.FOCUS_CENTERED),
            *(
                Deed(f"{word} the run", self._at_a_run(lambda client, word=word: self.run.ask(word, client)))
                for word in MORE
            ),
            Deed("Continue the run from the shown design", self._at_a_run(timeline.go_on_from_here)),
            Deed("Change this body: what if", self._at_a_run(lambda _: self.what_if.start())),
            Deed("Close what if", lambda _: self.what_if.close()),
            Deed("Check and prepare the export", self._at_a_run(lambda _: self.export.submit())),
        ]

    def _at_a_run(self, do: Do) -> Do:
        """Return the deed, but nothing where no run is on screen."""
        return lambda client: do(client) if self._selected in self._histories else None

    def _in_presenters_mode(self, do: Do) -> Do:
        """Return the deed, but nothing where the panels are there."""
        return lambda client: do(client) if self.stage.presents else None

    # --- what is shown ---

    def _refresh(self) -> None:
        """Bring every panel up to date with the selected run."""
        if not self._is_built:
            return
        with self._lock:
            run_id = self._selected
            history = self._histories.get(run_id) if run_id else None
            self.start.folder.visible = run_id is None
            self.tabs.visible = self.timeline.panel.visible = run_id is not None  # the form needs the room
            if run_id is None or history is None:
                self._show_nothing(run_id)
                return
            status, message = self._statuses.get(run_id, (history.status, history.message))
            live = self._is_live(history)
            recording = self._recordings.get(run_id) if run_id in self._recordings else None
            pending = [command for command, _ in self._pending.get(run_id, [])]
            self.run.show_visible(True)
            self.run.update(history, status, message, pending)
            self.run.branch.visible = recording is None
            if recording:
                self.recorded.show_opened(recording)
            else:
                self.recorded.hide()
            self.steer.update(history, status)
            self.design.update(history, status)
            self.export.update(history)
            starred = self._album.starred(history)
            by_hand = self.what_if.is_changed
            self.timeline.update(history, live=live, starred=starred, by_hand=by_hand)
            if self._sought is not None:
                self.timeline.turn_to(self._sought)
                self._sought = None
                self.timeline.update(history, live=live, starred=starred, by_hand=by_hand)
            self.looks.update(history)
            self.gallery.update(history)
            shown, phi = self._shown_design(history)
            self._want_episodes(history, shown)
            self.playback.update(history, shown)
            self.compare.update(self._histories, history, shown)
            self.run.offer_branch(shown)
            self.log.update(history, self._family_of(run_id), self._statuses)
            self.traces.update(history, shown, phi)
            self.what_if.update(history, shown, phi, live=live, following=self.timeline.follow.value)
            label = recording.label if recording else f"{run_id}: {status}"
            enter = "" if live else _TRAIN
            if self.stage.presents and not live and history.progress:
                self.stage.play(history, label, enter)
            elif self.stage.presents or recording:
                self.stage.show(history, shown, label, enter)
            else:
                self.stage.clear()
            self._show_scene()

    def _turn(self) -> None:
        """Show another design: first the body, as a person waits for that, then all that is said of it."""
        if not self._is_built:
            return
        self._turns += 1
        turn = self._turns
        self._show_scene()
        self.player.wait(_BODY_FIRST)
        if turn == self._turns:  # else a newer choice brings the panels up to date
            self._refresh()

    def _turn_to(self, iteration: int) -> None:
        self.timeline.turn_to(iteration)
        self._turn()

    def _show_scene(self) -> None:
        """Bring the scene alone up to date, as a body that is dragged must move at once."""
        with self._lock:
            history = self._histories.get(self._selected or "")
            if history is not None and not self.stage.plays_film:
                self.player.show(self._shot(history, *self._shown_design(history)))

    def _is_live(self, history: History) -> bool:
        status, _ = self._statuses.get(history.folder.id, (history.status, ""))
        return status not in NOT_LIVE

    def _recording_of_start(self) -> Recording | None:
        """Return the recorded run of what the start panel says; None where there is none, or a person begins with
        something of their own. Raise RunFolderError where it can't be read."""
        return self._recordings.of(self.start.task.value) if self.start.begins_as_usual else None

    def _family_of(self, run_id: str) -> Member | None:
        """Return the tree in which a run stands, found anew whenever another run is shown or runs come or go."""
        known = run_id, tuple(self._histories)
        if self._tree[0] != known:
            self._tree = known, self._family(run_id)
        return self._tree[1]

    def _show_nothing(self, run_id: str | None) -> None:
        """Show the start panel, or why a run can't be shown."""
        self.steer.clear()
        self.design.clear()
        self.export.clear()
        self.what_if.clear()
        self.compare.clear()
        self.looks.clear()
        self.gallery.clear()
        self.fresh.want([])
        if run_id is None:
            self.traces.clear("no data yet: press Start")
            self._show_beginning()
            return
        self.recorded.hide()
        status, message = self._statuses.get(run_id, ("starting", "starting…"))
        self.stage.clear(f"{run_id}: {status}")
        if run_id in self._known and run_id not in self._statuses:
            if self._sought is None and not self.timeline.follow.value:
                self._sought = self.timeline.shown_iteration  # for when it comes back
            status, message = "lost", f"{run_id} is no longer in the folder of runs: it was deleted or moved. {_GONE}"
        elif run_id not in self._statuses and time.monotonic() - self._awaited_since > _START_PATIENCE:
            status = "lost"
            message = f"{run_id} has not shown up in the folder of runs: it was deleted or moved. {_GONE}"
        self.run.show_message(status, message)
        self.traces.clear(f"{status}: {message}")
        self.timeline.clear(message)

    def _show_beginning(self) -> None:
        """Show the recorded run of the task on the start page, or what a new run begins with."""
        recording = self._offer_recording() if self._is_told else None
        if recording and self._plays_film:
            self.timeline.clear("a recorded run, from its first iteration to its last")
            self.stage.play(recording.history, recording.label, _TRAIN)
            return
        self.timeline.clear("what a run begins with, in its start posture")
        self.stage.clear(enter=_TRAIN)
        preview = self.start.preview
        if preview and self._is_told:
            self.player.show(preview)

    @property
    def _plays_film(self) -> bool:
        """Whether the start page plays the recorded run: where there is no other one, until a person says so."""
        return self.stage.presents or (not self._histories if self._wants_film is None else self._wants_film)

    def _offer_recording(self) -> Recording | None:
        """Say on the start page what was recorded of the task, and return it; None where nothing can be played."""
        try:
            recording = self._recording_of_start()
        except ValueError as error:
            self.recorded.show_problem(str(error))
            return None
        if recording:
            self.recorded.show_on_start_page(recording, plays=self._plays_film)
        else:
            self.recorded.hide()
        return recording

    def _shown_design(self, history: History) -> tuple[int, np.ndarray]:
        """Return the iteration and phi (d,) that are to be shown."""
        try:
            return history.design(str(self.timeline.shown_iteration))
        except ValueError:  # an iteration that a resume has just voided
            return history.design("latest")

    def _want_episodes(self, history: History, shown: int) -> None:
        """Ask for an episode of each design on screen of which none was recorded."""
        first = (history, shown) if self.timeline.wants_episode and not self.what_if.open else None
        self.fresh.want([one for one in (first, self.compare.wants_episode) if one is not None])

    def _shot(self, history: History, shown: int, phi: np.ndarray) -> Shot:
        recorded = (history.folder, shown) if self.timeline.plays(shown) else None  # the slider may have gone on since
        before, name = (tuple(history.initial_phi.tolist()), "initial")
        changed = self.what_if.is_changed
        if changed:
            before, name = tuple(phi.tolist()), "recorded"
        in_front = self.what_if.phi if self.what_if.open else phi
        which = self.playback.which(history, shown) if recorded and not self.what_if.open else None
        fresh = self.fresh.of(history, shown) if self.timeline.wants_episode else None
        second, overlaid = self.compare.second_shot(which, printed=self.looks.printed.value)
        return Shot(
            task=history.record.task,
            task_options=tuple(sorted(history.record.task_options.items())),
            phi=tuple(in_front.tolist()),
            episode=None if self.what_if.open else recorded,
            which=which,
            forces=self.playback.forces.value,
            played=self.what_if.episode if self.what_if.open else fresh,
            ghost=before if self.looks.ghost.value and (changed or shown > history.begins_at or recorded) else None,
            ghost_name=name,
            printed=self.looks.printed.value,
            tint=self.looks.tint(history, shown, in_front),
            beside=self.looks.beside(history, shown),
            second=second,
            overlaid=overlaid,
        )

    def _settle_pending(self) -> None:
        """Forget the commands that were answered."""
        for run_id, pending in self._pending.items():
            history = self._histories.get(run_id)
            if history is None:
                continue
            open_ones = []
            answers = [(i, event.command) for i, event in enumerate(history.acknowledged)]
            for command, asked_at in pending:
                answer = next(((i, c) for i, c in answers if i >= asked_at and c == command), None)
                if answer:
                    answers.remove(answer)
                else:
                    open_ones.append((command, asked_at))
            self._pending[run_id] = open_ones

    def _show_time(self, seconds: float, _duration: float) -> None:
        if take := self.player.take:
            self.playback.show_time(take, seconds)
            legend = legend_of(take)
            self.timeline.show_legend(legend)
            self.start.show_legend(legend)


def _sender(client: viser.ClientHandle | None) -> str:
    """Return words on who asked for something in the viewer, for the log of a run."""
    return f"studio, browser {client.client_id}" if client is not None else "studio"
