"""The report of a study: what is written of whole, half done and broken studies, and that its page is safe."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree, html

from morph_core.curves import COLOURS, INK
from morph_core.protocol import Status
from studio.cli import run
from studio.cli import study as cli
from studio.study import report
from studio.study.plan import StudyError, parse_seeds, parse_task, parse_variant, plan_study, read_study
from studio.study.report import write_report, write_tables_into
from studio.study.report.claims import CLAIMS
from studio.study.report.drawing import DASHES, STANDARD, looks, slim
from studio.study.report.figures.learning import middle_half
from studio.study.report.markdown import fill
from studio.study.report.page import command_of, ranges
from studio.study.report.results import read_results
from studio.study.report.tables import read_tables
from studio.study.report.write import write_report as write
from tests.studies import MADE, Made, write_study

ROOT = Path(__file__).parents[2]
ODD = Made("<script>alert(1)</script> | π", "direct")
MIXED = (*MADE[:2], *MADE[3:5], ODD)
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a study with a failed seed, one that waits, a method without a proxy and an odd name."""
    folder = tmp_path_factory.mktemp("studies") / "mixed"
    status: dict[tuple[str, int], Status | None] = {("direct", 1): "failed", ("cmaes_rl", 2): None}
    write_study(folder, MIXED, iterations=15, status=status)
    return write_report(folder)


@pytest.fixture(scope="module")
def text(written: Path) -> str:
    return written.read_text()


@pytest.fixture(scope="module")
def page(text: str) -> html.HtmlElement:
    return html.fromstring(text)


def quickly(study: Path, into: Path | None = None) -> Path:
    """Write a report without pixels."""
    return write(study, into, pixels=False)


def words(page: html.HtmlElement) -> str:
    return re.sub(r"\s+", " ", page.text_content())


def test_tables_figures_and_page_are_written(written: Path) -> None:
    folder = written.parent
    names = {path.stem for path in (folder / "figures").glob("*.svg")}
    assert names == {path.stem for path in (folder / "figures").glob("*.png")}
    assert {name.rsplit("-reacher", 1)[0] for name in names} == {
        "learning", "seeds", "aggregate", "time", "cost", "designs", "phi", "cosine", "loss",
    }  # fmt: skip
    for table in ("runs", "curves", "phi", "settings"):
        assert (folder / f"{table}.csv").stat().st_size > 100
        assert (folder / f"{table}.parquet").stat().st_size > 100
    assert written.stat().st_size < 1_000_000


def test_the_page_loads_nothing_and_runs_nothing(text: str, page: html.HtmlElement) -> None:
    assert not page.xpath("//script | //link | //img | //iframe | //object | //*[@style] | //@onload | //@onclick")
    assert not [link for link in page.xpath("//@href | //@src") if "//" in link]
    (policy,) = page.xpath("//meta[@http-equiv='Content-Security-Policy']/@content")
    assert "unsafe" not in policy
    assert "default-src 'none'" in policy
    assert "url(http" not in text


def test_what_a_label_says_stays_text(text: str, page: html.HtmlElement) -> None:
    assert "<script" not in text
    assert ODD.label in words(page)


def test_ids_in_the_page_are_unique_and_what_is_referred_to_is_there(text: str, page: html.HtmlElement) -> None:
    ids = page.xpath("//@id")
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'(?:href="|url\()#([\w-]+)', text)) <= set(ids)


def test_the_page_names_every_seed_its_failures_and_what_is_missing(page: html.HtmlElement) -> None:
    said = words(page)
    assert "This study is not complete: 1 not started." in said
    assert "1 run failed and counts as not solved: reacher-direct-s1." in said
    assert "disk full" in said
    rows = page.xpath("//h2[@id='seeds']/following-sibling::div[1]//tbody/tr")
    assert len(rows) == 3 * len(MIXED)
    assert [row.get("class") for row in rows].count("failed") == 1


def test_every_claim_stands_there_with_its_rule_or_among_those_that_cannot_be_tested(page: html.HtmlElement) -> None:
    said = words(page)
    for claim in CLAIMS:
        assert claim.statement in said
    assert len(page.xpath("//section[@class='claim']//td[@class='held']")) > 3


