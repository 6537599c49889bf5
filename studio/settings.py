"""The settings of the server: where it listens, whom it lets in, where the runs lie."""

import ipaddress
import os
from dataclasses import dataclass, field
from pathlib import Path


def default_port() -> int:
    """Return PORT from the environment, or 8000; raise ValueError if it is no number."""
    text = os.environ.get("PORT") or "8000"
    if not text.isdecimal():
        raise ValueError(f"PORT must be a whole number from 0 to 65535, not {text!r}")
    return int(text)


def default_runs() -> Path:
    """Return MORPH_RUNS from the environment, or the folder `runs`."""
    return Path(os.environ.get("MORPH_RUNS") or "runs")


def _token() -> str | None:
    return os.environ.get("MORPH_TOKEN") or None


def _hosts() -> tuple[str, ...]:
    return tuple(name.strip() for name in os.environ.get("MORPH_HOSTS", "").split(",") if name.strip())


def _state() -> Path:
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "morph-studio"


@dataclass(frozen=True)
class Settings:
    """Raises ValueError with a sentence on what can't be served safely. Unset fields come from the environment."""

    host: str = "127.0.0.1"
    """The address to listen on; any other than this machine's own needs a token."""
    port: int = field(default_factory=default_port)
    """PORT. The port to listen on; 0 takes a free one."""
    runs: Path = field(default_factory=default_runs)
    """MORPH_RUNS. The folder of run folders."""
    token: str | None = field(default_factory=_token, repr=False)
    """MORPH_TOKEN. What browsers and API clients must know; without one, a link made at the start lets a browser in."""
    hosts: tuple[str, ...] = field(default_factory=_hosts)
    """MORPH_HOSTS, comma-separated. Further names under which this server is reached, e.g. behind a proxy."""
    state: Path = field(default_factory=_state)
    """Where the key behind the cookie lies, so that an open page survives a restart of the server."""
    open_browser: bool = True
    """Open the page once the server is up."""

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ValueError(f"the port must lie in 0 to 65535, not {self.port}")
        if self.token is not None and not (self.token.isascii() and self.token.isprintable() and self.token.strip()):
            raise ValueError("the token must be printable ASCII and not empty")
        if not self.is_loopback and not self.token:
            raise ValueError(
                f"refusing to listen on {self.host} without a token: give --token or MORPH_TOKEN, or stay on 127.0.0.1"
            )

    @property
    def is_loopback(self) -> bool:
        """Tell whether only this machine can reach `host`."""
        if self.host.lower() == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False
