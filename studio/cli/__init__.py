"""The command line `morph-studio`, one module for each of its commands.

Nothing but Python's own is imported until `main` has begun: Ctrl-C meanwhile would end in a traceback.
"""

import importlib
import platform
import re
import sys
from collections.abc import Sequence

COMMANDS = {
    "serve": "open the studio in the browser",
    "train": "co-optimise body and controller without a browser, or go on with a run",
    "study": "compare methods over tasks and seeds at equal environment steps",
    "runs": "list the runs of a folder, or show as a tree which branched from which",
    "stop": "end the trainer of a run, after its iteration or at once",
    "log": "print what was done to a run",
    "replay": "do a run again from its seed and its log, and compare",
    "evaluate": "measure success and return of a design on Hw-Phy",
    "compare": "compare two designs of any runs of one task: success, return, phi and masses",
    "export": "write a design for simulators, printers and people",
    "verify": "check that what an export holds is one robot, and that its policy works",
    "show": "write one offline HTML file in which a hand runs live",
    "import": "read a design and go on from it: in a running run, or in a new one",
}
_MODULES = {"import": "import_design"}
HELP = """\
usage: morph-studio COMMAND ...

Co-optimise a robot's body and its controller, and watch it happen.

{commands}

morph-studio COMMAND --help lists the options of a command, morph-studio --version what a report of a fault should
name. A first run: morph-studio serve
"""


_ENDLESS = r"\S{1000,}"
"""Pattern of a word that is too long to be said again; paths may have some hundred characters."""


def main() -> None:
    """Run the command of `sys.argv` and exit: 0 done, 1 failed, 2 asked for the impossible, 130 stopped by Ctrl-C."""
    try:
        code = _status()
    except KeyboardInterrupt:
        code = 130
    sys.exit(code)


def _status() -> str | int | None:
    from studio.cli.output import all_written, bear_any_encoding, bear_any_width, open_streams

    open_streams()
    bear_any_encoding()
    bear_any_width()
    try:
        code = run(sys.argv[1:])
    except BrokenPipeError:  # the reader of our output has seen enough
        code = 0
    except KeyboardInterrupt:
        code = 130
    except SystemExit as end:  # of the parser, which has printed its help
        code = end.code
    return code if all_written() else code or 1


def run(words: Sequence[str]) -> int:
    """Run one command and return its exit status."""
    from studio.cli.arguments import UsageError
    from studio.cli.output import complain

    try:
        return _obey(words)
    except UsageError as error:
        complain(f"morph-studio: {re.sub(_ENDLESS, _begin, str(error))}")
        return 2
    except BrokenPipeError:
        raise
    except OSError as error:  # a folder that is read-only, a disk that is full
        complain(f"morph-studio: {words[0] if words else 'help'}: {error}")
        return 1


def _begin(word: re.Match[str]) -> str:
    return f"{word[0][:80]}..."


def _obey(words: Sequence[str]) -> int:
    from studio.cli.arguments import UsageError
    from studio.cli.output import complain, say

    if not words or words[0] in ("-h", "--help"):
        commands = "\n".join(f"  {name:10}{does}" for name, does in COMMANDS.items())
        (say if words else complain)(HELP.format(commands=commands).rstrip())
        return 0 if words else 2
    if words[0] in ("-V", "--version"):
        say(version())
        return 0
    command, *rest = words
    if command not in COMMANDS:
        raise UsageError(f'unknown command "{command[:40]}"; choose from: {", ".join(COMMANDS)}')
    return importlib.import_module(f"studio.cli.{_MODULES.get(command, command)}").main(rest)


def version() -> str:
    """Return the versions that a report of a fault should name, and the processor, in lines."""
    from studio.versions import hardware, versions_of

    found = versions_of("morph-studio", "mujoco", "torch", "numpy", "gymnasium", "viser")
    own = found.pop("morph-studio", "not installed")
    packages = ", ".join(f"{name} {number}" for name, number in found.items())
    return f"morph-studio {own}\n{packages}\n{platform.platform()}\nprocessor {' ('.join(hardware().values())})"
