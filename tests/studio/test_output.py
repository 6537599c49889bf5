"""What the command line writes can be shown anywhere, and no file makes a terminal obey."""

import itertools
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from conftest import NAME, ROOT, make_run
from hypothesis import given
from hypothesis import strategies as st

from morph_core.protocol import StateChanged
from morph_core.run_folder import EventLog
from studio.cli import COMMANDS, main, run
from studio.cli.arguments import UsageError
from studio.cli.output import visible
from studio.cli.terminal import make_console
from studio.export.design_file import Design
from studio.shelf.marks import Marks, write_marks

EVIL = "\x1b]0;owned\x07\x1b[2J\x9b31m\u202e\r"


@given(st.text())
def test_only_characters_that_a_terminal_shows_are_left(words: str) -> None:
    shown = visible(words)
    assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]", shown)
    shown.encode()  # no half of a character is left
    assert visible(shown) == shown


def test_a_name_in_any_script_stays_as_it_is() -> None:
    assert visible("φ größer 机器人 ★ 🤖\n\tx") == "φ größer 机器人 ★ 🤖\n\tx"
    assert visible("a\x1b[2Jb") == r"a\x1b[2Jb"


def test_a_console_obeys_neither_markup_nor_escapes(capsys: pytest.CaptureFixture[str]) -> None:
    from rich.table import Table
    from rich.text import Text

    console = make_console()
    table = Table(f"[red]{EVIL}[/red]")
    table.add_row(Text(EVIL))
    console.print(table, Text(EVIL), f"[bold]{EVIL}")
    said = capsys.readouterr().out
    assert not re.search("[\x00-\x09\x0b-\x1f\x7f-\x9f\u202e]", said)
    assert said.count(r"\x1b[2J") == 4
    assert "[red]" in said
    assert "[bold]" in said


@pytest.fixture
def evil(tmp_path: Path) -> Path:
    """A folder of runs with one whose every word is hostile to a terminal, and a design of the same kind."""
    folder = make_run(tmp_path / "runs", ended=None)
    record = json.loads((folder.path / "run.json").read_text())
    record["versions"] = {"python": EVIL}
    (folder.path / "run.json").write_text(json.dumps(record))
    log = EventLog(folder)
    log.append(StateChanged(status="starting", iteration=0, message=EVIL))
    log.append(StateChanged(status="failed", iteration=0, message=EVIL))
    log.close()
    write_marks(folder.path, Marks(name="x\u202ey", tags=("t\u202ey",)))
    broken = make_run(tmp_path / "runs", f"{NAME}-broken")
    record["parameters"][0]["name"] = EVIL
    record["parameters"][0]["lo"] = 99
    record["id"] = broken.id
    (broken.path / "run.json").write_text(json.dumps(record))
    strange = tmp_path / "runs" / f"b{EVIL}".replace("/", "")
    (broken.path).rename(strange)
    design = Design(task="reacher", task_options={}, robot="arm", run=EVIL, design="best", iteration=1, parameters=[])
    (tmp_path / "design.json").write_bytes(msgspec.json.encode(design))
    return tmp_path


@pytest.mark.parametrize(
    "words",
    [
        "runs",
        "runs --tree",
        f"log {NAME}",
        f"evaluate {NAME}",
        f"export {NAME} --formats mjcf",
        f"compare {NAME} {NAME}",
        "import design.json",
        "import design.json --start",
        f"train --resume {NAME}\x1b[2J",
        "verify design.json",
        f"replay {NAME}",
        "\x1b[2J",
        f"train {EVIL.strip()}",
        f"export {NAME} --design \x1b[2J",
    ],
)
def test_no_command_prints_what_a_terminal_would_obey(
    evil: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], words: str
) -> None:
    monkeypatch.chdir(evil)
    monkeypatch.setattr("subprocess.Popen", _Refused)  # no process is needed to print what is in a file
    assert run(words.split(" ")) in (0, 1, 2)
    said = capfd.readouterr()
    assert said.out + said.err
    assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", said.out + said.err)


