"""The run panel: how the run is doing, and the buttons that steer it."""

from collections.abc import Callable, Sequence

import viser

from morph_core.edits import TAKES_LATER_EDITS
from morph_core.history import History
from morph_core.protocol import (
    AnyCommand,
    Checkpoint,
    Kill,
    Pause,
    Progress,
    Resume,
    Status,
    StepIteration,
    Stop,
)
from studio.log import acknowledgement, describe
from studio.overdue import kill_is_offered
from studio.viewer import wording
from studio.viewer.once import once
from studio.viewer.rules import rules_of

NOT_LIVE: tuple[Status, ...] = ("queued", "stopped", "finished", "failed", "lost", "unreadable")
OBEYED_LATER = "What is applied now is obeyed when the run is resumed (Run tab), before it goes on."
RESUMABLE: tuple[Status, ...] = ("stopped", "failed", "lost")
_LOG_LINES = 8
_UNREADABLE = "Put back the file from a copy, or delete the run on the page of all runs; the others are not concerned."
MORE: dict[str, AnyCommand] = {"Step": StepIteration(), "Checkpoint": Checkpoint(), "Stop": Stop()}

Send = Callable[[Callable[[], Sequence[AnyCommand]], viser.ClientHandle | None], None]
"""Function send(make_commands, client), which calls make_commands(); a ValueError from it is shown like any refusal."""


class RunPanel:
    """The panel of one run; `send` is called with the commands, `on_resume` restarts a run that has ended, and
    `on_branch` opens the form for a new run that begins where the timeline stands."""

    def __init__(
        self,
        gui: viser.GuiApi,
        *,
        send: Send,
        on_resume: Callable[[viser.ClientHandle | None], None],
        on_branch: Callable[[viser.ClientHandle | None], None],
    ) -> None:
        self._send = send
        self._on_resume = on_resume
        self._status: Status = "starting"
        self.state = gui.add_html("")
        self.failure = gui.add_html("", visible=False)
        self.bar = gui.add_progress_bar(0.0, color="green")
        self.pause = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE, hint="Hold after this iteration (P)")
        self.resume = gui.add_button("Resume", icon=viser.Icon.PLAYER_PLAY, color="green", hint="Go on (P)")
        self.more = gui.add_button_group(
            "run", tuple(MORE), hint="Step: one iteration, then hold. Stop: save and end; it can be resumed."
        )
        self.kill = gui.add_button(
            "Kill", icon=viser.Icon.SKULL, color="red", visible=False,
            hint="End it at once, without a checkpoint: what came after the newest one is done again",
        )  # fmt: skip
        self.numbers = gui.add_html("")
        self.branch = gui.add_button(
            "Branch from here", icon=viser.Icon.GIT_BRANCH, color="gray",
            hint="A new run that goes on from the iteration that the timeline shows, with other bounds or settings (B)",
        )  # fmt: skip
        self.log = gui.add_html("")
        self.rules = gui.add_html("")
        self._always = self.state, self.bar, self.numbers, self.branch, self.log, self.rules
        self._at_times = self.failure, self.pause, self.resume, self.more, self.kill
        self.pause.on_click(lambda event: self._send(lambda: [Pause()], event.client))
        self.resume.on_click(once(lambda event: self.go_on(event.client)))
        self.kill.on_click(lambda event: self._send(lambda: [Kill()], event.client))
        self.branch.on_click(lambda event: on_branch(event.client))
        self.more.on_click(lambda event: self.ask(event.target.value, event.client))

    def offer_branch(self, iteration: int) -> None:
        """Say on the button from which iteration a branch would begin."""
        self.branch.label = f"Branch from here (iteration {iteration})"

    def go_on(self, client: viser.ClientHandle | None) -> None:
        """Resume the run: by a command if its trainer waits, with a new trainer if the old one is gone."""
        if self._status in RESUMABLE:
            self._on_resume(client)
        else:
            self._send(lambda: [Resume()], client)

    def toggle(self, client: viser.ClientHandle | None) -> None:
        """Pause the run while it is running, else resume it."""
        if self._status in ("running", "starting"):
            self._send(lambda: [Pause()], client)
        elif self._status in ("paused", "pausing", *RESUMABLE):
            self.go_on(client)

    def ask(self, word: str, client: viser.ClientHandle | None) -> None:
        """Send the command of the button that bears this word."""
        if word in MORE:
            self._send(lambda: [MORE[word]], client)

    def show_visible(self, visible: bool) -> None:
        """Show what is there in every state of a run, or hide everything; `update` shows the rest."""
        for handle in self._always if visible else (*self._always, *self._at_times):
            handle.visible = visible

    def update(self, history: History, status: Status, message: str, pending: Sequence[AnyCommand]) -> None:
        """Show a run. `pending` are commands without an answer yet."""
        self._status = status
        self.state.content = self._state(history, status, message)
        broken = status in ("failed", "lost", "unreadable")
        self.failure.visible = broken
        if broken:
            self.failure.content = wording.alert(f"{status}: {message or 'no reason was recorded'}")
        self.bar.value = min(100.0, 100.0 * history.iteration / max(1, history.planned_iterations or 0))
        self.bar.animated = status in ("starting", "running", "pausing")
        self.bar.color = "red" if broken else "yellow" if status in ("paused", "pausing") else "green"
        self.numbers.content = self._numbers(history)
        self._enable(status)
        self.kill.visible = status not in NOT_LIVE and kill_is_offered(history.folder)
        self.log.content = log_of(history, status, pending)
        rules = "<br>".join(wording.text(line) for line in rules_of(history))
        self.rules.content = wording.paragraph(wording.dim(rules))

    def show_message(self, status: Status, message: str) -> None:
        """Show the status of a run that has no history to show, and the reason."""
        self._status = status
        self.show_visible(False)
        self.state.visible = self.failure.visible = True
        self.state.content = wording.paragraph(wording.badge(status))
        if status == "unreadable":
            self.failure.content = wording.alert(f"unreadable: {message}. {_UNREADABLE}")
        else:
            self.failure.content = wording.alert(message or "loading…", wording.BLUE)

    def _state(self, history: History, status: Status, message: str) -> str:
        beat = history.heartbeat
        live = status not in NOT_LIVE
        stage = beat.stage if beat and live and beat.stage != status else ""
        planned = history.planned_iterations
        eta = (
            f" · {wording.duration(beat.eta_seconds)} left" if beat and beat.eta_seconds and status == "running" else ""
        )
        lines = [f"{wording.badge(status)} {wording.text(stage)}"]
        if message and status not in ("failed", "lost", "unreadable"):
            lines.append(wording.text(message))
        if history.other_processor:
            lines.append(f'<span style="color:{wording.AMBER}">{wording.text(history.other_processor)}</span>')
        of = f" of {'about ' * (live and history.record.env_steps is not None)}{planned}" if planned else ""
        lines.append(f"iteration <b>{history.iteration}</b>{of}{eta}")
        return wording.paragraph("<br>".join(lines))

    def _numbers(self, history: History) -> str:
        progress: Progress | None = history.progress[-1] if history.progress else None
        if progress is None:
            return wording.paragraph(wording.dim("no iteration is done yet"))
        return wording.rows(
            [
                *_of_hw_phy(history),
                ("success while exploring", wording.percent(progress.success)),
                ("environment steps", _steps(progress, history.record.env_steps)),
                *_costs(progress),
            ]
        )

    def _enable(self, status: Status) -> None:
        live = status not in NOT_LIVE
        self.pause.visible = status not in ("paused", *NOT_LIVE)
        self.pause.disabled = status == "pausing"
        self.resume.visible = status in ("paused", "pausing", *RESUMABLE)
        self.more.visible = live or status == "queued"


