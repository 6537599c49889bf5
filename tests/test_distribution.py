"""The distribution: which packages it installs, and that the meshes are found however it is installed."""

import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPT = """
from morph_core.tasks.mouse_click import assets, read_part
print(assets(), len(read_part("body")[0]))
"""


def test_every_package_of_the_repository_is_distributed() -> None:
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {path.parent for package in ("morph_core", "studio") for path in (ROOT / package).rglob("__init__.py")}
    packages = {".".join(folder.relative_to(ROOT).parts) for folder in folders}
    assert set(setuptools["packages"]) == packages | set(setuptools["package-dir"])


def _pip(*arguments: str | Path) -> None:
    options = ["--quiet", "--no-deps", "--no-build-isolation"]
    python, *command = map(str, arguments)
    subprocess.run([sys.executable, "-m", "pip", "--python", python, *command, *options], check=True, timeout=200)


def _environment(folder: Path) -> Path:
    """Make a virtual environment that sees what this one has installed, but not this checkout; return its Python."""
    venv.create(folder, symlinks=True)
    paths = {"base": str(folder), "platbase": str(folder)}
    site = Path(sysconfig.get_path("purelib", scheme="venv", vars=paths))
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    return Path(sysconfig.get_path("scripts", scheme="venv", vars=paths)) / "python"


def _found(python: Path, elsewhere: Path, **environment: str) -> str:
    """Return what the script prints where the present folder has someone else's `assets`."""
    (elsewhere / "assets").mkdir(parents=True, exist_ok=True)
    ended = subprocess.run([python, "-c", SCRIPT], cwd=elsewhere, env=environment, capture_output=True, text=True)
    return ended.stdout or ended.stderr


@pytest.mark.slow
def test_wheel_editable_install_and_checkout_find_the_meshes(tmp_path: Path) -> None:
    source, elsewhere = tmp_path / "source", tmp_path / "elsewhere"
    for folder in ("assets", "morph_core", "studio"):
        shutil.copytree(ROOT / folder, source / folder)
    for file in (path for path in ROOT.iterdir() if path.is_file()):
        shutil.copy(file, source)
    in_checkout = f"{source / 'assets'} 55\n"
    assert _found(Path(sys.executable), elsewhere, PYTHONPATH=str(source)) == in_checkout

    editable = _environment(tmp_path / "editable")
    _pip(editable, "install", "--ignore-installed", "--editable", source)
    assert _found(editable, elsewhere) == in_checkout

    _pip(Path(sys.executable), "wheel", "--wheel-dir", tmp_path, source)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert {
        f"studio/show/vendor/{name}" for name in ("mujoco.wasm.gz", "mujoco.js", "three.js", "LICENSES.txt")
    } < names
    recorded = (ROOT / "studio" / "recorded").rglob("*.*")
    assert {path.relative_to(ROOT).as_posix() for path in recorded} <= names
    folders = [name.split("/")[0] for name in names if "/" in name]
    assert {folder for folder in folders if not folder.endswith(".dist-info")} == {"morph_core", "studio"}
    installed = _environment(tmp_path / "installed")
    _pip(installed, "install", "--ignore-installed", wheel)
    shutil.rmtree(source)
    folder, vertices = _found(installed, elsewhere).split()
    assert Path(folder).parts[-3:] == ("site-packages", "morph_core", "assets")
    assert vertices == "55"
