"""The viewer: one page of panels round the scene. It shows runs, and asks for what people want by callbacks."""

import threading
from collections.abc import Callable, Mapping

import numpy as np
import viser

from morph_core.history import History
from morph_core.protocol import Status
from studio.branches import Member
from studio.new_run import StartRun
from studio.recordings import Recordings
from studio.viewer import wording
from studio.viewer.beginning import TRAIN, Beginning
from studio.viewer.choice import Choice
from studio.viewer.compare import ComparePanel, Others
from studio.viewer.deeds import deeds_of
from studio.viewer.design import DesignPanel
from studio.viewer.export import ExportPanel
from studio.viewer.filming import FilmPanel, Makes
from studio.viewer.framing import Framing
from studio.viewer.fresh import FreshEpisodes
from studio.viewer.gallery import Album, GalleryPanel
from studio.viewer.keys import Deed, add_deeds
from studio.viewer.legend import legend_of
from studio.viewer.log import LogPanel
from studio.viewer.looks import LooksPanel
from studio.viewer.news import News
from studio.viewer.playback import PlaybackPanel
from studio.viewer.player import Player
from studio.viewer.presented import Presented, presented, title_of
from studio.viewer.run import RunPanel
from studio.viewer.scene import Host, clients_of, light_up
from studio.viewer.stage import Stage
from studio.viewer.steer import SteerPanel
from studio.viewer.timeline import TimelinePanel
from studio.viewer.traces import TracesPanel
from studio.viewer.view import Remembered, View, put_back, ticks_of
from studio.viewer.what_if import Answers, WhatIfPanel
from studio.viewer.wishes import OnBranch, OnCommand, OnExport, Wishes

_BODY_FIRST = 0.2
"""Longest time in seconds for which the panels wait until the body of another design stands in the scene."""


