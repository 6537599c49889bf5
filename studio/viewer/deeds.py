"""What the keyboard and the command palette do; the page's help names the keys."""

from collections.abc import Callable

import viser

from studio.viewer.beginning import Beginning
from studio.viewer.choice import Choice
from studio.viewer.export import ExportPanel
from studio.viewer.framing import Framing
from studio.viewer.keys import Deed, Do
from studio.viewer.once import once
from studio.viewer.player import Player
from studio.viewer.run import MORE, RunPanel
from studio.viewer.stage import Stage


def deeds_of(
    choice: Choice,
    beginning: Beginning,
    framing: Framing,
    run: RunPanel,
    export: ExportPanel,
    player: Player,
    stage: Stage,
    *,
    on_new: Callable[[], None],
    on_present: Callable[[bool], None],
) -> list[Deed]:
    """Return the deeds in the palette's order; `on_new` opens the start panel, `on_present` begins or ends presenter's
    mode."""

    def at_a_run(do: Do) -> Do:
        """Return the deed, but nothing where no run is on screen."""
        return lambda client: do(client) if choice.history is not None else None

    def in_presenters_mode(do: Do) -> Do:
        """Return the deed, but nothing where the panels are there."""
        return lambda client: do(client) if stage.presents else None

    icon, timeline, playback, what_if = viser.Icon, framing.timeline, framing.playback, framing.what_if
    return [
        Deed("Play or pause the episode", lambda _: playback.toggle_playback(), ("space", "K"), icon.PLAYER_PLAY),
        Deed("One frame back", lambda _: playback.step(-1), (",",)),
        Deed("One frame on", lambda _: playback.step(1), (".",)),
        Deed("One iteration back", lambda _: timeline.step(-1), ("arrowleft",), icon.ARROW_LEFT),
        Deed("One iteration on", lambda _: timeline.step(1), ("arrowright",), icon.ARROW_RIGHT),
        Deed("Live: follow the latest design", lambda _: timeline.toggle_follow(), ("L",), icon.PLAYER_TRACK_NEXT),
        Deed("Play or pause the evolution", lambda _: timeline.toggle_evolution(), ("E",), icon.MOVIE),
        Deed("Star the shown design", at_a_run(timeline.toggle_star), ("S",), icon.STAR),
        Deed("Branch from the shown iteration", at_a_run(beginning.open_branch), ("B",), icon.GIT_BRANCH),
        Deed("Pause or resume the run", once(at_a_run(run.toggle)), ("P",), icon.PLAYER_PAUSE),
        Deed("New run", lambda _: on_new(), ("N",), icon.PLUS),
        Deed("Presenter's mode", lambda _: on_present(not stage.presents), ("F",), icon.PRESENTATION),
        Deed("Leave presenter's mode", lambda _: on_present(False), ("escape",)),
        Deed("Train live, in presenter's mode", in_presenters_mode(beginning.begin_live), ("enter",)),
        Deed("Show the whole scene", lambda _: player.camera.look_at_all(), ("R",), icon.FOCUS_CENTERED),
        *(Deed(f"{word} the run", at_a_run(lambda client, word=word: run.ask(word, client))) for word in MORE),
        Deed("Continue the run from the shown design", at_a_run(timeline.go_on_from_here)),
        Deed("Change this body: what if", at_a_run(lambda _: what_if.start())),
        Deed("Close what if", lambda _: what_if.close()),
        Deed("Check and prepare the export", at_a_run(lambda _: export.submit())),
    ]
