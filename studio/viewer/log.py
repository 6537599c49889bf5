"""The log panel: what was done to a run, and the tree of runs that were branched from one another."""

import time
from collections.abc import Callable, Mapping

import viser

from morph_core.history import History
from morph_core.protocol import Status
from studio.branches import Member, place_in_words
from studio.log import LogEntry, log_of
from studio.viewer import wording
from studio.viewer.links import Links

_MOST = 100
"""Largest number of lines that are shown of a log."""
_LINK = "text-decoration:underline;text-decoration-color:#8888;text-underline-offset:0.2em"


class LogPanel:
    """The tree and the log of one run; `on_open` is called with the name of a run of the tree that was clicked on."""

    def __init__(
        self, gui: viser.GuiApi, *, on_open: Callable[[str], None], family: Callable[[str], Member | None]
    ) -> None:
        """Make the panel; `family(run_id)` returns the tree in which a run stands, None if it has no relatives."""
        self._on_open = on_open
        self._find_family = family
        self._found: tuple[object, Member | None] = (None, None)
        self._shown: tuple[str, int] = ("", -1)
        self._relatives: list[str] = []
        self.tree = gui.add_html("")
        self._links = Links(gui, self._open)
        self.log = gui.add_html("")

    def update(self, history: History, statuses: Mapping[str, tuple[Status, str]]) -> None:
        """Show the tree in which a run stands, if it has relatives, and its log; `statuses` are those of all runs."""
        name = history.folder.id
        family = self._family(name, frozenset(statuses))
        self._relatives = [run for run in _names(family) if run != name] if family else []
        self._links.offer(self._relatives)
        content = _heading("Branches") + (
            self._tree(family, name, statuses)
            if family
            else wording.paragraph(wording.dim("No run was branched from this one yet, and it is no branch itself."))
        )
        if content != self.tree.content:
            self.tree.content = content
        if self._shown != (name, len(history.events)):
            self._shown = name, len(history.events)
            self.log.content = _heading("Log, newest first") + _log(log_of(history))

    def _family(self, run_id: str, runs: frozenset[str]) -> Member | None:
        """Return the tree in which a run stands, found anew whenever another run is shown or runs come or go."""
        if self._found[0] != (run_id, runs):
            self._found = (run_id, runs), self._find_family(run_id)
        return self._found[1]

    def _tree(self, root: Member, current: str, statuses: Mapping[str, tuple[Status, str]]) -> str:
        """Return a tree as HTML: each run under the one that it was branched from, the current one marked, each other
        one a link."""

        def named(member: Member) -> str:
            name = wording.text(member.run)
            if member.run in self._relatives:
                return self._links.link(self._relatives.index(member.run), name, f"open {member.run}", _LINK)
            return f'<b style="color:{wording.BLUE}">{name}</b>' if member.run == current else name

        def lines(member: Member) -> str:
            status, _ = statuses.get(member.run, ("", ""))
            said = " · ".join(word for word in (place_in_words(member), status) if word)
            below = "".join(f"<li>{lines(child)}</li>" for child in member.children)
            stem = f'<ul style="{_STEM}">{below}</ul>' if below else ""
            return f"{named(member)}<br>{wording.dim(wording.text(said))}{stem}"

        return wording.paragraph(lines(root))

    def _open(self, place: int) -> None:
        if place < len(self._relatives):
            self._on_open(self._relatives[place])


def _heading(words: str) -> str:
    return wording.paragraph(f"<b>{words}</b>")


def _names(member: Member) -> list[str]:
    """Return the runs of a tree that are in this folder, from the oldest ancestor down."""
    here = [member.run] if member.here else []
    return here + [name for child in member.children for name in _names(child)]


_STEM = "list-style:none;margin:0.25em 0 0 0.3em;padding-left:0.8em;border-left:2px solid #8888"


def _log(entries: list[LogEntry]) -> str:
    """Return a log as HTML, newest line first."""
    if not entries:
        return wording.paragraph(wording.dim("Nothing was done yet."))
    lines = [_line(entry) for entry in entries[: -_MOST - 1 : -1]]
    rest = len(entries) - len(lines)
    older = wording.dim(f"and {rest} older ones: morph-studio log RUN prints them") if rest else ""
    return wording.paragraph("".join(lines) + older)


def _line(entry: LogEntry) -> str:
    when = time.strftime("%d %b %H:%M:%S", time.localtime(entry.time))
    words = wording.text(entry.words)
    if entry.undone:
        words = f"<s>{words}</s> {wording.dim('undone: the trainer went on from before it')}"
    elif not entry.accepted:
        words = f'<span style="color:{wording.RED}">{words}</span>'
    said = " · ".join(wording.text(word) for word in (f"iteration {entry.iteration}", when, entry.sender) if word)
    return f'<div style="margin-bottom:0.45em">{words}<br>{wording.dim(said)}</div>'
