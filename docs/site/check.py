"""`python docs/site/check.py SITE`: a built site has no dead link and no dead anchor, and loads nothing from outside.

Links to other sites are not followed. What loads is seen in a headless Chromium, which has no network but this server.
"""

import functools
import shutil
import sys
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urljoin, urlsplit

from lxml import html
from playwright.sync_api import Browser, Page, sync_playwright

LOOKED_AT = (
    "index.html", "docs/use.html", "docs/gallery.html", "docs/comparison.html", "examples/notebook.html",
    "CONTRIBUTING.html", "api/index.html", "docs/studies/pen/report.html", "docs/live/pen_press.html",
    "docs/live/evolution-reacher.html",
)  # fmt: skip
"""Pages that are opened in the browser: one of each kind."""
SOUGHT = "divergence"
"""Word that the search must find."""
HOST = "http://site"
_PARSER = html.HTMLParser(huge_tree=True, encoding="utf-8")


def dead_links(site: Path) -> Iterator[str]:
    """Yield each link of a page to a file or an anchor that is not there, and each thing that it takes from outside."""
    pages = {page.relative_to(site).as_posix(): html.parse(page, _PARSER).getroot() for page in site.rglob("*.html")}
    anchors = {path: _anchors(root) for path, root in pages.items() if root is not None}
    for path in anchors:
        for element, attribute, link, _ in pages[path].iterlinks():
            target = urlsplit(urljoin(f"{HOST}/{path}", link))
            if target.scheme in ("data", "mailto", "javascript"):
                continue
            if f"{target.scheme}://{target.netloc}" != HOST:
                if element.tag != "a":
                    yield f"{path}: <{element.tag} {attribute}> takes {link} from outside"
                continue
            there, anchor = unquote(target.path).removeprefix("/"), unquote(target.fragment)
            there = f"{there}index.html" if there.endswith("/") or not there else there
            if not (site / there).is_file():
                yield f"{path}: {link} is not there"
            elif anchor and there in anchors and anchor not in anchors[there]:
                yield f"{path}: {link} has no such anchor"


def _anchors(root: html.HtmlElement) -> set[str]:
    return {*root.xpath("//@id"), *root.xpath("//a/@name")}


def outside_requests(site: Path) -> Iterator[str]:
    """Yield what pages ask of other servers, what they miss, and the errors of their scripts, in light and in dark."""
    handler = functools.partial(_Quiet, directory=site)
    with _Server(("127.0.0.1", 0), handler) as server, sync_playwright() as playwright:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        home = f"http://127.0.0.1:{server.server_address[1]}/"
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-background-networking"]
        )
        for scheme in ("light", "dark"):
            yield from _visit(browser, home, scheme)
        browser.close()
        server.shutdown()


def _visit(browser: Browser, home: str, scheme: str) -> list[str]:
    page = browser.new_page(color_scheme=scheme)
    faults: list[str] = []
    page.on("request", lambda r: None if r.url.startswith((home, "data:", "blob:")) else faults.append(f"asks {r.url}"))
    page.on("response", lambda r: faults.append(f"{r.status} for {r.url}") if r.status >= 400 else None)
    page.on("pageerror", lambda error: faults.append(f"{page.url}: {error}"))
    for path in LOOKED_AT:
        page.goto(home + path, wait_until="load")
    page.goto(home)
    if not _found(page):
        faults.append(f"the search finds nothing for {SOUGHT}")
    page.close()
    return faults


def _found(page: Page) -> bool:
    page.keyboard.press("/")
    page.keyboard.type(SOUGHT)
    page.locator(".md-search-result__item").first.wait_for(timeout=20_000)
    return page.locator(".md-search-result__item").count() > 0


class _Server(ThreadingHTTPServer):
    def handle_error(self, *_: object) -> None:
        """Say nothing of a browser that has left before the end of an answer."""


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Say nothing of each request."""


def main(site: Path) -> int:
    """Print every fault; return 1 if there is one."""
    faults = [*dead_links(site), *outside_requests(site)]
    for fault in faults:
        print(fault)
    print(f"{len(faults)} faults in {site}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