def test_figures_take_the_ink_of_the_page_and_have_no_ground_of_their_own(page: html.HtmlElement) -> None:
    figures = page.xpath("//figure//*[local-name()='svg']")
    assert len(figures) == 9
    for figure in figures:
        drawn = etree.tostring(figure).decode()
        assert "currentColor" in drawn
        assert INK not in drawn
        assert figure.get("aria-label")
        assert figure.get("width").isdecimal()
        assert not figure.get("height")


def test_a_standalone_figure_is_whole(written: Path) -> None:
    for path in (written.parent / "figures").glob("*.svg"):
        root = etree.fromstring(path.read_bytes())
        assert root.get("width")
        assert root.find(f".//{SVG}path").get("fill") == "#ffffff"
        assert not root.xpath("//*[@style]")


def test_writing_a_report_again_gives_the_same_figures(written: Path, tmp_path: Path) -> None:
    again = quickly(written.parent.parent, tmp_path)
    for path in (tmp_path / "figures").glob("*.svg"):
        assert path.read_text() == (written.parent / "figures" / path.name).read_text(), path.name
    assert not list(again.parent.rglob("*.png"))


@pytest.mark.parametrize("status", [None, "running", "failed", "stopped"])
def test_a_study_that_has_come_to_little_is_reported_too(tmp_path: Path, status: Status | None) -> None:
    made = MADE[:2]
    write_study(tmp_path / "study", made, [0], iterations=3, status={(m.label, 0): status for m in made})
    page = html.fromstring(quickly(tmp_path / "study").read_text())
    assert "held: 0" in words(page)
    assert "nan" not in words(page).lower().split()


def test_a_single_seed_has_no_interval_and_settles_no_claim(tmp_path: Path) -> None:
    write_study(tmp_path / "study", MADE[2:5], [7], iterations=10)
    page = html.fromstring(quickly(tmp_path / "study").read_text())
    assert "1 seed (7)" in words(page)
    assert "seeds that have ended: 1; 3 are needed" in words(page)
    assert not page.xpath("//td[@class='held' or @class='not-held']")


def test_several_tasks_are_compared_each_and_together(tmp_path: Path) -> None:
    write_study(tmp_path / "study", MADE[3:5], [0, 1], tasks=["reacher", "pen_press"], iterations=6)
    folder = quickly(tmp_path / "study").parent / "figures"
    assert {"aggregate-reacher.svg", "aggregate-pen_press.svg", "aggregate-all.svg"} <= {
        p.name for p in folder.iterdir()
    }
    assert {"phi-pen_press-m.svg", "phi-pen_press-rad.svg"} <= {path.name for path in folder.iterdir()}


def test_a_damaged_episode_shows_the_start_posture_instead(tmp_path: Path) -> None:
    study = write_study(tmp_path / "study", MADE[3:4], [0], iterations=10)
    (tmp_path / "study" / study.runs[0].run / "episodes" / "000010.npz").write_bytes(b"no zip")
    assert (quickly(tmp_path / "study").parent / "figures" / "designs-reacher.svg").is_file()


def test_without_what_reports_are_made_with_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "NEEDED", ("json", "no_such_package"))
    with pytest.raises(StudyError, match=r'needs no_such_package: pip install "morph-studio\[study\]"'):
        write_report(tmp_path)


def test_the_process_says_in_its_last_line_what_is_wrong(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "studio.study.report", str(tmp_path), str(tmp_path / "out")]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=120)
    assert ended.returncode == 2
    assert ended.stderr.splitlines()[-1] == f"{tmp_path} holds no study: there is no study.json in it"
    assert not (tmp_path / "out").exists()


# --- tables in documents ----------------------------------------------------------------------------------------------

DOCUMENT = """# Before
<!-- study mixed: summary reacher -->
old
<!-- end of table -->
<!-- study other: claims -->
theirs
<!-- end of table -->
<!-- study mixed: claims -->
<!-- end of table -->
After
"""


def test_tables_are_written_between_their_markers_and_nowhere_else(written: Path, tmp_path: Path) -> None:
    document = tmp_path / "page.md"
    document.write_text(DOCUMENT)
    assert write_tables_into(written.parent.parent, document) == 2
    lines = document.read_text().splitlines()
    assert [line for line in lines if not line.startswith("|")] == [
        line for line in DOCUMENT.splitlines() if line != "old"
    ]
    assert any(line.startswith("| paper | 3 of 3 |") for line in lines)
    assert any(line.startswith("| &lt;script> alert") or "\\| π" in line for line in lines)
    columns = {len(re.findall(r"(?<!\\)\|", line)) for line in lines if line.startswith("|")}
    assert columns == {12, 6}
    before = document.read_text()
    assert write_tables_into(written.parent.parent, document) == 2
    assert document.read_text() == before


