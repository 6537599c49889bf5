"""What people ask of the run on screen, handed on to where it is done; what is refused is said on the page."""

import time
from collections.abc import Callable, Sequence

import viser

from morph_core.protocol import AnyCommand, InjectDesign, StepIteration
from studio.export.bundle import Bundle
from studio.export.design_file import phi_for, read_design
from studio.viewer.choice import Choice
from studio.viewer.gallery import Album
from studio.viewer.once import AGAIN
from studio.viewer.pending import Pending
from studio.viewer.screen import Screen

OnCommand = Callable[[str, AnyCommand, str], object]
OnBranch = Callable[[str, int, list[float]], str]
OnExport = Callable[[str, str, Sequence[str] | None, list[float] | None, str | None, str | None], Bundle]


class Wishes:
    """What the panels of one browser hand on; the functions that take it refuse by a ValueError, whose sentence is
    shown."""

    def __init__(
        self,
        choice: Choice,
        screen: Screen,
        album: Album,
        *,
        on_command: OnCommand,
        on_resume: Callable[[str], None],
        on_branch: OnBranch,
        on_export: OnExport,
    ) -> None:
        """Hand on what is wished of the run that is chosen; `on_command(run_id, command, sender)` and the others do
        it."""
        self._choice = choice
        self._screen = screen
        self._album = album
        self._on_command = on_command
        self._on_resume = on_resume
        self._on_branch = on_branch
        self._on_export = on_export
        self.pending = Pending()
        self._last: tuple[tuple[str, Sequence[AnyCommand]], float] = ("", ()), -AGAIN
        """The commands that were asked for last, those of which run, and when, by the monotonic clock."""

    def send(self, commands: Callable[[], Sequence[AnyCommand]], client: viser.ClientHandle | None) -> None:
        """Send the commands that `commands` makes; none of them if it refuses to make one."""
        run_id = self._choice.run
        if run_id is None:
            self._screen.refuse("there is no run to steer: start or choose one", client)
            return
        history = self._choice.history
        answered = len(history.acknowledged) if history else 0
        try:
            wanted = commands()  # all are checked before the first one leaves
            for command in () if self._is_again(run_id, wanted) else wanted:
                self._on_command(run_id, command, _sender(client))
                self.pending.add(run_id, command, answered)
        except (ValueError, OSError) as error:
            self._screen.refuse(str(error), client)
            return
        self._screen.tell(None if wanted else "nothing was changed: nothing to apply")
        self._screen.refresh()

    def _is_again(self, run_id: str, wanted: Sequence[AnyCommand]) -> bool:
        """Tell whether a double click asks for the last commands once more; every Step counts."""
        before, at = self._last
        self._last = (run_id, wanted), time.monotonic()
        return before == (run_id, wanted) and self._last[1] - at < AGAIN and StepIteration() not in wanted

    def inject(self, phi: Callable[[], list[float]], client: viser.ClientHandle | None) -> None:
        """Let the run go on with the design that `phi` returns."""
        self.send(lambda: [InjectDesign(phi())], client)

    def go_on_from(self, content: bytes, client: viser.ClientHandle | None) -> None:
        """Let the run go on with the design of a design.json or of a bundle."""
        history = self._choice.history

        def command() -> list[AnyCommand]:
            if history is None:
                raise ValueError("there is no run that could go on from it: start or choose one")
            phi = phi_for(read_design(content), history.record.task, history.design_space)
            return [InjectDesign(phi.tolist())]

        self.send(command, client)

    def resume(self, client: viser.ClientHandle | None) -> None:
        """Give the run a trainer again."""
        run_id = self._choice.run
        if run_id is None:
            return
        try:
            self._on_resume(run_id)
        except (ValueError, OSError) as error:
            self._screen.refuse(str(error), client)
        else:
            self._screen.tell(None)

    def branch(self, iteration: int, phi: list[float], client: viser.ClientHandle | None) -> None:
        """Start a branch of the run that goes on from an iteration with a design, and open it."""
        run_id = self._choice.run
        if run_id is None:
            return
        try:
            self._screen.select(self._on_branch(run_id, iteration, phi))
        except (ValueError, OSError) as error:
            self._screen.refuse(str(error), client)

    def star(self, iteration: int, starred: bool, client: viser.ClientHandle | None) -> None:
        """Give the design of an iteration a star, or take it away."""
        if self._choice.run is None:
            return
        try:
            self._album.star(self._choice.run, iteration, starred)
        except (ValueError, OSError) as error:
            self._screen.refuse(str(error), client)
        self._screen.refresh()

    def export(self, which: str, formats: Sequence[str], servo: str | None, printer: str | None) -> Bundle:
        """Return the bundle of a recorded design, or raise ValueError."""
        run_id = self._choice.run
        if run_id is None:
            raise ValueError("there is no run to export from: start or choose one")
        return self._on_export(run_id, which, formats, None, servo, printer)

    def export_changed(self, iteration: int, phi: list[float], client: viser.ClientHandle) -> None:
        """Hand a browser the bundle of a design that was changed by hand."""
        run_id = self._choice.run
        if run_id is None:
            return
        try:
            bundle = self._on_export(run_id, str(iteration), None, phi, None, None)
        except (ValueError, OSError) as error:
            self._screen.refuse(str(error), client)
        else:
            client.send_file_download(bundle.name, bundle.content, save_immediately=True)


def _sender(client: viser.ClientHandle | None) -> str:
    """Return words on who asked for something in the viewer, for the log of a run."""
    return f"studio, browser {client.client_id}" if client is not None else "studio"
