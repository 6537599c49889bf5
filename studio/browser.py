"""The browser of whoever starts the server, where there is a screen to show it on."""

import os
import sys
import webbrowser
from collections.abc import Mapping
from pathlib import PurePath

_IN_A_TERMINAL = frozenset(
    ("browsh", "carbonyl", "cha", "edbrowse", "elinks", "links", "links2", "lynx", "netrik", "w3m", "www-browser")
)
"""Browsers that would take the terminal over in which the server runs."""


def has_screen(environment: Mapping[str, str], platform: str) -> bool:
    """Tell whether a browser started here would be seen: not over SSH, nor on a Unix without a display."""
    if any(environment.get(name) for name in ("SSH_CONNECTION", "SSH_CLIENT", "SSH_TTY")):
        return False
    if platform in ("win32", "cygwin", "darwin"):
        return True
    return any(environment.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def open_in_browser(link: str) -> None:
    """Open a link in the browser, and nothing where there is no screen, or only a browser for terminals."""
    if not has_screen(os.environ, sys.platform):
        return
    try:
        browser = webbrowser.get()
    except webbrowser.Error:
        return
    if PurePath(getattr(browser, "name", "")).name not in _IN_A_TERMINAL:
        browser.open(link)