def test_the_folder_of_a_report_gives_the_same_tables_as_the_study(written: Path) -> None:
    study = written.parent.parent
    assert fill(DOCUMENT, "mixed", read_tables(written.parent)) == fill(DOCUMENT, "mixed", read_results(study))


def test_the_folder_of_a_report_is_no_study_to_report(written: Path) -> None:
    with pytest.raises(StudyError, match="holds a report, without the runs of its study"):
        write_report(written.parent)


def test_a_document_without_a_place_is_told_how_to_make_one(written: Path, tmp_path: Path) -> None:
    document = tmp_path / "page.md"
    document.write_text("# nothing\n")
    with pytest.raises(StudyError, match='write the lines "<!-- study mixed: summary reacher -->"'):
        write_tables_into(written.parent.parent, document)
    assert document.read_text() == "# nothing\n"
    with pytest.raises(StudyError, match="can't be read"):
        write_tables_into(written.parent.parent, tmp_path / "none.md")
    document.write_text(DOCUMENT.replace("summary reacher", "summary pen_press"))
    with pytest.raises(StudyError, match='no task "pen_press"; choose from: reacher'):
        write_tables_into(written.parent.parent, document)


# --- parts ------------------------------------------------------------------------------------------------------------


def test_the_command_that_repeats_a_study_is_understood_by_the_command_line() -> None:
    words = ("slow:morph,alpha=0.3,search=drift", "paper,projection=none", "studio", "direct")
    variants = [parse_variant(word) for word in words]
    study = plan_study([parse_task("reacher,tunnel=paper")], variants, [0, 1, 2, 5], env_steps=10**6, level=0.8)
    said = shlex.split(command_of(study))
    at = {name: said.index(name) for name in ("--methods", "--seeds", "--env-steps", "--level")}
    assert [parse_task(word) for word in said[2 : at["--methods"]]] == study.tasks
    assert parse_seeds(said[at["--seeds"] + 1]) == study.seeds
    assert float(said[at["--env-steps"] + 1]) == study.env_steps
    assert float(said[at["--level"] + 1]) == study.level
    assert [parse_variant(word) for word in said[at["--methods"] + 1 : at["--seeds"]]] == variants


@pytest.mark.parametrize(("seeds", "said"), [([3], "3"), ([0, 1, 2], "0-2"), ([5, 0, 1, 9], "0-1,5,9"), ([], "")])
def test_seeds_read_as_the_command_line_takes_them(seeds: list[int], said: str) -> None:
    assert ranges(seeds) == said


LABELS = st.sampled_from(STANDARD) | st.text("abc", min_size=1, max_size=3)


@given(st.lists(LABELS, max_size=len(COLOURS) * len(DASHES), unique=True))
def test_no_two_of_many_variants_share_a_look_in_lines_or_in_marks(variants: list[str]) -> None:
    found = looks(variants)
    assert list(found) == variants
    assert len({(look.colour, str(look.dash)) for look in found.values()}) == len(found)
    assert len({(look.colour, look.marker) for look in found.values()}) == len(found)


@given(st.lists(LABELS, min_size=1, max_size=16, unique=True))
def test_a_standard_variant_looks_the_same_in_every_study_and_none_has_its_colour(variants: list[str]) -> None:
    found, alone = looks(variants), looks(STANDARD)
    for label in set(variants) & set(STANDARD):
        assert found[label] == alone[label]
    assert len({look.colour for look in found.values()}) == min(len(found), len(COLOURS))


def test_colours_are_told_apart_by_people_with_a_colour_blindness_and_seen_on_both_grounds() -> None:
    encoded = np.array([[int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)] for colour in (*COLOURS, *GROUNDS)])
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    light = linear @ [0.2126, 0.7152, 0.0722] + 0.05
    for ground in light[len(COLOURS) :]:
        assert (np.maximum(light[: len(COLOURS)], ground) / np.minimum(light[: len(COLOURS)], ground)).min() > 2
    for seen in SEEN_AS.values():
        lab = np.cbrt(np.clip(linear[: len(COLOURS)] @ np.transpose(seen), 0, 1) @ LMS.T) @ OKLAB.T
        distance = np.linalg.norm(lab[:, None] - lab, axis=-1) + np.eye(len(COLOURS))
        assert distance.min() > 0.07


GROUNDS = ("#ffffff", "#1b1d21", "#242424")
SEEN_AS = {  # Machado, Oliveira and Fernandes (2009), severity 1
    "all": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
LMS = np.array(  # Ottosson (2020): distances in OKLab are how different colours seem
    [[0.412221, 0.536333, 0.051446], [0.211903, 0.680700, 0.107397], [0.088302, 0.281719, 0.629979]]
)
OKLAB = np.array([[0.210454, 0.793618, -0.004072], [1.977998, -2.428592, 0.450594], [0.025904, 0.782772, -0.808676]])


def test_a_median_curve_ends_where_half_of_the_seeds_have_ended() -> None:
    x = np.arange(11.0)
    whole, half = (x, x), (x[:6], x[:6] + 2)
    band = middle_half([whole, whole, half, half])
    assert band is not None
    assert band[0][-1] == 10
    band = middle_half([whole, half, half])
    assert band is not None
    assert band[0][-1] <= 5
    assert band[2] == pytest.approx(band[0] + 2)
    assert middle_half([]) is None


def test_a_slim_figure_keeps_what_is_seen() -> None:
    written = b"""<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" width="9pt">
    <metadata/><defs><style>*{stroke-linejoin: round}</style></defs><g id="figure_1"><g id="axes_1">
    <defs><path id="m1" d="M 0 0 L 1.23456 -7.00001"/></defs><use xlink:href="#m1" style="fill: #ff0000; stroke: none"/>
    </g></g></svg>"""
    root = etree.fromstring(slim(written).encode())
    (use,) = root.iter(f"{SVG}use")
    assert (use.get("fill"), use.get("stroke"), use.get("href")) == ("#ff0000", "none", "#m1")
    (path,) = root.iter(f"{SVG}path")
    assert (path.get("d"), path.get("id")) == ("M0 0L1.2 -7", "m1")
    assert not [*root.iter(f"{SVG}metadata", f"{SVG}style", f"{SVG}g")]


EXAMPLES = sorted(path.parent for path in (ROOT / "docs").glob("*/*/runs.csv"))


@pytest.mark.parametrize("folder", EXAMPLES, ids=lambda folder: folder.name)
def test_the_tables_of_the_documents_are_those_of_the_committed_reports(folder: Path) -> None:
    results, found = read_tables(folder), 0
    for document in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        text = document.read_text()
        filled, count = fill(text, folder.name, results)
        assert filled == text, f"morph-studio study --report {folder.relative_to(ROOT)} --table {document.name}"
        found += count
    assert found
    assert read_study(folder).runs
    assert sum(path.stat().st_size for path in folder.iterdir()) <= 1_000_000


# --- the command ------------------------------------------------------------------------------------------------------


def test_the_command_writes_the_report_or_the_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study, document = tmp_path / "small", tmp_path / "page.md"
    write_study(study, MADE[3:4], [0], iterations=2)
    assert run(["study", "--report", str(study)]) == 0
    assert capsys.readouterr().out == f"report: {study / 'report' / 'report.html'}\n"
    document.write_text("<!-- study small: summary reacher -->\n<!-- end of table -->\n")
    assert run(["study", "--report", str(study), "--table", str(document)]) == 0
    assert capsys.readouterr().out == f"1 table written to {document}\n"
    assert "| direct | 1 of 1 |" in document.read_text()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--report {} --seeds 1", "--report DIR goes alone, or with --table or --json"),
        ("--status {} --table x.md", "--status DIR goes alone, or with --json"),
        ("--report {}", "holds no study: there is no study.json in it"),
        ("--report {} --table x.md", "holds no study: there is no study.json in it"),
    ],
)
def test_the_command_refuses_what_it_cannot_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: str, said: str
) -> None:
    assert run(["study", *words.format(tmp_path).split()]) == 2
    assert said in capsys.readouterr().err


def test_a_study_that_is_over_has_come_to_what_it_has_without_a_report_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_study(tmp_path / "study", MADE[3:4], [0], iterations=2)
    monkeypatch.setattr(report, "NEEDED", ("no_such_package",))
    cli._try_report(tmp_path / "study")
    assert 'pip install "morph-studio[study]"' in capsys.readouterr().err
