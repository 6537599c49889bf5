"""Fresh episodes: an iteration of which none was recorded has one run anew, once a person stays at it."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from morph_core.history import History
from studio.cancellation import Cancellation
from studio.evaluator import EvaluatorError
from studio.viewer.newest import Newest
from studio.viewer.what_if import Answers
from studio.what_if import Wish, policy_note

_REST = 0.4
"""Seconds for which the timeline has to rest before an episode is run."""
_KEPT = 16
"""Largest number of episodes that are kept, so that going back and forth runs few of them."""

Place = tuple[str, int, tuple[float, ...]]
"""Run, iteration and design: a run that went on from an earlier checkpoint has had two designs at one iteration."""


@dataclass(frozen=True)
class _Found:
    """What is seen at an iteration in words, and its episode as the bytes of an npz file; None where there is none."""

    words: str
    episode: bytes | None = None


class FreshEpisodes:
    """Episodes of the policy of an iteration on its design, on Hw-Phy. Its methods may be called from any thread."""

    def __init__(self, answers: Answers, *, on_news: Callable[[], None]) -> None:
        """Run nothing yet; `on_news` is called when an episode is there, or the reason why there is none."""
        self._answers = answers
        self._on_news = on_news
        self._lock = threading.Lock()
        self._known: OrderedDict[Place, _Found] = OrderedDict()
        self._wanted: list[Place] = []
        self._running = Newest("fresh-episodes", _REST)

    def want(self, wanted: Sequence[tuple[History, int]]) -> None:
        """Run an episode of each iteration that has none so far, and give up those that nobody wants any more."""
        places = [_place(history, iteration) for history, iteration in wanted]
        with self._lock:
            if places == self._wanted:
                return
            self._wanted = places
            for place in [place for place, found in self._known.items() if found.episode is None]:
                del self._known[place]  # what has kept an episode from being run may be over
            missing = [one for one, place in zip(wanted, places, strict=True) if place not in self._known]
        if missing:
            self._running.put(lambda cancellation: self._run(missing, cancellation))
        else:
            self._running.cancel()

    def of(self, history: History, iteration: int) -> bytes | None:
        """Return the episode of an iteration as the bytes of an npz file; None where there is none so far."""
        with self._lock:
            found = self._known.get(_place(history, iteration))
        return found.episode if found else None

    def words(self, history: History, iteration: int) -> str:
        """Return in words what is seen at an iteration of which no episode was recorded."""
        place = _place(history, iteration)
        with self._lock:
            found, awaited = self._known.get(place), place in self._wanted
        if found:
            return found.words
        if awaited:
            return "in its start posture: no episode was recorded, so one is being run"
        recorded = [e.iteration for e in history.evaluations if e.episode]
        nearest = min(recorded, key=lambda i: abs(i - iteration), default=None)
        hint = " yet" if nearest is None else f" (the nearest one is of iteration {nearest})"
        return f"in its start posture: no episode was recorded{hint}"

    def stop(self) -> None:
        """End the thread that waits for episodes."""
        self._running.stop()

    def _run(self, missing: Sequence[tuple[History, int]], cancellation: Cancellation) -> None:
        for history, iteration in missing:
            place = _place(history, iteration)
            wish = Wish(design=str(iteration), phi=list(place[2]), episodes=1)
            try:
                note = policy_note(iteration, history.folder.checkpoint_up_to(iteration))
                words = f"playing an episode that was run just now: none was recorded{note and f'; {note}'}"
                self._answers.evaluate(
                    history, wish, cancellation, lambda e, p=place, w=words: self._keep(p, _Found(w, e), cancellation)
                )
            except (ValueError, OSError, EvaluatorError) as error:
                words = f"in its start posture: no episode was recorded, and none can be run: {error}"
                self._keep(place, _Found(words), cancellation)

    def _keep(self, place: Place, found: _Found, cancellation: Cancellation) -> None:
        with self._lock:
            cancellation.check()
            self._known[place] = found
            if len(self._known) > _KEPT:
                self._known.popitem(last=False)
        self._on_news()


def _place(history: History, iteration: int) -> Place:
    return history.folder.id, iteration, tuple(history.design(str(iteration))[1].tolist())
