"""Packages of other people for the tests: installed by pip, or written as pip would leave them."""

import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

ROOT = Path(__file__).parents[1]
OWN_ROBOT = ROOT / "examples" / "own_robot"


def install(source: Path, site: Path) -> None:
    """Build the package in `source` and install it into the folder `site`; nothing is left behind in `source`."""
    copy = site.parent / f"source of {source.name}"
    shutil.copytree(source, copy, ignore=shutil.ignore_patterns("build", "*.egg-info", "__pycache__"))
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*command, "--target", site, copy], check=True, timeout=200)


def write_package(site: Path, package: str, points: str, source: str) -> None:
    """Write a distribution of one module, `package`, with entry points as pyproject.toml or their own file has them."""
    (site / f"{package}.py").write_text(textwrap.dedent(source))
    about = site / f"{package}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(textwrap.dedent(points))


def beside(*sites: Path) -> dict[str, str]:
    """Return the environment of a process that sees what is installed in `sites`."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (*sites, ROOT)))}


def python(program: str, *sites: Path) -> str:
    """Return what a process prints that sees what is installed in `sites`."""
    ended = subprocess.run(
        [sys.executable, "-c", program], env=beside(*sites), capture_output=True, text=True, timeout=100
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout
