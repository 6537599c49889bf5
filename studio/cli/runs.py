"""`morph-studio runs`: list the runs of a folder."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import tyro

from morph_core import run_folder
from morph_core.protocol import Parent
from studio.branches import Member, place_in_words, trees
from studio.cli.arguments import RunsArguments, parse
from studio.cli.output import write_json
from studio.runs import Runs
from studio.shelf.marks import Marks, as_kept


@dataclass(frozen=True)
class ListArguments(RunsArguments):
    """List the runs of a folder, the newest first; a folder that can't be read is listed with the reason."""

    tree: bool = False
    """Show the runs as a tree, each under the run that it was branched from."""
    archived: Literal["hide", "show", "only"] = "hide"
    """Whether to leave archived runs out, to list them too, or alone."""
    starred: bool = False
    """List starred runs alone."""
    tag: Annotated[str | None, tyro.conf.arg(metavar="TAG")] = None
    """List runs with this tag alone."""
    json: bool = False
    """Print one JSON document and nothing else."""

    def takes(self, marks: Marks) -> bool:
        """Tell whether a run with these marks is to be listed."""
        archived = {"hide": not marks.archived, "show": True, "only": marks.archived}[self.archived]
        return (
            archived and (marks.starred or not self.starred) and (self.tag is None or as_kept(self.tag) in marks.tags)
        )


def main(words: Sequence[str]) -> int:
    """Run `morph-studio runs` with these words; return the exit status."""
    arguments = parse(ListArguments, words, "runs")
    lines = list_runs(arguments.runs, arguments.takes)
    if arguments.json:
        write_json(lines)
    elif arguments.tree and lines:
        _print_tree(lines)
    else:
        _print_table(arguments, lines)
    return 0


def list_runs(folder: Path, takes: Callable[[Marks], bool]) -> list[dict[str, object]]:
    """Return one entry per run whose marks are taken: what the API says about it, and its best evaluation."""
    runs = Runs(folder)
    runs.ask_slurm()
    lines = []
    for row in runs.rows():
        if not takes(row.marks):
            continue
        line = msgspec.to_builtins(row)
        del line["current"]  # which run a browser shows is the server's to know
        best = line.pop("outcome")["best"]
        line["best"] = best and {name: value for name, value in best.items() if name != "phi"}
        lines.append(line)
    return lines


def _print_tree(lines: list[dict[str, Any]]) -> None:
    from rich.text import Text
    from rich.tree import Tree

    from studio.cli.terminal import make_console

    console = make_console()
    by_name = {line["id"]: line for line in lines}

    def label(member: Member) -> Text:
        line = by_name.get(member.run)
        said = [place_in_words(member)]
        if line and line["status"] != "unreadable":
            said += [str(line["status"]), f"iteration {line['iteration']}"]
            said += [f"success {line['success']:.2f}"] if line["success"] is not None else []
        elif line:
            said.append("unreadable")
        return Text.assemble((member.run, "bold"), "  ", (", ".join(part for part in said if part), "dim"))

    def grow(branch: Tree, member: Member) -> None:
        for child in member.children:
            grow(branch.add(label(child)), child)

    for root in trees({line["id"]: line["parent"] and Parent(**line["parent"]) for line in lines}):
        stem = Tree(label(root), guide_style="dim")
        grow(stem, root)
        console.print(stem)


def _why_none(arguments: ListArguments) -> str:
    total = len(run_folder.list_runs(arguments.runs))
    if total:
        asked = ["starred"] * arguments.starred + [f'tagged "{arguments.tag}"'] * (arguments.tag is not None)
        asked += ["archived"] * (arguments.archived == "only")
        why = f"none is {' and '.join(asked)}" if asked else "all are archived"
        left_out = "; archived ones are left out, but for --archived show" * (arguments.archived == "hide")
        return f"none of the {total} runs in {arguments.runs} is listed: {why}{left_out}"
    return f"no runs in {arguments.runs} yet; start one: morph-studio train reacher"


def _print_table(arguments: ListArguments, lines: list[dict[str, object]]) -> None:
    from rich.table import Table
    from rich.text import Text

    from studio.cli.terminal import make_console

    console = make_console()
    if not lines:
        console.print(Text(_why_none(arguments)), soft_wrap=True)
        return
    table = Table(box=None, pad_edge=False)
    for heading in ("run", "task", "method", "seed", "status", "iteration", "success", "best", "noted"):
        numeric = heading in ("seed", "iteration", "success", "best")
        table.add_column(heading, justify="right" if numeric else "left", overflow="fold")
    for line in lines:
        best = line["best"]
        table.add_row(*(Text(cell) for cell in (
            str(line["id"]), str(line["task"] or ""), str(line["method"] or ""),
            "" if line["seed"] is None else str(line["seed"]), str(line["status"]),
            "" if line["iterations"] is None else f"{line['iteration']}/{line['iterations']}",
            "" if line["success"] is None else f"{line['success']:.2f}",
            f"{best['success']:.2f} at {best['iteration']}" if isinstance(best, dict) else "",
            _noted(msgspec.convert(line["marks"], Marks)),
        )))  # fmt: skip
    console.print(table)
    for line in lines:
        if line["reason"] and line["status"] in ("failed", "lost", "unreadable"):
            console.print(Text(f"{line['id']}: {line['reason']}"), soft_wrap=True)


def _noted(marks: Marks) -> str:
    """Return star, name and tags of a run in one cell."""
    words = ["★" if marks.starred else "", marks.name, *(f"#{tag}" for tag in marks.tags)]
    return " ".join([word for word in words if word] + ["(archived)"] * marks.archived)