class _Refused(subprocess.Popen):
    """A process that can't be started."""

    def __init__(self, *_: object, **__: object) -> None:
        raise OSError(f"no process here: {EVIL}")

    def __del__(self, *_: object) -> None:
        """There is nothing to end."""


ENVIRONMENT = {k: v for k, v in os.environ.items() if k not in ("PORT", "MORPH_RUNS", "MORPH_TOKEN")} | {
    "PYTHONPATH": str(ROOT)
}


@pytest.mark.parametrize(
    ("encoding", "words"),
    [
        ("ascii", "runs --runs ü/机"),
        ("ascii", "runs --runs ü/机 --json"),
        ("cp1252", "runs --runs ü/leer机"),
        ("cp950", "train --help"),
    ],
)
def test_output_never_dies_of_an_encoding(tmp_path: Path, encoding: str, words: str) -> None:
    folder = make_run(tmp_path / "ü" / "机")
    write_marks(folder.path, Marks(name="größte ★ 机器人"))
    done = subprocess.run(
        [sys.executable, "-m", "studio.cli", *words.split()],
        capture_output=True,
        cwd=tmp_path,
        timeout=60,
        env=ENVIRONMENT | {"PYTHONIOENCODING": encoding},
    )
    assert (done.returncode, done.stderr) == (0, b"")
    if "--json" in words:
        assert json.loads(done.stdout.decode("ascii"))[0]["marks"]["name"] == "größte ★ 机器人"
    elif words == "runs --runs ü/机":
        assert r"gr\xf6\xdfte" in done.stdout.decode(encoding)


@pytest.mark.parametrize("words", ["runs", "runs --json", "--help", "--version", "train --help", "log none"])
@pytest.mark.parametrize(
    ("where", "buffering"), [("closed", -1), *itertools.product(("a full disk", "a reader who is gone"), (-1, 1))]
)
def test_a_command_bears_any_place_for_its_output(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    words: str,
    where: str,
    buffering: int,
) -> None:
    make_run(tmp_path / "runs", "good")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["morph-studio", *words.split()])
    reading, writing = os.pipe()
    os.close(reading)
    if where == "a full disk":
        os.dup2(os.open("/dev/full", os.O_WRONLY), writing)
    monkeypatch.setattr("sys.stdout", None if where == "closed" else os.fdopen(writing, "w", buffering))
    with pytest.raises(SystemExit) as end:
        main()
    said = capfd.readouterr().err
    assert "Traceback" not in said
    if words == "log none":
        assert end.value.code == 2
    elif where == "a full disk":
        assert end.value.code == 1
        assert "No space left on device" in said
    else:
        assert (end.value.code, said) == (0, "")


def test_help_ends_however_narrow_a_terminal_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for columns in ("1", "3", "39"):
        monkeypatch.setenv("COLUMNS", columns)
        monkeypatch.setattr("sys.argv", ["morph-studio", "runs", "--help"])
        with pytest.raises(SystemExit) as end:
            main()
        assert end.value.code == 0
        assert "--runs DIR" in capsys.readouterr().out


