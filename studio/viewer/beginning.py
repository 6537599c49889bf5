"""How runs begin: the start page with the recorded run that it plays, and what is pressed to start one."""

from collections.abc import Callable

import viser

from morph_core.origin import origin_at
from studio.new_run import StartRun, again
from studio.recordings import Recording, Recordings
from studio.viewer.choice import Choice
from studio.viewer.once import once
from studio.viewer.player import Player
from studio.viewer.recorded import RecordedPanel
from studio.viewer.screen import Screen
from studio.viewer.stage import Stage
from studio.viewer.start import StartPanel
from studio.viewer.timeline import TimelinePanel

TRAIN = "train it live"
"""What the key Enter does in presenter's mode."""


class Beginning:
    """The panels of a new run and of a recorded one; `on_start(request)` starts a run and returns its name, or refuses
    by a ValueError."""

    def __init__(
        self,
        gui: viser.GuiApi,
        choice: Choice,
        screen: Screen,
        recordings: Recordings,
        *,
        on_start: Callable[[StartRun], str],
        on_present: Callable[[], None],
    ) -> None:
        """Make the panels; `on_present` begins presenter's mode."""
        self._choice = choice
        self._screen = screen
        self._on_start = on_start
        self.recordings = recordings
        self.begin_live = once(self.train_live)
        """Does the same once, whether it was a button or the key that was pressed twice."""
        self._wants_film: bool | None = None
        """Whether the start page plays the recorded run; until it was asked, where there is no other run."""
        self.recorded = RecordedPanel(
            gui,
            on_film=self.want_film,
            on_open=lambda _: self.open_recorded(),
            on_live=self.begin_live,
            on_present=lambda _: on_present(),
        )
        self.start = StartPanel(gui, on_start=lambda request, _: self._begin(request), on_preview=screen.refresh)

    # --- what is pressed ---

    def train_live(self, client: viser.ClientHandle | None) -> None:
        """Start what the start panel says, or the run on screen once again, unless it is being trained."""
        history = self._choice.history
        if self._choice.run and (history is None or self._choice.is_live(history)):
            return
        try:
            self._screen.select(self._on_start(again(history.record) if history else self.start.request()))
        except (ValueError, OSError) as error:
            self._screen.refuse(str(error), client)

    def want_film(self, wants: bool) -> None:
        """Play the recorded run on the start page, or show what a new run begins with."""
        self._wants_film = wants
        self._screen.refresh()

    def open_recorded(self) -> None:
        """Open the recorded run of what the start panel says."""
        if recording := self._recording():
            self._screen.select(recording.history.folder.id)

    def open_branch(self, client: viser.ClientHandle | None) -> None:
        """Open the form for a run that begins where the timeline stands."""
        history = self._choice.history
        if history is None:
            self._screen.refuse("there is no run to branch from: start or choose one", client)
            return
        try:
            self.start.branch_from(origin_at(history, self._screen.shown_design(history)[0]))
        except (ValueError, TypeError) as error:
            self._screen.refuse(str(error), client)
            return
        self._screen.select(None)

    def _begin(self, request: StartRun) -> None:
        started = self._on_start(request)
        self.start.branch_from(None)
        self._screen.select(started)

    # --- what is shown ---

    def show(self, stage: Stage, timeline: TimelinePanel, player: Player) -> None:
        """Show the recorded run of the task on the start page, or what a new run begins with."""
        plays = stage.presents or (not self._choice.histories if self._wants_film is None else self._wants_film)
        recording = self._offer(plays) if self._choice.is_told else None
        if recording and plays:
            timeline.clear("a recorded run, from its first iteration to its last")
            stage.play(recording.history, recording.label, TRAIN)
            return
        timeline.clear("what a run begins with, in its start posture")
        stage.clear(enter=TRAIN)
        preview = self.start.preview
        if preview and self._choice.is_told:
            player.show(preview)

    def show_opened(self, run_id: str) -> Recording | None:
        """Say that the run on screen is a recorded one, and return it; None where it is not."""
        recording = self.recordings.get(run_id) if run_id in self.recordings else None
        if recording:
            self.recorded.show_opened(recording)
        else:
            self.recorded.hide()
        return recording

    def _recording(self) -> Recording | None:
        """Return the recorded run of what the start panel says; None where there is none, or a person begins with
        something of their own. Raise RunFolderError where it can't be read."""
        return self.recordings.of(self.start.task.value) if self.start.begins_as_usual else None

    def _offer(self, plays: bool) -> Recording | None:
        """Say on the start page what was recorded of the task, and return it; None where nothing can be played."""
        try:
            recording = self._recording()
        except ValueError as error:
            self.recorded.show_problem(str(error))
            return None
        if recording:
            self.recorded.show_on_start_page(recording, plays=plays)
        else:
            self.recorded.hide()
        return recording
