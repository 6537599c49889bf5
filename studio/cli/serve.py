"""`morph-studio serve`: open the studio in the browser."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import tyro

from studio.cli.arguments import RunsArguments, UsageError, parse
from studio.settings import Settings, default_port, default_root_path
from studio.study.launchers import make_launcher
from studio.study.slurm import Slurm
from studio.study.slurm_options import SlurmOptions


@dataclass(frozen=True)
class ServeArguments(RunsArguments):
    """Open the studio in the browser. It shows every run of the folder, also those started on the command line."""

    host: str = "127.0.0.1"
    """Address to listen on; any other than this machine's own needs a token."""
    port: Annotated[int, tyro.conf.arg(metavar="PORT")] = field(default_factory=default_port)
    """Port to listen on; by default PORT from the environment, else 8000."""
    token: Annotated[str | None, tyro.conf.arg(metavar="TOKEN")] = None
    """Token that browsers and API clients must know; without it, MORPH_TOKEN from the environment."""
    trainers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Largest number of trainers at once on this machine; further runs wait in a queue. By default MORPH_TRAINERS from
    the environment, else one for each core."""
    root_path: Annotated[str, tyro.conf.arg(metavar="PATH")] = field(default_factory=default_root_path)
    """Path under which a proxy serves the studio, such as /studio; by default MORPH_ROOT_PATH from the environment. A
    proxy of this machine, or one that FORWARDED_ALLOW_IPS names, may tell it by X-Forwarded-Prefix too."""
    no_browser: bool = False
    """Print the address of the studio without opening it in a browser, as is done over SSH and without a display."""
    audience: bool = False
    """Print a second link, for an audience: whoever opens it sees what the first browser shows, and can only look. The
    page makes such a link too, and ends it."""
    present: bool = False
    """Begin in presenter's mode: large words over the scene, no panels; Enter trains live, Esc leaves it."""
    launcher: Literal["local", "slurm"] = "local"
    """Where the trainers of new runs start: on this machine, or on a cluster through Slurm."""
    slurm: tyro.conf.OmitArgPrefixes[SlurmOptions] = SlurmOptions()
    """Options of --launcher slurm."""


def main(words: Sequence[str]) -> int:
    """Run `morph-studio serve` with these words; return the exit status."""
    try:
        arguments = parse(ServeArguments, words, "serve")
        asked = {"token": arguments.token, "trainers": arguments.trainers}
        given: dict[str, Any] = {name: value for name, value in asked.items() if value is not None}
        settings = Settings(
            host=arguments.host,
            port=arguments.port,
            runs=arguments.runs,
            root_path=arguments.root_path,
            open_browser=not arguments.no_browser,
            audience=arguments.audience,
            present=arguments.present,
            **given,
        )
        launcher = make_launcher(arguments.launcher, options=arguments.slurm)
    except UsageError:
        raise
    except ValueError as error:  # of the settings, or of the environment
        raise UsageError(f"serve: {error}") from error
    from studio.app import serve

    serve(settings, launcher if isinstance(launcher, Slurm) else None)
    return 0