def test_the_version_names_what_a_report_of_a_fault_needs(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["--version"], ["-V"]):
        assert run(words) == 0
        said = capsys.readouterr().out
        for name in ("morph-studio", "python", "mujoco", "torch"):
            assert re.search(rf"\b{name} \d+\.\d+", said), name
        assert re.search(r"^processor \S.*\(\w+.*\)$", said, re.MULTILINE)


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "serve"])
@pytest.mark.parametrize("given_by", ["flag", "environment"])
def test_a_tilde_is_home_in_every_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], command: str, given_by: str
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    make_run(tmp_path / "home" / "x", "good")
    monkeypatch.setattr("subprocess.Popen", _Refused)
    words = {
        "runs": [],
        "log": ["good"],
        "evaluate": ["good", "--phi-from=~/design.json"],
        "export": ["good", "--out=~/new.zip"],
        "compare": ["good", "good"],
        "verify": ["~/none.zip"],
        "import": ["~/none.json"],
        "replay": ["good"],
        "train": ["reacher", "--iterations=1"],
        "study": ["--report=~/none"],
        "stop": ["good"],
        "show": ["good", "--out=~/new.html"],
    }
    if given_by == "environment":
        monkeypatch.setenv("MORPH_RUNS", "~/x")
    elif command not in ("verify", "study"):
        words[command].append("--runs=~/x")
    run([command, *words[command]])
    said = capfd.readouterr()
    assert "unknown run" not in said.err
    assert "~" not in said.out + said.err.replace("~/none", "~") or str(tmp_path) in said.out + said.err
    assert list((tmp_path / "elsewhere").iterdir()) == [], "nothing was made in a folder named ~"


def test_a_run_may_be_named_by_a_path_in_the_home(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    make_run(tmp_path / "x", "good")
    assert run(["log", "~/x/good"]) == 0
    assert run(["log", "~nobody-of-this-name/x/good"]) == 1
    assert "there is no such home" in capsys.readouterr().err


def flags_of(words: str, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Return the flags that the help of a command lists, as a person would read them off its left edge."""
    with pytest.raises(SystemExit) as end:
        run([*words.split(), "--help"])
    assert end.value.code in (0, None)
    lines = re.sub(r"\x1b\[[\d;]*m", "", capsys.readouterr().out).splitlines()
    listed = [re.match(r"^[│|\s]*((?:-\w, )?--[A-Za-z][\w.-]*)", line) for line in lines]
    return [flag for match in listed if match for flag in match[1].split(", ")]


@pytest.mark.parametrize(
    "words",
    [
        *COMMANDS,
        "train pen_press",
        "train mouse_click",
        "train reacher --method transform2act",
        "train reacher --search drift",
        "train reacher --exploration gaussian",
        "train reacher --method cmaes_rl",
        "train reacher --preset paper",
    ],
)
def test_help_lists_only_what_is_accepted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = flags_of(words, capsys)
    assert len(flags) >= 1 + (words != "verify")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("subprocess.Popen", _Refused)
    known = [flag for flag in flags if flag not in ("-h", "--help")]
    # No value that an option takes: whatever is wrong with it, it is never the flag itself.
    together = [word for flag in known for word in (flag, "?x")]
    one_by_one = [[flag, "?x", *["--port=-1"] * (words == "serve")] for flag in known if not words.startswith("train")]
    for words_given in [together, *one_by_one]:
        run([*words.split(), *(["reacher"] if words == "train" else []), *words_given])
        said = capsys.readouterr().err
        assert "unknown option" not in said
        assert "too many words: --" not in said


def test_a_usage_error_names_what_was_typed_without_obeying_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["train", "reacher", "--\x1b[2J"]) == 2
    assert r"\x1b[2J" in capsys.readouterr().err
    assert issubclass(UsageError, ValueError)


def test_ctrl_c_ends_a_command_without_a_traceback_from_its_first_import_on() -> None:
    script = """
import builtins, sys
import studio.cli
ours = {name.partition('.')[0] for name in sys.modules} & {'tyro', 'msgspec', 'numpy', 'rich', 'torch'}
original = builtins.__import__
def pressed(name, *rest):
    if name == sys.argv[1]:
        raise KeyboardInterrupt
    return original(name, *rest)
builtins.__import__ = pressed
print(sorted(ours), flush=True)
studio.cli.main()
"""
    for module in ("studio.cli.output", "tyro"):
        done = subprocess.run([sys.executable, "-c", script, module], capture_output=True, text=True, cwd=ROOT)
        assert (done.returncode, done.stdout, done.stderr) == (130, "[]\n", "")
