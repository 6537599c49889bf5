"""The launchers there are, by name."""

from pathlib import Path

from studio.study.launcher import Launcher, launcher_of
from studio.study.local import Local
from studio.study.plan import Study
from studio.study.slurm import Slurm
from studio.study.slurm_options import SlurmOptions

LAUNCHERS: dict[str, type[Launcher]] = {Local.name: Local, Slurm.name: Slurm}


def make_launcher(name: str, slots: int | None = None, options: SlurmOptions | None = None) -> Launcher:
    """Return the launcher `name`; raise ValueError that says what is allowed, or why it can't be used.

    `slots` are the runs at a time of the local one, `options` what Slurm is asked for.
    """
    if name not in LAUNCHERS:
        raise ValueError(f'unknown launcher "{name[:40]}"; choose from: {", ".join(LAUNCHERS)}')
    options = options or SlurmOptions()
    if name == Slurm.name and slots is not None:
        raise ValueError("--slots goes with --launcher local; --parallel caps the runs at a time of --launcher slurm")
    if name != Slurm.name and options != SlurmOptions():
        raise ValueError("--partition, --time, --account, --constraint, --mem and --parallel go with --launcher slurm")
    given = (options,) if name == Slurm.name else () if slots is None else (slots,)
    launcher = LAUNCHERS[name](*given)  # pyright: ignore[reportCallIssue]
    launcher.check()
    return launcher


def launcher_of_study(directory: Path, study: Study) -> Launcher:
    """Return the launcher that has the runs of a study in its hands; the local one where none has."""
    names = (launcher_of(directory / planned.run) for planned in study.runs)
    return LAUNCHERS[next((name for name in names if name in LAUNCHERS), Local.name)]()