class Viewer:
    """The panels and the scene of one browser, or of all that a viser server has; `show` is called a few times a second
    with fresh histories.

    `on_command(run_id, command, sender)`, `on_start(request)` -> run id, `on_resume(run_id)`,
    `on_branch(run_id, iteration, phi)` -> run id and `on_export(run_id, which, formats, phi or None for the recorded
    one, servo or None, printer or None)` do what people ask for; they refuse by a ValueError, whose sentence is shown.
    `answers` say how good a policy is on a changed design, `family(run_id)` is the tree in which a run stands, `album`
    has pictures and stars, `others` are all runs that a design may be compared with, `films` makes films of them, and
    `recordings` are those that come with the studio.
    """

    def __init__(
        self,
        host: Host,
        *,
        on_command: OnCommand,
        on_start: Callable[[StartRun], str],
        on_resume: Callable[[str], None],
        on_branch: OnBranch,
        on_export: OnExport,
        answers: Answers,
        family: Callable[[str], Member | None],
        album: Album,
        others: Others,
        films: Makes,
        recordings: Recordings,
    ) -> None:
        self._host = host
        self._album = album
        self._turns = 0
        self._lock = threading.RLock()
        self._is_built = False
        """Whether all panels are there: what a browser says before changes nothing on screen."""
        self.choice = Choice()
        self.wishes = Wishes(
            self.choice, self, album,
            on_command=on_command, on_resume=on_resume, on_branch=on_branch, on_export=on_export,
        )  # fmt: skip
        gui = host.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(47, 127, 209))
        gui.set_panel_label("Run and playback")
        light_up(host)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(350)
        self.notice = gui.add_html("", visible=False)
        self.beginning = Beginning(
            gui, self.choice, self, recordings, on_start=on_start, on_present=lambda: self.present(True)
        )
        self.recorded, self.start = self.beginning.recorded, self.beginning.start
        self.tabs = gui.add_tab_group()
        with self.tabs.add_tab("Run", viser.Icon.ACTIVITY):
            self.run = RunPanel(
                gui, send=self.wishes.send, on_resume=self.wishes.resume, on_branch=self.beginning.open_branch
            )
        with self.tabs.add_tab("Log", viser.Icon.HISTORY):
            self.log = LogPanel(gui, on_open=self.select, family=family)
        with self.tabs.add_tab("Export", viser.Icon.DOWNLOAD):
            self.export = ExportPanel(gui, on_export=self.wishes.export, on_import=self.wishes.go_on_from)
            self.film = FilmPanel(gui, self.export.ways, films, which=self.export.which)
        left = gui.add_panel()
        left.dock_left()
        left.set_width(390)
        self.traces = TracesPanel(gui, left.add_tab("Traces", viser.Icon.CHART_LINE))
        with left.add_tab("Steer", viser.Icon.ADJUSTMENTS):
            ways = gui.add_tab_group()
            with ways.add_tab("Bounds and locks", viser.Icon.LOCK):
                self.design = DesignPanel(gui, send=self.wishes.send)
            with ways.add_tab("Algorithm", viser.Icon.MATH_FUNCTION):
                self.steer = SteerPanel(gui, send=self.wishes.send)
        gallery = left.add_tab("Gallery", viser.Icon.PHOTO)
        self.gallery = GalleryPanel(gui, gallery, album, on_turn=self._turn_to)
        with left.add_tab("What if", viser.Icon.HAND_MOVE):
            self.what_if = WhatIfPanel(
                gui,
                answers=answers,
                on_open=lambda: self.timeline.hold(),
                on_change=self._show_scene,
                on_inject=self.wishes.inject,
                on_branch=self.wishes.branch,
                on_export=self.wishes.export_changed,
                on_refusal=self.refuse,
                turn=self._lock,
            )
        self.fresh = FreshEpisodes(answers, on_news=self.refresh)
        self.player = Player(host, on_time=self._show_time, on_error=lambda sentence: self.refuse(sentence, None))
        self.stage = Stage(host, self.player, usual_speed=lambda: self.playback.speed.value)
        self.timeline = TimelinePanel(
            gui,
            on_choice=self._turn,
            on_move=self._show_scene,
            on_inject=self.wishes.inject,
            on_star=self.wishes.star,
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
        self.looks = LooksPanel(gui, look, on_choice=self.refresh)
        self.timeline.panel.dock_below(gui.main_panel)
        self.framing = Framing(self.timeline, self.playback, self.compare, self.looks, self.what_if, self.fresh)
        add_deeds(gui, self._deeds())
        self._news = News()
        self._is_built = True
        self.refresh()

    @property
    def selected(self) -> str | None:
        """Return the name of the run on screen, or None while the start panel is there."""
        return self.choice.run

    @property
    def runs_on_screen(self) -> frozenset[str]:
        """Return the names of the run on screen and of the one that it is compared with."""
        return frozenset(run for run in (self.choice.run, self.compare.second_run) if run is not None)

    def show(
        self,
        histories: Mapping[str, History],
        statuses: Mapping[str, tuple[Status, str]],
        current: str | None = None,
    ) -> None:
        """Show the runs as they are now; whenever `current` changes, the run of that name is opened."""
        with self._lock:
            self.choice.take_in(histories, statuses, current)
            self.wishes.pending.settle(histories)
            self.refresh()
        for piece in self._news.look(histories, statuses):
            for client in clients_of(self._host):
                client.add_notification(piece.title, piece.sentence, color=piece.colour, auto_close_seconds=15.0)

    def turn_to(self, iteration: int) -> None:
        """Show the design of an iteration of the run on screen, now or as soon as the run is known."""
        with self._lock:
            self.choice.sought = iteration
            self.refresh()

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
                status = self.choice.status_of(film[0])[0]
                return presented(*film, status, self._labelled(film[0], "its evolution in short"), self.player), film[0]
            history = self.choice.history
            if history is None:
                shot = self.player.take.shot if self.player.take else None
                title = title_of(shot.task, shot.options) if shot else ""
                return Presented(title=title, doing="a new run is being prepared" if shot else ""), None
            shown, doing = self.shown_design(history)[0], self.framing.doing(self.player)
            status = self.choice.status_of(history)[0]
            return presented(history, shown, status, self._labelled(history, doing), self.player), history

    def _labelled(self, history: History, words: str) -> str:
        """Return words on what is seen of a run, after those that stand wherever a recorded run is seen."""
        run_id, recordings = history.folder.id, self.beginning.recordings
        return f"{recordings.get(run_id).label} · {words}" if run_id in recordings else words

    @property
    def view(self) -> View:
        """Return what is seen, as it can be put back."""
        held, sought = self.choice.run is not None and not self.timeline.follow.value, self.choice.sought
        shown = sought if sought is not None else self.timeline.shown_iteration if held else None
        ticks = ticks_of(self._remembered) | self.player.camera.ticks
        return View(run=self.choice.run, iteration=shown, ticks=ticks, presents=self.stage.presents)

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
            self.refresh()

    def select(self, run_id: str | None) -> None:
        """Open the run of that name, or the start panel if it is None."""
        with self._lock:
            self.choice.choose(run_id)
            self.tell(None)
            self.refresh()

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

    def _deeds(self) -> list[Deed]:
        return deeds_of(
            self.choice, self.beginning, self.framing, self.run, self.export, self.player, self.stage,
            on_new=lambda: self.open(None), on_present=self.present,
        )  # fmt: skip

    # --- what is shown ---

    def refresh(self) -> None:
        """Bring every panel up to date with the selected run."""
        if not self._is_built:
            return
        with self._lock:
            history = self.choice.history
            self.start.folder.visible = self.choice.run is None
            self.tabs.visible = self.timeline.panel.visible = self.choice.run is not None  # the form needs the room
            if history is None:
                self._show_nothing()
            else:
                self._show_run(history)

    def _show_run(self, history: History) -> None:
        run_id, live = history.folder.id, self.choice.is_live(history)
        status, message = self.choice.status_of(history)
        self.run.show_visible(True)
        self.run.update(history, status, message, self.wishes.pending.of(run_id))
        recording = self.beginning.show_opened(run_id)
        self.run.branch.visible = recording is None
        self.steer.update(history, status)
        self.design.update(history, status)
        self.export.update(history)
        self.film.update(history)
        self._show_timeline(history, live)
        self.looks.update(history)
        self.gallery.update(history)
        shown, phi = self.shown_design(history)
        self.framing.want_episodes(history, shown)
        self.playback.update(history, shown)
        self.compare.update(self.choice.histories, history, shown)
        self.run.offer_branch(shown)
        self.log.update(history, self.choice.statuses)
        self.traces.update(history, shown, phi)
        self.what_if.update(history, shown, phi, live=live, following=self.timeline.follow.value)
        label = recording.label if recording else f"{run_id}: {status}"
        enter = "" if live else TRAIN
        if self.stage.presents and not live and history.progress:
            self.stage.play(history, label, enter)
        elif self.stage.presents or recording:
            self.stage.show(history, shown, label, enter)
        else:
            self.stage.clear()
        self._show_scene()

    def _show_timeline(self, history: History, live: bool) -> None:
        """Show the timeline, and turn it to the iteration that is sought."""
        starred, instead = self._album.starred(history), self.what_if.instead
        self.timeline.update(history, live=live, starred=starred, instead=instead)
        if self.choice.sought is not None:
            self.timeline.turn_to(self.choice.sought)
            self.choice.sought = None
            self.timeline.update(history, live=live, starred=starred, instead=instead)

    def _turn(self) -> None:
        """Show another design: first the body, as a person waits for that, then all that is said of it."""
        if not self._is_built:
            return
        self._turns += 1
        turn = self._turns
        self._show_scene()
        self.player.wait(_BODY_FIRST)
        if turn == self._turns:  # else a newer choice brings the panels up to date
            self.refresh()

    def _turn_to(self, iteration: int) -> None:
        self.timeline.turn_to(iteration)
        self._turn()

    def _show_scene(self) -> None:
        """Bring the scene alone up to date, as a body that is dragged must move at once."""
        with self._lock:
            history = self.choice.history
            if history is not None and not self.stage.plays_film:
                self.player.show(self.framing.shot(history, *self.shown_design(history)))

    def _show_nothing(self) -> None:
        """Show the start panel, or why a run can't be shown."""
        for panel in (self.steer, self.design, self.export, self.film, self.what_if, self.compare, self.looks):
            panel.clear()
        self.gallery.clear()
        self.fresh.want([])
        if self.choice.run is None:
            self.traces.clear("no data yet: press Start")
            self.beginning.show(self.stage, self.timeline, self.player)
            return
        self.recorded.hide()
        if self.choice.is_gone and self.choice.sought is None and not self.timeline.follow.value:
            self.choice.sought = self.timeline.shown_iteration  # for when it comes back
        status, message = self.choice.missing
        self.stage.clear(f"{self.choice.run}: {status}")
        self.run.show_message(status, message)
        self.traces.clear(f"{status}: {message}")
        self.timeline.clear(message)

    def shown_design(self, history: History) -> tuple[int, np.ndarray]:
        """Return the iteration and phi (d,) that are to be shown."""
        return self.framing.shown_design(history)

    def _show_time(self, seconds: float, _duration: float) -> None:
        if take := self.player.take:
            self.playback.show_time(take, seconds)
            legend = legend_of(take)
            self.timeline.show_legend(legend)
            self.start.show_legend(legend)
