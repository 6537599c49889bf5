"""The runs page as files: what it loads, what comes from others, and that nothing in it is against the policy."""

import json
import re
from pathlib import Path

import pytest
from conftest import ROOT, Served

PAGE = ROOT / "studio" / "page"
VENDOR = PAGE / "vendor"
OURS = ("runs.js", "runs-table.js", "runs-charts.js")
BUNDLES = ("charts.js", "tables.js")


def test_the_page_loads_only_files_of_this_server(served: Served) -> None:
    html = served.client.get("/runs").text
    scripts = "".join(served.client.get(f"/page/{name}").text for name in OURS)
    files = re.findall(r'(?:src|href)="([^"#]+)"', html)
    files += [f"page/{name.removeprefix('./')}" for name in re.findall(r'from "([^"]+)"', scripts)]
    assert {
        "page/runs.js",
        "page/runs.css",
        "page/vendor/tables.css",
        *(f"page/vendor/{b}" for b in BUNDLES),
    } <= set(files)
    for file in files:
        assert not file.startswith("/"), "a proxy may serve it under a prefix"
        assert served.client.get(f"/{file}").status_code == 200, file
    assert "http" not in html + scripts


@pytest.mark.parametrize("name", OURS)
def test_what_people_wrote_is_never_set_as_html(name: str) -> None:
    assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write", (PAGE / name).read_text())


@pytest.mark.parametrize(
    "path", [VENDOR / name for name in BUNDLES] + [PAGE / name for name in OURS], ids=lambda p: p.name
)
def test_no_script_makes_code_of_text_or_asks_elsewhere(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert not re.search(
        r"\beval\(|new Function\b|\bimport\(|importScripts|XMLHttpRequest|sendBeacon|sourceMappingURL", text
    )


def test_every_vendored_package_has_its_licence_and_the_version_that_is_built() -> None:
    licences = (VENDOR / "LICENSES.txt").read_text()
    wanted = json.loads((ROOT / ".ci" / "vendor" / "package.json").read_text())["dependencies"]
    locked = json.loads((ROOT / ".ci" / "vendor" / "package-lock.json").read_text())["packages"]
    shipped = {name.removeprefix("node_modules/"): p for name, p in locked.items() if name and not p.get("dev")}
    assert set(shipped) == {"echarts", "tabulator-tables", "tslib", "zrender"}
    for name, package in shipped.items():
        assert f"==== {name} {package['version']}, {package['license']} ====" in licences
        assert package["version"] == wanted.get(name, package["version"])
    for words in ("Apache License", "Permission is hereby granted", "Redistributions in binary form"):
        assert words in licences


def test_what_is_vendored_stays_small() -> None:
    assert sum(path.stat().st_size for path in VENDOR.iterdir()) < 1_000_000
