"""`morph-studio serve`: open the studio in the browser."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import tyro

from studio.cli.arguments import RunsArguments, UsageError, parse


def _default_port() -> int:
    text = os.environ.get("PORT") or "8000"
    if not text.isdecimal():
        raise UsageError(f"PORT must be a whole number from 0 to 65535, not {text!r}")
    return int(text)


@dataclass(frozen=True)
class ServeArguments(RunsArguments):
    """Open the studio in the browser. It shows every run of the folder, also those started on the command line."""

    host: str = "127.0.0.1"
    """Address to listen on; any other than this machine's own needs a token."""
    port: Annotated[int, tyro.conf.arg(metavar="PORT")] = field(default_factory=_default_port)
    """Port to listen on; without it, PORT from the environment."""
    token: Annotated[str | None, tyro.conf.arg(metavar="TOKEN")] = None
    """Token that browsers and API clients must know; without it, MORPH_TOKEN from the environment."""
    no_browser: bool = False
    """Print the URL, and do not open it."""


def main(words: Sequence[str]) -> int:
    """Run `morph-studio serve` with these words; return the exit status."""
    arguments = parse(ServeArguments, words, "serve")
    from studio.settings import Settings

    given: dict[str, Any] = {} if arguments.token is None else {"token": arguments.token}
    try:
        settings = Settings(
            host=arguments.host,
            port=arguments.port,
            runs=arguments.runs,
            open_browser=not arguments.no_browser,
            **given,
        )
    except ValueError as error:
        raise UsageError(f"serve: {error}") from error
    from studio.app import serve

    serve(settings)
    return 0
