"""What is to be seen of a run, as the panels say: a design, its episode, and what stands beside it."""

from dataclasses import dataclass

import numpy as np

from morph_core.history import History
from studio.viewer.compare import ComparePanel
from studio.viewer.fresh import FreshEpisodes
from studio.viewer.looks import LooksPanel
from studio.viewer.playback import PlaybackPanel
from studio.viewer.player import Player
from studio.viewer.take import Shot
from studio.viewer.timeline import TimelinePanel
from studio.viewer.what_if import WhatIfPanel


@dataclass(frozen=True)
class Framing:
    """The panels that decide what stands in the scene."""

    timeline: TimelinePanel
    playback: PlaybackPanel
    compare: ComparePanel
    looks: LooksPanel
    what_if: WhatIfPanel
    fresh: FreshEpisodes

    def shown_design(self, history: History) -> tuple[int, np.ndarray]:
        """Return the iteration and phi (d,) that are to be shown."""
        try:
            return history.design(str(self.timeline.shown_iteration))
        except ValueError:  # an iteration that a resume has just voided
            return history.design("latest")

    def want_episodes(self, history: History, shown: int) -> None:
        """Ask for an episode of each design on screen of which none was recorded."""
        first = (history, shown) if self.timeline.wants_episode and not self.what_if.open else None
        self.fresh.want([one for one in (first, self.compare.wants_episode) if one is not None])

    def shot(self, history: History, shown: int, phi: np.ndarray) -> Shot:
        """Return what is to be seen of the design phi (d,) of an iteration."""
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

    def doing(self, player: Player) -> str:
        """Return words on what the body in the scene does."""
        if self.what_if.is_changed:
            return "a body changed by hand"
        if self.timeline.evolution.playing:
            return "the evolution of the body, in its start posture"
        beside = ", beside a second design" if self.compare.second_run else ""
        take = player.take
        return ("playing an episode" if take and take.duration else "in its start posture") + beside
