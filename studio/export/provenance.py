"""Where an exported design comes from: its run and configuration, what a user changed, a digest of each file."""

import hashlib
import time
from collections.abc import Mapping

import msgspec

from morph_core.history import History
from morph_core.protocol import AnyCommand, Parent
from studio.export.policy import Score
from studio.versions import versions_of

KIND = "morph-studio export"


class TakenCommand(msgspec.Struct, frozen=True):
    """A command that was in force when the design came about."""

    iteration: int
    command: AnyCommand


class Provenance(msgspec.Struct, frozen=True, kw_only=True):
    """Content of provenance.json. Everything but `exported` is the same each time the same design is exported."""

    kind: str = KIND
    run: str
    iteration: int
    task: str
    task_options: dict[str, object]
    method: str
    seed: int
    config: dict[str, object]
    versions: dict[str, str]
    """Versions of packages at the start of the run."""
    export_versions: dict[str, str]
    git_revision: str | None
    git_dirty: bool | None
    parent: Parent | None
    created: float
    commands: list[TakenCommand]
    commands_sha256: str
    sha256: dict[str, str]
    """Digests of every other file, by path."""
    checks: list[str]
    """Comparisons of the exported files with the simulated robot, a line each."""
    printer: str = ""
    """Printer that the plates are laid out for; empty without any."""
    oldest_mujoco: str = ""
    """Oldest MuJoCo that knows every word of the .xml files; empty without any."""
    policy: list[Score] = []
    """Scores of the policy on the exported files, and in training with the same design."""
    exported: str
    """Time of the export (UTC)."""


def provenance_of(
    history: History,
    iteration: int,
    files: Mapping[str, bytes],
    checks: list[str],
    policy: list[Score],
    oldest_mujoco: str,
    printer: str,
) -> Provenance:
    """Return where the design of an iteration comes from, with a digest of each of `files`."""
    record = history.record
    commands = [TakenCommand(e.iteration, e.command) for e in history.commands(iteration)]
    return Provenance(
        run=history.folder.id,
        iteration=iteration,
        task=record.task,
        task_options=record.task_options,
        method=record.method,
        seed=record.seed,
        config=record.config,
        versions=record.versions,
        export_versions=versions_of("morph-studio", "mujoco", "numpy"),
        git_revision=record.git_revision,
        git_dirty=record.git_dirty,
        parent=record.parent,
        created=record.created,
        commands=commands,
        commands_sha256=hashlib.sha256(msgspec.json.encode(commands)).hexdigest(),
        sha256={name: hashlib.sha256(content).hexdigest() for name, content in sorted(files.items())},
        checks=checks,
        printer=printer,
        oldest_mujoco=oldest_mujoco,
        policy=policy,
        exported=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    )
