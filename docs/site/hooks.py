"""What the site holds: the documents where they lie in the repository, so that their links hold, the notebook, the API
pages, and hands that run live."""

import atexit
import base64
import functools
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
DOCUMENTS = (
    "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "docs/*.*", "docs/studies/*/*", "docs/site/*.css",
    "studio/page/icon.svg", "assets/README.md", "examples/own_robot/README.md", "examples/*.py", "examples/*.ipynb",
)  # fmt: skip
"""The files of the repository that are pages of the site, and those that the pages show or link to."""
REPORTS = "docs/studies/*/report.html"
NOTEBOOK = "examples/notebook.ipynb"
LIVE = {
    "<!-- live hands -->": {"pen_press": "The pen, live", "mouse_click": "The mouse, live"},
    "<!-- live evolutions -->": {
        "evolution-reacher": "The arm finds its way through the tunnel",
        "evolution-pen_press": "The hand grows to hold the pen",
        "evolution-mouse_click": "The hand grows to hold the mouse",
    },
}
"""Places in the gallery where pages are named that the site alone has, and what the links to them say."""
_COMMENT = re.compile(r"^<!-- .*? -->\n", re.MULTILINE)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Return the theme's files, and ours under the paths that they have in the repository."""
    theme = [file for file in files if not str(file.abs_src_path).startswith(config.docs_dir)]
    paths = {path for pattern in DOCUMENTS for path in ROOT.glob(pattern)} - {*ROOT.glob(REPORTS)}
    ours = [_lying(path, ROOT, config) for path in sorted(paths)]
    made = [_lying(path, _made(), config) for path in sorted(_made().rglob("*.*"))]
    written = [
        File.generated(config, NOTEBOOK.replace(".ipynb", ".md"), content=_notebook_page(ROOT / NOTEBOOK)),
        *(
            File.generated(config, path.relative_to(ROOT).as_posix(), content=_without_dead_links(path))
            for path in sorted(ROOT.glob(REPORTS))
        ),
    ]
    return Files([*theme, *ours, *made, *written])


def on_page_markdown(markdown: str, **_: object) -> str:
    """Name what the site alone has; leave out the comments by which tables are written, which hide what follows."""
    for place, pages in LIVE.items():
        links = "\n".join(f"- [{title}](live/{page}.html)" for page, title in pages.items())
        markdown = markdown.replace(place, links)
    return _COMMENT.sub("\n", markdown.replace("notebook.ipynb)", "notebook.md)"))


def _without_dead_links(report: Path) -> str:
    """Return a report, which was copied from its study, with links to those files alone that were copied too."""

    def checked(link: re.Match[str]) -> str:
        return link[0] if (report.parent / link[1]).is_file() else link[2]

    return re.sub(r'<a href="([\w.]+)">([^<]*)</a>', checked, report.read_text())


def _lying(path: Path, folder: Path, config: MkDocsConfig) -> File:
    return File(path.relative_to(folder).as_posix(), str(folder), config.site_dir, config.use_directory_urls)


@functools.cache
def _made() -> Path:
    """Return a folder with the pages that are written by programs, made once for all builds of this process."""
    folder = Path(tempfile.mkdtemp(prefix="morph-site-"))
    atexit.register(shutil.rmtree, folder)
    command = [sys.executable, "-W", "error::UserWarning", "-m", "pdoc", "--output-directory", folder / "api"]
    # subprocesses at import: glfw asks one for its library's version
    environment = {**os.environ, "PDOC_ALLOW_EXEC": "1"}
    subprocess.run([*command, "morph_core", "studio"], check=True, cwd=ROOT, env=environment)
    _write_live(folder / "docs" / "live")
    return folder


def _write_live(folder: Path) -> None:
    """Write hand.html of the trained hands that the tests keep, and the evolution of each recorded run."""
    sys.path.insert(0, str(ROOT))
    from morph_core.history import History
    from studio.recordings import Recordings
    from studio.show.evolution import build_evolution
    from studio.show.page import build_page
    from tests.hands import write_trained_run

    folder.mkdir(parents=True)
    for task in LIVE["<!-- live hands -->"]:
        with tempfile.TemporaryDirectory() as runs:
            page = build_page(History(write_trained_run(Path(runs), task)), "best")
        (folder / f"{task}.html").write_bytes(page.content)
    recordings = Recordings()
    for name in recordings.names():
        history = recordings.get(name).history
        (folder / f"evolution-{history.record.task}.html").write_bytes(build_evolution([history]).content)


# --- the notebook as a page -------------------------------------------------------------------------------------------


def _notebook_page(path: Path) -> str:
    """Return a notebook as Markdown, with the outputs that are committed in it."""
    cells = nbformat.read(path, as_version=4).cells
    return "\n\n".join(part for cell in cells for part in _parts(cell))


def _parts(cell: nbformat.NotebookNode) -> Iterator[str]:
    if cell.cell_type == "markdown":
        yield cell.source
        return
    yield f"```python\n{cell.source}\n```"
    for output in cell.outputs:
        yield _shown(output)


def _shown(output: nbformat.NotebookNode) -> str:
    if output.output_type == "stream":
        return f"```text\n{output.text.rstrip()}\n```"
    data = output.data
    if "text/html" in data:
        return f'<div class="notebook-output">{re.sub(chr(10) + "+", chr(10), data["text/html"])}</div>'
    if "image/svg+xml" in data:
        encoded = base64.b64encode(data["image/svg+xml"].encode()).decode()
        return f'<img class="notebook-output" alt="Output of the cell above" src="data:image/svg+xml;base64,{encoded}">'
    return f"```text\n{data['text/plain']}\n```"
