"""The run panel: how the run is doing, and the buttons that steer it."""

import typing
from collections.abc import Callable, Sequence

import viser

from morph_core.config import Projection, check_field
from morph_core.history import History
from morph_core.protocol import (
    AnyCommand,
    Checkpoint,
    Pause,
    Progress,
    Resume,
    SetAlpha,
    SetProjection,
    Status,
    Step,
    Stop,
)
from studio.viewer import wording

ENDED: tuple[Status, ...] = ("stopped", "finished", "failed", "lost", "unreadable")
RESUMABLE: tuple[Status, ...] = ("stopped", "failed", "lost")
_LOG_LINES = 8

Send = Callable[[Callable[[], Sequence[AnyCommand]], viser.ClientHandle | None], None]
"""Takes what works the commands out, so that a value it refuses is told like any other refusal."""


class RunPanel:
    """Shows one run; `send` takes the commands, `on_resume` restarts a run that has ended."""

    def __init__(
        self, gui: viser.GuiApi, *, send: Send, on_resume: Callable[[viser.ClientHandle | None], None]
    ) -> None:
        self._send = send
        self._on_resume = on_resume
        self._status: Status = "starting"
        self._in_force: tuple[float, str] | None = None
        self.state = gui.add_html("")
        self.failure = gui.add_html("", visible=False)
        self.bar = gui.add_progress_bar(0.0, color="green")
        self.numbers = gui.add_html("")
        self.pause = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE, hint="Hold after this iteration (P)")
        self.resume = gui.add_button("Resume", icon=viser.Icon.PLAYER_PLAY, color="green", hint="Go on (P)")
        self.step = gui.add_button("Step", icon=viser.Icon.PLAYER_TRACK_NEXT, hint="Run one iteration, then hold")
        self.checkpoint = gui.add_button("Checkpoint", icon=viser.Icon.DEVICE_FLOPPY, hint="Save everything now")
        self.stop = gui.add_button(
            "Stop", icon=viser.Icon.PLAYER_STOP, color="red", hint="Save and end the run; it can be resumed"
        )
        self.steering = gui.add_form("Steering")
        with self.steering:
            self.alpha = gui.add_number("α", 1.0, min=0.0, step=0.1, hint="Weight of the divergence in Eq. 2")
            self.projection = gui.add_dropdown("projection", list(typing.get_args(Projection)))
            self.apply = gui.add_button("Apply", icon=viser.Icon.CHECK)
        self.log = gui.add_html("")
        self._everything = (
            self.state, self.bar, self.numbers, self.pause, self.resume, self.step, self.checkpoint, self.stop,
            self.steering, self.log,
        )  # fmt: skip
        self.pause.on_click(lambda event: self._send(lambda: [Pause()], event.client))
        self.resume.on_click(lambda event: self.go_on(event.client))
        self.step.on_click(lambda event: self._send(lambda: [Step()], event.client))
        self.checkpoint.on_click(lambda event: self._send(lambda: [Checkpoint()], event.client))
        self.stop.on_click(lambda event: self._send(lambda: [Stop()], event.client))
        self.apply.on_click(lambda _: self.steering.submit())
        self.steering.on_submit(lambda event: self._send(self.commands, event.client))

    def go_on(self, client: viser.ClientHandle | None) -> None:
        """Resume: by a command to a trainer that waits, by a new trainer where the old one is gone."""
        if self._status in RESUMABLE:
            self._on_resume(client)
        else:
            self._send(lambda: [Resume()], client)

    def toggle(self, client: viser.ClientHandle | None) -> None:
        """Pause what runs, and let go on what doesn't."""
        if self._status in ("running", "starting"):
            self._send(lambda: [Pause()], client)
        elif self._status in ("paused", "pausing", *RESUMABLE):
            self.go_on(client)

    def commands(self) -> list[AnyCommand]:
        """Return what the form changes. Raise ValueError with a sentence if a value is not allowed."""
        alpha, projection = self.alpha.value, self.projection.value
        check_field("alpha", alpha)
        check_field("projection", projection)
        commands: list[AnyCommand] = []
        in_force = self._in_force or (None, None)
        if alpha != in_force[0]:
            commands.append(SetAlpha(alpha))
        if projection != in_force[1]:
            commands.append(SetProjection(projection))
        return commands

    def show_visible(self, visible: bool) -> None:
        for handle in self._everything:
            handle.visible = visible
        if not visible:
            self.failure.visible = False

    def update(self, history: History, status: Status, message: str, pending: Sequence[AnyCommand]) -> None:
        """Show a run. `pending` are commands without an answer yet."""
        self._status = status
        beat = history.heartbeat
        iterations = max(beat.iterations if beat else 0, history.record.iterations, 1)
        self.state.content = self._state(history, status, message, iterations)
        broken = status in ("failed", "lost", "unreadable")
        self.failure.visible = broken
        if broken:
            self.failure.content = wording.alert(f"{status}: {message or 'no reason was recorded'}")
        self.bar.value = min(100.0, 100.0 * history.iteration / iterations)
        self.bar.animated = status in ("starting", "running", "pausing")
        self.bar.color = "red" if broken else "yellow" if status in ("paused", "pausing") else "green"
        self.numbers.content = self._numbers(history)
        self._enable(status)
        self._follow(history)
        self.log.content = self._log(history, status, pending)

    def show_message(self, status: Status, message: str) -> None:
        """Show a run that has no history to show."""
        self._status = status
        self.show_visible(False)
        self.state.visible = self.failure.visible = True
        self.state.content = wording.paragraph(wording.badge(status))
        if status == "unreadable":
            self.failure.content = wording.alert(f"unreadable: {message}")
        else:
            self.failure.content = wording.alert(message or "loading…", wording.BLUE)

    def _state(self, history: History, status: Status, message: str, iterations: int) -> str:
        beat = history.heartbeat
        live = status not in ENDED
        stage = beat.stage if beat and live else ""
        iteration = history.iteration
        eta = f" · {wording.duration(beat.eta_seconds)} left" if beat and beat.eta_seconds and live else ""
        lines = [f"{wording.badge(status)} {wording.text(stage)}"]
        if message and status not in ("failed", "lost", "unreadable"):
            lines.append(wording.text(message))
        lines.append(f"iteration <b>{iteration}</b> of {iterations}{eta}")
        return wording.paragraph("<br>".join(lines))

    def _numbers(self, history: History) -> str:
        progress: Progress | None = history.progress[-1] if history.progress else None
        if progress is None:
            return wording.paragraph(wording.dim("no iteration is done yet"))
        rows = [("environment steps", wording.count(progress.env_steps))]
        if history.evaluations:
            last = history.evaluations[-1]
            rows += [
                ("success on Hw-Phy, sampled", wording.percent(last.sampled_success)),
                ("success on Hw-Phy, deterministic", wording.percent(last.deterministic_success)),
                ("return on Hw-Phy, sampled", f"{last.sampled_return:.3g}"),
            ]
        rows.append(("success while exploring", wording.percent(progress.success)))
        cells = "".join(
            f'<tr><td style="opacity:0.75;padding-right:0.8em">{wording.text(name)}</td>'
            f'<td style="text-align:right;font-variant-numeric:tabular-nums">{wording.text(value)}</td></tr>'
            for name, value in rows
        )
        evaluated = f"evaluated at iteration {history.evaluations[-1].iteration}" if history.evaluations else ""
        return wording.paragraph(f'<table style="width:100%">{cells}</table>{wording.dim(evaluated)}')

    def _enable(self, status: Status) -> None:
        live = status not in ENDED
        self.pause.visible = status not in ("paused", *ENDED)
        self.pause.disabled = status == "pausing"
        self.resume.visible = status in ("paused", "pausing", *RESUMABLE)
        self.step.visible = status == "paused"
        self.checkpoint.visible = self.stop.visible = self.steering.visible = live

    def _follow(self, history: History) -> None:
        """Take over what is in force, unless somebody is editing it."""
        progress = history.progress[-1] if history.progress else None
        config = history.record.config
        alpha = progress.alpha if progress and progress.alpha is not None else config.get("alpha", 1.0)
        projection = progress.projection if progress and progress.projection else config.get("projection", "none")
        in_force = (float(alpha) if isinstance(alpha, int | float) else 1.0, str(projection))
        if in_force != self._in_force:
            self._in_force = in_force
            self.alpha.value = in_force[0]
            if in_force[1] in typing.get_args(Projection):
                self.projection.value = in_force[1]

    def _log(self, history: History, status: Status, pending: Sequence[AnyCommand]) -> str:
        space = history.design_space
        waiting = "" if status in ENDED else "…"
        lines = [wording.dim(f"{wording.text(_asked(c, space))}{waiting}") for c in reversed(pending)]
        for event in reversed(history.acknowledged[-_LOG_LINES:]):
            colour = "inherit" if event.accepted else wording.RED
            sentence = wording.text(wording.acknowledgement(event, space))
            lines.append(f'<span style="color:{colour}">{sentence}</span>')
        return wording.paragraph("<br>".join(lines[:_LOG_LINES])) if lines else ""


def _asked(command: AnyCommand, space: typing.Any) -> str:
    return f"asked: {wording.describe(command, space)}"
