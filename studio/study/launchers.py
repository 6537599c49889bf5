"""The launchers there are, by name."""

from pathlib import Path

from studio.study.launcher import Launcher
from studio.study.local import Local, launcher_of
from studio.study.plan import Study

LAUNCHERS: dict[str, type[Launcher]] = {Local.name: Local}


def make_launcher(name: str, slots: int | None = None) -> Launcher:
    """Return the launcher `name`, for at most `slots` runs at a time; raise ValueError that says what is allowed."""
    if name not in LAUNCHERS:
        raise ValueError(f'unknown launcher "{name[:40]}"; choose from: {", ".join(LAUNCHERS)}')
    launcher = LAUNCHERS[name]() if slots is None else LAUNCHERS[name](slots)  # pyright: ignore[reportCallIssue]
    launcher.check()
    return launcher


def launcher_of_study(directory: Path, study: Study) -> Launcher:
    """Return the launcher that has the runs of a study in its hands; the local one where none has."""
    names = (launcher_of(directory / planned.run) for planned in study.runs)
    return LAUNCHERS[next((name for name in names if name in LAUNCHERS), Local.name)]()