def _of_hw_phy(history: History) -> list[tuple[str, str]]:
    """Return what the last evaluation on Hw-Phy found, as names and values."""
    if not history.evaluations:
        return []
    last = history.evaluations[-1]
    failed = [("diverged in this evaluation", f"{last.diverged} episodes")] if last.diverged else []
    return [
        (f"success on Hw-Phy (iteration {last.iteration}), sampled", wording.percent(last.sampled_success)),
        ("deterministic", wording.percent(last.deterministic_success)),
        *((f"{name}, sampled", wording.percent(share)) for name, share in last.milestones.items()),
        *failed,
    ]


def _steps(progress: Progress, budget: int | None) -> str:
    """Return the environment steps so far, and of how many."""
    return wording.count(progress.env_steps) + (f" of {wording.count(budget)}" if budget is not None else "")


def _costs(progress: Progress) -> list[tuple[str, str]]:
    """Return what else was spent so far, and what was lost, as names and values."""
    costs = []
    if progress.relabelled_steps:
        costs.append(("steps for relabelling", wording.count(progress.relabelled_steps)))
    if progress.search_steps:
        costs.append(("steps for the search", wording.count(progress.search_steps)))
    if progress.diverged:
        costs.append(("episodes left out: diverged", wording.count(progress.diverged)))
    return costs


def log_of(history: History, status: Status, pending: Sequence[AnyCommand]) -> str:
    """Return what became of the latest commands, newest first, as HTML; `pending` ones have no answer yet."""
    space = history.design_space
    waiting = "no answer before the run ended" if status in NOT_LIVE else "asked…"
    if status in TAKES_LATER_EDITS:
        waiting = "waits: obeyed once the run is resumed"
    lines = [wording.dim(f"{wording.text(describe(c, space))}: {waiting}") for c in reversed(pending)]
    for event in reversed(history.acknowledged[-_LOG_LINES:]):
        colour = "inherit" if event.accepted else wording.RED
        sentence = wording.text(acknowledgement(event, space))
        lines.append(f'<span style="color:{colour}">{sentence}</span>')
    return wording.paragraph("<br>".join(lines[:_LOG_LINES])) if lines else ""
