"""The settings of the server: where it listens, whom it lets in, where the runs lie."""

import errno
import ipaddress
import os
from dataclasses import dataclass, field
from pathlib import Path

from studio import limits
from studio.prefix import check_prefix

SHORTEST_TOKEN = 16
"""Smallest number of characters of a token where strangers can try some."""
FEWEST_DIFFERENT = 6
"""Smallest number of different characters of such a token."""


def default_port() -> int:
    """Return PORT from the environment, or 8000; raise ValueError if it is no number."""
    text = os.environ.get("PORT") or "8000"
    if not text.isdecimal() or len(text) > len("65535"):
        raise ValueError(f"PORT must be a whole number from 0 to 65535, not {text[:40]!r}")
    return int(text)


def default_runs() -> Path:
    """Return MORPH_RUNS from the environment, or the folder `runs`."""
    return at_home(os.environ.get("MORPH_RUNS") or "runs")


def at_home(path: str | Path) -> Path:
    """Return a path with ~ or ~user at its start replaced by that home; FileNotFoundError where there is none.

    A folder named ~ would sooner or later be removed by somebody who means it, and loses their home.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError:
        why = "there is no such home; a name that begins with ~ is written ./~name"
        raise FileNotFoundError(errno.ENOENT, why, str(path)) from None


def default_root_path() -> str:
    """Return MORPH_ROOT_PATH from the environment, or nothing."""
    return os.environ.get("MORPH_ROOT_PATH") or ""


def _proxies() -> str:
    return os.environ.get("FORWARDED_ALLOW_IPS") or "127.0.0.1,::1"


def _token() -> str | None:
    return os.environ.get("MORPH_TOKEN") or None


def _trainers() -> int:
    text = os.environ.get("MORPH_TRAINERS") or str(len(limits.cores()))
    if not text.isdecimal():
        raise ValueError(f"MORPH_TRAINERS must be a whole number from 1 to {limits.MAX_TRAINERS}, not {text[:40]!r}")
    return int(text[:9])


def _hosts() -> tuple[str, ...]:
    return tuple(name.strip() for name in os.environ.get("MORPH_HOSTS", "").split(",") if name.strip())


def _is_guessable(token: str) -> bool:
    return len(token) < SHORTEST_TOKEN or len(set(token)) < FEWEST_DIFFERENT


def _state() -> Path:
    try:
        home = Path.home()
    except RuntimeError:  # a user whom this machine does not know: nothing can be kept
        home = Path(os.devnull)
    return at_home(os.environ.get("XDG_STATE_HOME") or home / ".local" / "state") / "morph-studio"


@dataclass(frozen=True)
class Settings:
    """Settings of the server; unset fields come from the environment. What can't be served safely raises ValueError."""

    host: str = "127.0.0.1"
    """Address to listen on; any other than this machine's own needs a token."""
    port: int = field(default_factory=default_port)
    """Port to listen on, from PORT; 0 takes a free one."""
    runs: Path = field(default_factory=default_runs)
    """Folder of the run folders, from MORPH_RUNS."""
    token: str | None = field(default_factory=_token, repr=False)
    """Token that browsers and API clients must know, from MORPH_TOKEN; without it, a link made at the start lets a
    browser in."""
    hosts: tuple[str, ...] = field(default_factory=_hosts)
    """Further names under which this server is reached, e.g. behind a proxy; from MORPH_HOSTS, comma-separated."""
    root_path: str = field(default_factory=default_root_path)
    """Path under which a proxy serves the studio, such as /studio, from MORPH_ROOT_PATH; empty where it does not."""
    proxies: str = field(default_factory=_proxies)
    """Addresses and networks of proxies that are believed where a request comes from and under which path, between
    commas; from FORWARDED_ALLOW_IPS, by default this machine's."""
    state: Path = field(default_factory=_state)
    """Folder of the key behind the cookie, which lets an open page survive a restart of the server."""
    trainers: int = field(default_factory=_trainers)
    """Largest number of trainers at once on this machine, from MORPH_TRAINERS, by default one for each core; further
    runs wait in a queue."""
    open_browser: bool = True
    """Whether to open the page in the browser once the server is up."""
    audience: bool = False
    """Whether to make and print a link for spectators, who can only look, once the server is up."""
    present: bool = False
    """Whether the printed link leads into presenter's mode."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "root_path", check_prefix(self.root_path))
        if not 0 <= self.port <= 65535:
            raise ValueError(f"the port must lie in 0 to 65535, not {self.port}")
        if self.token is not None and not (self.token.isascii() and self.token.isprintable() and self.token.strip()):
            raise ValueError("the token must be printable ASCII and not empty")
        limits.whole("trainers", self.trainers, 1, limits.MAX_TRAINERS)
        if not self.is_loopback and self.token is not None and _is_guessable(self.token):
            raise ValueError(
                f"refusing to listen on {self.host} with a token that can be guessed: give one of at least "
                f"{SHORTEST_TOKEN} characters, such as: openssl rand -hex 24"
            )
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
