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
from studio.new_run import StartRun
from studio.viewer import wording
from studio.viewer.compare import ComparePanel
from studio.viewer.design import DesignPanel
from studio.viewer.export import ExportPanel
from studio.viewer.legend import legend_of
from studio.viewer.log import LogPanel
from studio.viewer.playback import PlaybackPanel
from studio.viewer.player import Player
from studio.viewer.run import NOT_LIVE, RunPanel
from studio.viewer.scene import light_up
from studio.viewer.start import StartPanel
from studio.viewer.steer import SteerPanel
from studio.viewer.take import Shot
from studio.viewer.timeline import TimelinePanel
from studio.viewer.traces import TracesPanel
from studio.viewer.what_if import Answers, WhatIfPanel

NEW_RUN = "+ new run"
_START_PATIENCE = 15.0
"""Seconds after which a started run that never showed up is reported."""

log = logging.getLogger(__name__)


class Viewer:
    """The panels and the scene on a viser server; `show` is called a few times a second with fresh histories.

    `on_command(run_id, command, sender)`, `on_start(request)` -> run id, `on_resume(run_id)`,
    `on_branch(run_id, iteration, phi)` -> run id and `on_export(run_id, which, formats, phi or None for the recorded
    one)` do what people ask for; they refuse by a ValueError, whose sentence is shown. `answers` say how good a policy
    is on a changed design, and `family(run_id)` is the tree in which a run stands.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        *,
        on_command: Callable[[str, AnyCommand, str], object],
        on_start: Callable[[StartRun], str],
        on_resume: Callable[[str], None],
        on_branch: Callable[[str, int, list[float]], str],
        on_export: Callable[[str, str, Sequence[str] | None, list[float] | None], Bundle],
        answers: Answers,
        family: Callable[[str], Member | None],
    ) -> None:
        self._server = server
        self._on_command = on_command
        self._on_start = on_start
        self._on_resume = on_resume
        self._on_branch = on_branch
        self._on_export = on_export
        self._family = family
        self._tree: tuple[object, Member | None] = (None, None)
        self._lock = threading.RLock()
        self._histories: Mapping[str, History] = {}
        self._statuses: Mapping[str, tuple[Status, str]] = {}
        self._suggested: str | None = None
        self._selected: str | None = None
        self._awaited_since = 0.0
        self._labels: dict[str, str] = {}
        self._pending: dict[str, list[tuple[AnyCommand, int]]] = {}
        gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(47, 127, 209))
        gui.set_panel_label("Run and playback")
        light_up(server)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(350)
        self.chooser = gui.add_dropdown("run", [NEW_RUN], hint="Every run in the runs folder, newest first")
        self.notice = gui.add_html("", visible=False)
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
            self.steer = SteerPanel(gui, send=self._send)
            self.design = DesignPanel(gui, send=self._send)
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
        self.player = Player(server, on_time=self._show_time, on_error=lambda sentence: self.refuse(sentence, None))
        self.timeline = TimelinePanel(gui, on_choice=self._refresh, on_inject=self._inject, on_refusal=self.refuse)
        self.timeline.panel.dock_below(gui.main_panel)
        self.playback = PlaybackPanel(gui, self.player, on_choice=self._refresh, on_refusal=self.refuse)
        self.playback.panel.dock_below(left)
        with self.playback.panel.add_tab("A/B", viser.Icon.ARROWS_LEFT_RIGHT):
            self.compare = ComparePanel(gui, on_choice=self._refresh, on_refusal=self.refuse)
        self._add_commands(gui)
        self.chooser.on_update(lambda event: self._choose(event.client) if event.client else None)
        self._refresh()

    @property
    def selected(self) -> str | None:
        """Return the name of the run on screen, or None while the start panel is there."""
        return self._selected

    def show(
        self, histories: Mapping[str, History], statuses: Mapping[str, tuple[Status, str]], current: str | None
    ) -> None:
        """Show the runs as they are now; whenever `current` changes, the run of that name is opened."""
        with self._lock:
            self._histories, self._statuses = dict(histories), dict(statuses)
            if current != self._suggested:
                self._suggested = current
                if current is not None:
                    self._selected = current
            self._settle_pending()
            self._refresh()

    def turn_to(self, iteration: int) -> None:
        """Show the design of an iteration of the run on screen."""
        with self._lock:
            self.timeline.turn_to(iteration)
            self._refresh()

    def select(self, run_id: str | None) -> None:
        """Open the run of that name, or the start panel if it is None."""
        with self._lock:
            self._selected = run_id
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
        self.player.stop()

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

    def _export(self, which: str, formats: Sequence[str]) -> Bundle:
        run_id = self._selected
        if run_id is None:
            raise ValueError("there is no run to export from: start or choose one")
        return self._on_export(run_id, which, formats, None)

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
            bundle = self._on_export(run_id, str(iteration), None, phi)
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

    def _choose(self, client: viser.ClientHandle | None) -> None:
        chosen = self.chooser.value
        known = {label: run_id for run_id, label in self._labels.items()}
        if chosen != NEW_RUN and chosen not in known:
            self.refuse(f'unknown run "{chosen}"; choose one of the list', client)
            return
        self.start.branch_from(None)
        self.select(None if chosen == NEW_RUN else known[chosen])

    def _add_commands(self, gui: viser.GuiApi) -> None:
        run = gui.add_command("Pause or resume the run", hotkey="P", icon=viser.Icon.PLAYER_PAUSE)
        run.on_trigger(lambda event: self.run.toggle(event.client) if self._selected else None)
        for hotkey in ("space", "K"):
            playback = gui.add_command("Play or pause the episode", hotkey=hotkey, icon=viser.Icon.PLAYER_PLAY)
            playback.on_trigger(lambda _: self.playback.toggle_playback())
        branch = gui.add_command("Branch from the shown iteration", hotkey="B", icon=viser.Icon.GIT_BRANCH)
        branch.on_trigger(lambda event: self._open_branch(event.client) if self._selected else None)
        follow = gui.add_command("Follow the latest design", hotkey="F", icon=viser.Icon.PLAYER_TRACK_NEXT)
        follow.on_trigger(lambda _: self.timeline.toggle_follow())

    # --- what is shown ---

    def _refresh(self) -> None:
        """Bring every panel up to date with the selected run."""
        with self._lock:
            run_id = self._selected
            self._list_runs()
            history = self._histories.get(run_id) if run_id else None
            self.start.folder.visible = run_id is None
            self.tabs.visible = run_id is not None
            if run_id is None or history is None:
                self._show_nothing(run_id)
                return
            status, message = self._statuses.get(run_id, (history.status, history.message))
            live = status not in NOT_LIVE
            pending = [command for command, _ in self._pending.get(run_id, [])]
            self.run.show_visible(True)
            self.run.update(history, status, message, pending)
            self.steer.update(history, status)
            self.design.update(history, status)
            self.export.update(history)
            self.timeline.update(history, live=live, by_hand=self.what_if.is_changed)
            shown, phi = self._shown_design(history)
            self.playback.update(history, shown)
            self.compare.update(self._histories, history, shown)
            self.run.offer_branch(shown)
            self.log.update(history, self._family_of(run_id), self._statuses)
            self.traces.update(history, shown, phi)
            self.what_if.update(history, shown, phi, live=live, following=self.timeline.follow.value)
            self.player.show(self._shot(history, shown, phi))

    def _show_scene(self) -> None:
        """Bring the scene alone up to date, as a body that is dragged must move at once."""
        with self._lock:
            history = self._histories.get(self._selected or "")
            if history is not None:
                self.player.show(self._shot(history, *self._shown_design(history)))

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
        if run_id is None:
            self.traces.clear("no data yet: press Start")
            self.timeline.clear("what a run begins with, in its start posture")
            if preview := self.start.preview:
                self.player.show(preview)
            return
        status, message = self._statuses.get(run_id, ("starting", "starting…"))
        if run_id not in self._statuses and time.monotonic() - self._awaited_since > _START_PATIENCE:
            message = f"{run_id} has not shown up; the studio's log may say why"
        self.run.show_message(status, message)
        self.traces.clear(f"{status}: {message}")
        self.timeline.clear(message)

    def _list_runs(self) -> None:
        ids = {*self._histories, *self._statuses, *([self._selected] if self._selected else [])}
        self._labels = {
            run_id: f"{self._statuses.get(run_id, ('starting', ''))[0]} · {run_id}"
            for run_id in sorted(ids, reverse=True)
        }
        options = (NEW_RUN, *self._labels.values())
        chosen = self._labels[self._selected] if self._selected else NEW_RUN
        if tuple(self.chooser.options) != options:
            self.chooser.options = options
        self.chooser.value = chosen

    def _shown_design(self, history: History) -> tuple[int, np.ndarray]:
        """Return the iteration and phi (d,) that are to be shown."""
        try:
            return history.design(str(self.timeline.shown_iteration))
        except ValueError:  # an iteration that a resume has just voided
            return history.design("latest")

    def _shot(self, history: History, shown: int, phi: np.ndarray) -> Shot:
        recorded = (history.folder, shown) if self.timeline.has_episode else None
        before, name = (tuple(history.initial_phi.tolist()), "initial")
        changed = self.what_if.is_changed
        if changed:
            before, name = tuple(phi.tolist()), "recorded"
        in_front = self.what_if.phi if self.what_if.open else phi
        which = self.playback.which if recorded and not self.what_if.open else None
        second, overlaid = self.compare.second_shot(which, printed=self.timeline.printed.value)
        return Shot(
            task=history.record.task,
            task_options=tuple(sorted(history.record.task_options.items())),
            phi=tuple(in_front.tolist()),
            episode=None if self.what_if.open else recorded,
            which=which,
            forces=self.playback.forces.value,
            played=self.what_if.episode if self.what_if.open else None,
            ghost=before if self.timeline.ghost.value and (changed or shown > history.begins_at or recorded) else None,
            ghost_name=name,
            trail=tuple(self.timeline.earlier(history)),
            printed=self.timeline.printed.value,
            population=self.timeline.population.value,
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
            self.timeline.show_legend(legend_of(take))


def _sender(client: viser.ClientHandle | None) -> str:
    """Return words on who asked for something in the viewer, for the log of a run."""
    return f"studio, browser {client.client_id}" if client is not None else "studio"
