"""The runs of a folder as trees: which run was branched from which."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from morph_core.protocol import Parent


@dataclass
class Member:
    """A run in a tree, with the runs that were branched from it."""

    run: str
    parent: Parent | None = None
    """Where it was branched from; None for a run that was not, and for one that is only named as a parent."""
    here: bool = True
    """Whether the folder holds the run; False for a parent that was moved elsewhere or deleted."""
    children: list["Member"] = field(default_factory=list)
    """The runs that were branched from it, by the iteration where they begin and by their name."""


def trees(parents: Mapping[str, Parent | None]) -> list[Member]:
    """Return all runs as trees, in the order in which their oldest ancestors are given.

    `parents` are all runs of a folder. Where files from elsewhere name each other as parents, each of them stands
    as a root.
    """
    members = {run: Member(run, parent) for run, parent in parents.items()}
    roots: dict[str, Member] = {}
    for run, parent in parents.items():
        if parent is None or _is_own_ancestor(run, parents):
            roots[run] = members[run]
            continue
        if parent.run not in members:
            members[parent.run] = roots[parent.run] = Member(parent.run, here=False)
        members[parent.run].children.append(members[run])
    for member in members.values():
        member.children.sort(key=lambda child: (child.parent.iteration if child.parent else 0, child.run))
    return list(roots.values())


def tree_of(run: str, parents: Mapping[str, Parent | None]) -> Member | None:
    """Return the tree in which a run stands, from its oldest ancestor on; None for a run without relatives."""
    for root in trees(parents):
        if root.children and _holds(root, run):
            return root
    return None


def children_of(run: str, parents: Mapping[str, Parent | None]) -> list[str]:
    """Return the names of the runs that were branched from a run, oldest first."""
    return sorted(name for name, parent in parents.items() if parent and parent.run == run)


def place_in_words(member: Member) -> str:
    """Return in words where a run was branched from its parent; empty for the oldest ancestor."""
    if member.parent is None:
        return "" if member.here else "not in this folder"
    taken = member.parent.checkpoint
    if taken is None:
        return f"the design of iteration {member.parent.iteration}"
    nearest = "" if taken == member.parent.iteration else f", asked for {member.parent.iteration}"
    return f"from iteration {taken}{nearest}"


def _is_own_ancestor(run: str, parents: Mapping[str, Parent | None]) -> bool:
    """Tell whether following a run's parents leads back to it."""
    seen: set[str] = set()
    parent = parents[run]
    while parent and parent.run not in seen:
        if parent.run == run:
            return True
        seen.add(parent.run)
        parent = parents.get(parent.run)
    return False


def _holds(member: Member, run: str) -> bool:
    waiting = [member]
    while waiting:
        one = waiting.pop()
        if one.run == run:
            return True
        waiting += one.children
    return False
