"""A page as a file: whether it can be written where it is wanted, and the writing of it."""

from pathlib import Path

from studio.cli.arguments import UsageError
from studio.cli.output import complain, say, write_json
from studio.show.sheet import Page


def check_place(out: Path, command: str) -> None:
    """Raise UsageError where `out` can't be a file for want of a folder, or is one itself, before anything is made."""
    if out.is_dir():
        raise UsageError(f"{command}: {out} is a folder; give the path of a file")
    if not out.parent.is_dir():
        raise UsageError(f"{command}: there is no folder {out.parent} to write into")


def write_page(page: Page, out: Path, command: str, *, json: bool = False) -> int:
    """Write a page and print its path, with what it lacks as a complaint; return the exit status.

    With `json` one document is printed that holds both.
    """
    from morph_core.durable import where_written, write_file

    try:
        write_file(where_written(out), page.content)
    except OSError as error:
        complain(f"morph-studio: {command}: can't write {out}: {error.strerror or error}")
        return 1
    if json:
        write_json({"path": str(out), "bytes": len(page.content), "missing": page.missing})
        return 0
    if page.missing:
        complain(f"morph-studio: {command}: {page.missing}")
    say(out)
    return 0
