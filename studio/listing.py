"""The runs of one folder as they are listed: a line for each, what each has come to, and what people have noted."""

import contextlib
from collections.abc import Collection, Mapping
from pathlib import Path

import msgspec

from morph_core.protocol import Evaluation, Parent
from morph_core.run_folder import RunFolder, RunFolderError, list_runs, passed_over
from studio.histories import Histories, Stamp, stamp_of
from studio.index import Index
from studio.inquest import Inquest
from studio.lines import AT_REST, Row, Summary, ended_line, line_of
from studio.shelf.marks import FILE, Marks, read_marks
from studio.shelf.outcome import Outcome, evaluations_of, outcome_of
from studio.statuses import Statuses

LONGEST_REASON = 500
"""Largest number of characters of the reason why a run can't be read."""


class Listing:
    """The runs of one folder as they are listed. It is thread-safe, and reads again only what has changed."""

    def __init__(self, runs: Path, histories: Histories, statuses: Statuses, inquest: Inquest) -> None:
        """List the runs of the folder `runs`."""
        self._runs = runs
        self._histories = histories
        self._statuses = statuses
        self._inquest = inquest
        self._index = Index(runs)
        self._parents: dict[str, Parent | None] = {}
        self._marks: dict[str, tuple[int, Marks]] = {}

    def ids(self) -> list[str]:
        """Return the names of all runs, newest first."""
        return list_runs(self._runs)[::-1]

    def line(self, folder: RunFolder, places: Mapping[str, int] | None = None) -> Summary:
        """Return the line of a run, whatever its state; `places` in the queue are looked up unless they are given."""
        try:
            line = self._line(folder, self._statuses.places() if places is None else places)
        except Exception as error:  # whatever is wrong with one run, the others are listed
            reason = str(error) if isinstance(error, RunFolderError) else f"{folder.id} can't be read: {error!r}"
            line = Summary(id=folder.id, status="unreadable", reason=reason[:LONGEST_REASON])
        return msgspec.structs.replace(line, marks=self.marks(folder))

    def lines(self, names: Collection[str] | None = None) -> list[Summary]:
        """Return all lines, newest first, and at the end the folders that are no runs but seem to be meant as such.

        With `names`, return only those of them that have these names.
        """
        found = self._lines(names)
        self._index.save(self.ids())
        return found

    def rows(self, names: Collection[str] | None = None) -> list[Row]:
        """Return what `lines` returns with what each run has come to."""
        rows = [self.row(line) for line in self._lines(names)]
        self._index.save(self.ids())
        return rows

    def row(self, line: Summary) -> Row:
        """Return a line with what its run has come to."""
        return Row(**msgspec.structs.asdict(line), outcome=self.outcome(RunFolder(self._runs / line.id)))

    def outcome(self, folder: RunFolder) -> Outcome:
        """Return what a run has come to, nothing where there is no log; a log is read again when it has grown."""
        with self._histories.turn(folder.id):
            stamp = stamp_of(folder)
            known = self._index.get(folder.id, stamp)
            if known.outcome is not None:
                return known.outcome
            outcome = outcome_of(self._histories.landmarks(folder))
            self._index.put(folder.id, msgspec.structs.replace(known, outcome=outcome))
            return outcome

    def evaluations(self, folder: RunFolder) -> list[Evaluation]:
        """Return the evaluations of a run."""
        with self._histories.turn(folder.id):
            return evaluations_of(self._histories.landmarks(folder))

    def marks(self, folder: RunFolder) -> Marks:
        """Return what people have noted about a run."""
        try:
            changed_at = (folder.path / FILE).lstat().st_mtime_ns
        except OSError:
            return Marks()
        known = self._marks.get(folder.id)
        if known is None or known[0] != changed_at:
            known = self._marks[folder.id] = changed_at, read_marks(folder.path)
        return known[1]

    def parents(self) -> dict[str, Parent | None]:
        """Return the parent of each run, or None, newest run first; a run that can't be read has none."""
        names = self.ids()
        for name in names:
            if name not in self._parents:  # run.json is written once
                with contextlib.suppress(RunFolderError):
                    self._parents[name] = RunFolder(self._runs / name).record().parent
        return {name: self._parents.get(name) for name in names}

    def forget(self, run_id: str) -> None:
        """Forget what was read of a run."""
        self._index.forget(run_id)
        self._parents.pop(run_id, None)
        self._marks.pop(run_id, None)

    def _lines(self, names: Collection[str] | None) -> list[Summary]:
        folders = [RunFolder(self._runs / run) for run in self.ids() if names is None or run in names]
        places = self._statuses.places()
        lines = [self.line(folder, places) for folder in folders]
        found = [line for line in lines if line.status != "unreadable" or (self._runs / line.id).exists()]  # not gone
        refused = sorted((name, why) for name, why in passed_over(self._runs).items() if names is None or name in names)
        return found + [Summary(id=name, status="unreadable", reason=why) for name, why in refused]

    def _line(self, folder: RunFolder, places: Mapping[str, int]) -> Summary:
        stamp, is_watched = stamp_of(folder), self._inquest.concerns(folder.id)
        known = None if is_watched else self._at_rest(folder, stamp)
        if known:
            status, reason = self._statuses.in_queue(folder, known.status, known.reason, places)
            return msgspec.structs.replace(known, status=status, reason=reason)
        history = self._histories.get(folder.id)
        if not is_watched and history.heartbeat and history.status in AT_REST:  # as long as no heartbeat comes
            self._keep(folder, stamp, line_of(history, history.status, history.message))
        return line_of(history, *self._statuses.of(history, places))

    def _at_rest(self, folder: RunFolder, stamp: Stamp) -> Summary | None:
        """Return the line of a run at rest, as its folder alone has it, unless that takes reading the whole log."""
        line = self._index.get(folder.id, stamp).line
        if line is None:
            with contextlib.suppress(OSError):  # there is no log yet
                line = ended_line(folder)
            if line is not None:
                self._keep(folder, stamp, line)
        return line

    def _keep(self, folder: RunFolder, stamp: Stamp, line: Summary) -> None:
        self._index.put(folder.id, msgspec.structs.replace(self._index.get(folder.id, stamp), line=line))
