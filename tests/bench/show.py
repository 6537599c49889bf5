"""hand.html of a run in headless Chromium, drawn by the processor: its size, its first picture, and its speed.

The speed of the physics alone is without pictures; frames and real time are with them, in a window of 1280 x 800.
"""

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import psutil
import tyro
from playwright.sync_api import sync_playwright

from morph_core.history import History
from morph_core.run_folder import RunFolder
from studio.show.page import build_page

FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
MEASURE = """async (seconds) => {
    const show = await globalThis.show.ready, first = show.firstFrame;
    Object.assign(show, { frames: 0, simulated: 0, physicsMs: 0 });
    const begun = performance.now();
    await new Promise((resolve) => setTimeout(resolve, 1000 * seconds));
    const wall = (performance.now() - begun) / 1000;
    const { frames, simulated, physicsMs, stage: { quality } } = show;
    return { first, wall, frames, simulated, physicsMs, quality };
}"""


@dataclass(frozen=True)
class Show:
    """What to show, and for how long."""

    run: tyro.conf.Positional[Path]
    """Folder of a run of a hand with checkpoints."""
    seconds: float = 10.0
    """Seconds that are measured."""


def cpu_seconds() -> float:
    """Return the CPU seconds that the processes of the browser have taken."""
    browser = [process for process in psutil.Process().children(recursive=True) if "chrom" in process.name()]
    return sum(process.cpu_times().user + process.cpu_times().system for process in browser)


def main(arguments: Show) -> None:
    content = build_page(History(RunFolder(arguments.run)), "best").content
    print(f"size            {len(content) / 1e6:.1f} MB")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        path = Path(folder) / "hand.html"
        path.write_bytes(content)
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_context(viewport={"width": 1280, "height": 800}, offline=True).new_page()
        page.goto(path.as_uri())
        page.evaluate("show.ready.then(() => true)")
        before = cpu_seconds()
        seen = page.evaluate(MEASURE, arguments.seconds)
        spent = cpu_seconds() - before
        browser.close()
    print(f"first picture   {seen['first'] / 1000:.2f} s after the page was opened")
    print(
        f"frames          {seen['frames'] / seen['wall']:.1f} a second, at quality {seen['quality']} of 0 (best) to 4"
    )
    print(
        f"                {1000 * spent / seen['frames']:.0f} ms of CPU each, of 33 that 60 a second leave on two cores"
    )
    print(f"with pictures   {seen['simulated'] / seen['wall']:.2f} times real time (1 is what is asked for)")
    print(f"physics alone   {seen['simulated'] / (seen['physicsMs'] / 1000):.0f} times real time")


if __name__ == "__main__":
    main(tyro.cli(Show))
