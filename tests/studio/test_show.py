"""hand.html as a file: what it carries, what it may load, and what it says where something is missing."""

import base64
import gzip
import hashlib
import json
import re
from html import escape
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import ROOT, make_run

from morph_core.catalogue import make_task
from morph_core.history import History
from studio.cli import run
from studio.show import page as show_page
from studio.show.page import build_page
from tests.hands import trained_design, write_hand_run, write_trained_run

VENDOR = ROOT / "studio" / "show" / "vendor"
SHIPPED = ROOT / "studio" / "show" / "shipped"
LARGEST = 15 << 20


def carried(html: str, name: str) -> bytes:
    """Return what the page carries under a name, unpacked."""
    (packed,) = re.findall(rf'<script type="text/plain" id="{name}">([^<]*)</script>', html)
    return gzip.decompress(base64.b64decode(packed))


def hands_of(html: str) -> dict:
    return json.loads(carried(html, "hands"))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = write_trained_run(tmp_path_factory.mktemp("runs"), "pen_press")
    written = build_page(History(folder), "best")
    assert written.missing == ""
    assert len(written.content) <= LARGEST
    return written.content.decode()


def test_the_page_loads_nothing_and_allows_its_own_scripts_alone(trained: str) -> None:
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]+)"', trained)
    scripts = re.findall(r"<script(?: type=\"module\")?>(.*?)</script>", trained, re.DOTALL)
    assert len(scripts) == 3
    hashes = {f"'sha256-{base64.b64encode(hashlib.sha256(s.encode()).digest()).decode()}'" for s in scripts}
    allowed = dict(part.split(" ", 1) for part in policy.split("; "))
    assert allowed["default-src"] == "'none'"
    assert set(allowed["script-src"].split()) == hashes | {"'wasm-unsafe-eval'"}
    assert allowed["img-src"] == "data:"
    assert not {"connect-src", "frame-src", "font-src"} & set(allowed)
    assert not re.findall(r'(?:src|href)="(?!data:)', trained)


def test_the_scene_is_the_exported_one_with_the_contact_sensors_of_the_task(trained: str) -> None:
    evolved, initial = hands_of(trained)["designs"]
    task = make_task("pen_press")
    for design, phi in ((evolved, np.array(trained_design("pen_press"))), (initial, task.design_space.initial)):
        files = {path: base64.b64decode(content) for path, content in design["files"].items()}
        model = mujoco.MjModel.from_xml_string(design["xml"], files)
        there = task.scene(phi).compile()
        assert model.nsensordata == there.nsensordata
        assert model.sensor_objid.tolist() == there.sensor_objid.tolist()
        assert model.body_mass == pytest.approx(there.body_mass, rel=1e-9)
        assert len(design["layers"]) == 3
    assert (evolved["label"], initial["label"]) == ("Evolved", "Initial")


def test_the_page_has_what_the_task_judges_by(trained: str) -> None:
    task = make_task("pen_press")
    rule = hands_of(trained)["rule"]
    assert rule["horizon"] == task.horizon
    assert rule["lift_height"] == 0.05
    assert rule["pressed_at"] == pytest.approx(-0.01)
    assert rule["half_extents"] == [0.28, 0.03, 0.03]
    assert rule["besides_presser"] is False


def test_a_run_without_a_checkpoint_says_that_the_hand_holds_still(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_hand_run(tmp_path, "pen_press", trained_design("pen_press"))
    out = tmp_path / "pages" / "hand.html"
    out.parent.mkdir()
    assert run(["show", str(folder.path), "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert said.out.strip() == str(out)
    assert "holds no checkpoint of this design" in said.err
    html = out.read_text()
    assert "holds no checkpoint of this design" in html
    assert [design["layers"] for design in hands_of(html)["designs"]] == [None, None]


def test_a_design_that_cannot_be_built_is_a_picture_a_table_and_the_reason(tmp_path: Path) -> None:
    phi = trained_design("pen_press")
    phi[0] = 1.5  # the first finger stands where the second one does
    written = build_page(History(write_hand_run(tmp_path, "pen_press", phi)), "latest")
    html = written.content.decode()
    assert "fingers 1 and 2 stand" in written.missing
    assert escape(written.missing) in html
    assert hands_of(html)["designs"] == []
    assert "<td>1.500<td>0.000<td>+1.500<td>rad" in html
    assert 'src="data:image/png;base64,' in html


def test_a_run_without_a_hand_is_refused_with_the_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = make_run(tmp_path)
    out = tmp_path / "hand.html"
    assert run(["show", str(folder.path), "--out", str(out)]) == 1
    assert (
        "show is for hands that MuJoCo simulates, such as pen_press; this run is of reacher" in capsys.readouterr().err
    )
    assert not out.exists()


def test_a_place_where_nothing_can_be_written_is_named_before_anything_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = make_run(tmp_path)
    assert run(["show", str(folder.path), "--out", str(tmp_path / "nowhere" / "hand.html")]) == 2
    assert f"there is no folder {tmp_path / 'nowhere'} to write into" in capsys.readouterr().err


def test_the_name_of_a_run_is_text_and_the_initial_design_has_nothing_beside_it(tmp_path: Path) -> None:
    folder = write_hand_run(tmp_path, "pen_press", make_task("pen_press").design_space.initial.tolist())
    renamed = folder.path.rename(tmp_path / "<img onerror=x>{{style}}")
    html = build_page(History(type(folder)(renamed)), "0").content.decode()
    assert "<img onerror" not in html
    assert "&lt;img onerror=x&gt;{{style}}" in html
    (only,) = hands_of(html)["designs"]
    assert only["label"] == "This design"


def test_the_physics_are_the_published_ones() -> None:
    built = json.loads((VENDOR / "built.json").read_bytes())
    lock = json.loads((ROOT / ".ci" / "show" / "package-lock.json").read_bytes())["packages"]
    locked = lock[f"node_modules/{built['package']}"]
    assert (built["version"], built["integrity"]) == (locked["version"], locked["integrity"])
    wasm = gzip.decompress((VENDOR / "mujoco.wasm.gz").read_bytes())
    assert hashlib.sha256(wasm).hexdigest() == built["mujoco.wasm"]["sha256"]


def test_everything_that_is_carried_has_its_licence(trained: str) -> None:
    licences = (VENDOR / "LICENSES.txt").read_text()
    lock = json.loads((ROOT / ".ci" / "show" / "package-lock.json").read_bytes())["packages"]
    shipped = {name.removeprefix("node_modules/"): p for name, p in lock.items() if name and not p.get("dev")}
    assert set(shipped) == {"@mujoco/mujoco", "three"}
    for name, package in shipped.items():
        assert f"==== {name} {package['version']}, {package['license']} ====" in licences
    for words in ("Apache License", "The MIT License", "Qhull", "LodePNG", "==== fflate 0.8.3, MIT ===="):
        assert words in licences
    assert carried(trained, "licences-packed").decode() == licences


@pytest.mark.parametrize("path", [*VENDOR.glob("*.js"), *SHIPPED.glob("*.js")], ids=lambda path: path.name)
def test_no_script_makes_code_of_text_or_ends_its_element(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert not re.search(r"\beval\(|new Function\b|</script|<!--|sourceMappingURL", text)


@pytest.mark.parametrize("name", show_page.SCRIPTS)
def test_what_a_run_says_is_never_set_as_html(name: str) -> None:
    assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write", (SHIPPED / name).read_text())
