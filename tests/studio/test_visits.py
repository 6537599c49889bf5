"""A link that works once is used up by a person's visit alone."""

from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
from conftest import Served, serving
from starlette.datastructures import Headers

from studio.settings import Settings
from studio.visits import is_visit

BROWSER = "Mozilla/5.0 (X11; Linux x86_64) AppleWebKit/537.36 (KHTML, like Gecko) Chrome/150.0.0.0 Safari/537.36"
PREVIEWS = [
    "Slackbot-LinkExpanding 1.0 (+https://api.slack.com/robots)",
    "facebookexternalhit/1.1 (+http://www.facebook.com/externalhit_uatext.php)",
    "Mozilla/5.0 (compatible; Discordbot/2.0; +https://discordapp.com)",
    "TelegramBot (like TwitterBot)",
    "WhatsApp/2.23.20.0 A",
    "Mozilla/5.0 (Windows NT 6.1; WOW64) SkypeUriPreview Preview/0.5",
    "LinkedInBot/1.0 (compatible; Mozilla/5.0; Apache-HttpClient +http://www.linkedin.com)",
    "Mozilla/5.0 (compatible; Googlebot/2.1; +http://www.google.com/bot.html)",
    "Synapse (bot; +https://github.com/matrix-org/synapse)",
    "Mattermost-Bot/1.1",
    "ZulipURLPreview/1.0",
]


@pytest.mark.parametrize("agent", PREVIEWS)
def test_a_preview_of_a_link_is_no_visit(agent: str) -> None:
    assert not is_visit("GET", Headers({"User-Agent": agent}))


@pytest.mark.parametrize(
    "headers",
    [
        {"Purpose": "prefetch"}, {"Sec-Purpose": "prefetch;prerender"}, {"X-Purpose": "preview"}, {"X-Moz": "prefetch"},
        {"Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"}, {"Sec-Fetch-Mode": "cors"},
        {"Sec-Fetch-User": "?1", "Sec-Purpose": "prefetch"},
    ],
)  # fmt: skip
def test_what_is_fetched_ahead_or_as_a_part_of_something_is_no_visit(headers: dict[str, str]) -> None:
    assert not is_visit("GET", Headers({"User-Agent": BROWSER, **headers}))


@pytest.mark.parametrize(
    "headers",
    [
        {}, {"User-Agent": BROWSER}, {"User-Agent": "curl/8.20"},
        {"User-Agent": BROWSER, "Sec-Fetch-Mode": "navigate", "Sec-Fetch-User": "?1"},
        {"User-Agent": f"{BROWSER} CUBOT", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-User": "?1"},
    ],
)  # fmt: skip
def test_a_person_with_a_browser_or_a_script_is_a_visit(headers: dict[str, str]) -> None:
    assert is_visit("GET", Headers(headers))
    assert not is_visit("HEAD", Headers(headers))


def test_head_and_previews_leave_the_ticket_to_the_person(tmp_path: Path) -> None:
    settings = Settings(port=0, runs=tmp_path / "runs", token=None, hosts=(), state=tmp_path)
    with serving(settings) as served:
        link = f"http://127.0.0.1:{served.port}/?token={served.app.state.access.ticket}"
        looks: list[Callable[[], httpx.Response]] = [
            lambda: httpx.head(link),
            *[lambda agent=agent: httpx.get(link, headers={"User-Agent": agent}) for agent in PREVIEWS[:2]],
            lambda: httpx.get(link, headers={"Purpose": "prefetch"}),
        ]
        for look in looks:
            answer = look()
            assert (answer.status_code, "set-cookie" in answer.headers) == (401, False)
            assert "does not fit" not in answer.text
        assert httpx.get(link).status_code == 303
        assert httpx.get(link).status_code == 401, "it worked once"


def test_who_is_in_already_may_look_by_any_method(served: Served) -> None:
    assert served.client.head("/").status_code in (200, 405)
