"""Under a path prefix: told by a setting or by a trusted proxy, left in the address or cut off."""

import re
from collections.abc import Iterator
from urllib.parse import urljoin

import httpx
import pytest
from conftest import TOKEN, Served, serving
from hypothesis import given
from hypothesis import strategies as st
from starlette.types import Receive, Scope, Send

from studio.prefix import Prefixed, check_prefix
from studio.settings import Settings


def settings_of(tmp_path_factory: pytest.TempPathFactory, **words: str) -> Settings:
    folder = tmp_path_factory.mktemp("prefix")
    return Settings(port=0, runs=folder / "runs", token=TOKEN, hosts=(), state=folder, **words)  # pyright: ignore[reportArgumentType]


@pytest.fixture(scope="module")
def under(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serving(settings_of(tmp_path_factory, root_path="/my/studio/")) as served:
        yield served


@pytest.fixture(scope="module")
def trusting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serving(settings_of(tmp_path_factory, proxies="127.0.0.1")) as served:
        yield served


@pytest.fixture(scope="module")
def distrusting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serving(settings_of(tmp_path_factory, proxies="10.0.0.0/8")) as served:
        yield served


def servers(served: Served, **headers: str) -> list[str]:
    document = served.client.get("/openapi.json", headers={k.replace("_", "-"): v for k, v in headers.items()}).json()
    return [server["url"] for server in document["servers"]]


@pytest.mark.parametrize(
    "path", ["/", "/runs", "/study", "/docs", "/api/runs", "/page/studio.js", "/viewer/", "/healthz"]
)
def test_each_path_is_there_with_its_prefix_and_without(under: Served, path: str) -> None:
    for address in (path, f"/my/studio{path}"):
        answer = under.client.get(address)
        assert (answer.status_code, "location" in answer.headers) == (200, False), address
    assert under.client.get(f"/my/studio/my/studio{path}").status_code == 404


def test_the_prefix_alone_leads_to_the_page(under: Served) -> None:
    answer = under.client.get("/my/studio", headers={"Host": f"127.0.0.1:{under.port}"})
    assert (answer.status_code, answer.headers["location"]) == (307, "/my/studio/")
    assert servers(under) == ["/my/studio"]


def test_the_token_is_asked_for_under_the_prefix_too(under: Served) -> None:
    stranger = httpx.Client(base_url=f"http://127.0.0.1:{under.port}/my/studio")
    assert stranger.get("/api/runs").status_code == 401
    assert stranger.get("/healthz").status_code == 200
    asked = stranger.get("/study", headers={"Sec-Fetch-Site": "cross-site"})
    assert asked.status_code == 401
    assert "url=./study" in asked.text
    entered = stranger.get(f"/study?token={TOKEN}")
    assert urljoin(str(entered.url), entered.headers["location"]) == f"http://127.0.0.1:{under.port}/my/studio/study"
    assert stranger.get("/study").status_code == 200


@pytest.mark.parametrize("page", ["/", "/runs", "/study", "/docs"])
def test_no_page_names_an_address_that_a_prefix_would_break(under: Served, page: str) -> None:
    html = under.client.get(page).text
    names = [name for name in re.findall(r'(?:src|href)="([^"#]+)"', html) if not name.startswith("data:")]
    assert names
    for name in names:
        there = urljoin(f"http://127.0.0.1:{under.port}/my/studio{page}", name)
        assert there.startswith(f"http://127.0.0.1:{under.port}/my/studio/")
        answer = under.client.get(there)
        assert answer.status_code == 200 or "the report has no file" in answer.text, there


@pytest.mark.parametrize(
    "name", ["studio.js", "plain.js", "tour.js", "runs.js", "runs-table.js", "runs-charts.js", "study.js"]
)
def test_no_script_asks_for_an_address_that_a_prefix_would_break(under: Served, name: str) -> None:
    script = under.client.get(f"/page/{name}").text
    assert not re.findall(r"""["'`]/(?:api|page|runs|study|viewer|docs|healthz|\?)[^"'`]*""", script)


def test_a_trusted_proxy_says_what_it_cut_off(trusting: Served) -> None:
    assert servers(trusting) == ["/"]
    assert servers(trusting, X_Forwarded_Prefix="/user/me/proxy/8000") == ["/user/me/proxy/8000"]
    slash = trusting.client.get("/runs/", headers={"X-Forwarded-Prefix": "/api"})
    assert slash.headers["location"] == f"http://127.0.0.1:{trusting.port}/api/runs"
    assert trusting.client.get("/api/runs", headers={"X-Forwarded-Prefix": "/api"}).json() == []


def test_nobody_else_is_believed(distrusting: Served) -> None:
    assert servers(distrusting, X_Forwarded_Prefix="/evil") == ["/"]
    slash = distrusting.client.get("/runs/", headers={"X-Forwarded-Prefix": "/evil", "X-Forwarded-Proto": "https"})
    assert slash.headers["location"] == f"http://127.0.0.1:{distrusting.port}/runs"


@pytest.mark.parametrize(
    "odd", ["//evil.example", "/a b", "/..", "/a/../b", "evil", "/\\evil", "/%2fevil", "/a?b", "/é"]
)
def test_an_odd_prefix_is_refused_and_from_a_proxy_not_heeded(trusting: Served, odd: str) -> None:
    with pytest.raises(ValueError, match="a path prefix is a path such as /studio"):
        Settings(root_path=odd)
    if odd.isascii():
        assert servers(trusting, X_Forwarded_Prefix=odd) == ["/"]


PARTS = st.lists(st.text("aB3_~@-", min_size=1, max_size=8), max_size=4)


@given(PARTS, st.booleans())
def test_a_prefix_is_one_path_with_or_without_its_last_slash(parts: list[str], slash: bool) -> None:
    prefix = "".join(f"/{part}" for part in parts)
    assert check_prefix(prefix + "/" * slash) == prefix


@given(PARTS.filter(bool), st.sampled_from(["/", "/runs", "/api/runs/x"]), st.booleans())
def test_an_application_sees_its_prefix_before_its_path(parts: list[str], path: str, left: bool) -> None:
    prefix = "".join(f"/{part}" for part in parts)
    seen: list[Scope] = []

    async def app(scope: Scope, receive: Receive, send: Send) -> None:  # noqa: ARG001 - what ASGI hands on
        seen.append(scope)

    scope = {"type": "http", "path": prefix + path if left else path, "headers": [], "client": ("10.0.0.1", 1)}
    placed = Prefixed(app, prefix, "127.0.0.1")(scope, None, None)  # pyright: ignore[reportArgumentType]
    with pytest.raises(StopIteration):
        placed.send(None)
    assert (seen[0]["root_path"], seen[0]["path"]) == (prefix, prefix + path)
