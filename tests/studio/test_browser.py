"""When `morph-studio serve` opens a browser: where somebody would see it, and never one that takes the terminal."""

import webbrowser
from collections.abc import Callable

import pytest

from studio import browser
from studio.browser import has_screen, open_in_browser

LINK = "http://127.0.0.1:8000/"
SSH = ("SSH_CONNECTION", "SSH_CLIENT", "SSH_TTY")
Opened = Callable[[str, dict[str, str]], list[str]]


@pytest.mark.parametrize("name", SSH)
@pytest.mark.parametrize("platform", ["linux", "darwin", "win32"])
def test_nothing_is_seen_over_ssh(name: str, platform: str) -> None:
    assert not has_screen({name: "10.0.0.1", "DISPLAY": ":0"}, platform)


@pytest.mark.parametrize(
    ("environment", "platform", "seen"),
    [
        ({}, "linux", False),
        ({"DISPLAY": ""}, "linux", False),
        ({"DISPLAY": ":0"}, "linux", True),
        ({"WAYLAND_DISPLAY": "wayland-0"}, "linux", True),
        ({"SSH_TTY": "", "DISPLAY": ":0"}, "linux", True),
        ({}, "freebsd14", False),
        ({}, "darwin", True),
        ({}, "win32", True),
        ({}, "cygwin", True),
    ],
)
def test_a_unix_needs_a_display(environment: dict[str, str], platform: str, seen: bool) -> None:
    assert has_screen(environment, platform) is seen


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Opened:
    """Return what is opened where the browser has a name, in an environment."""

    def links(name: str, environment: dict[str, str]) -> list[str]:
        found: list[str] = []
        there = webbrowser.GenericBrowser(name)
        monkeypatch.setattr(there, "open", found.append)
        monkeypatch.setattr(webbrowser, "get", lambda: there)
        for variable in (*SSH, "DISPLAY", "WAYLAND_DISPLAY"):
            monkeypatch.delenv(variable, raising=False)
        for variable, value in environment.items():
            monkeypatch.setenv(variable, value)
        monkeypatch.setattr(browser.sys, "platform", "linux")
        open_in_browser(LINK)
        return found

    return links


@pytest.mark.parametrize("name", ["firefox", "/usr/bin/chromium", "xdg-open"])
def test_a_browser_with_a_window_is_opened(name: str, opened: Opened) -> None:
    assert opened(name, {"DISPLAY": ":0"}) == [LINK]


@pytest.mark.parametrize("name", ["w3m", "/usr/bin/lynx", "www-browser", "elinks", "carbonyl"])
def test_a_browser_in_the_terminal_is_left_alone(name: str, opened: Opened) -> None:
    assert opened(name, {"DISPLAY": ":0"}) == []


def test_without_a_display_nothing_is_opened(opened: Opened) -> None:
    assert opened("firefox", {}) == []


def test_without_any_browser_the_link_alone_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> webbrowser.BaseBrowser:
        raise webbrowser.Error("could not locate runnable browser")

    monkeypatch.setattr(browser, "has_screen", lambda *_: True)
    monkeypatch.setattr(webbrowser, "get", none)
    open_in_browser(LINK)
