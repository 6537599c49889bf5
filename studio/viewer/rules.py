"""The rules of a run in words: how it learns, the task's options, and what counts as success."""

import dataclasses
import inspect
import re
import typing

from morph_core.history import History
from morph_core.tasks import TASKS, make_task


def rules_of(history: History) -> list[str]:
    """Return sentences for people; fewer for a run of a task that is not there in this version."""
    record = history.record
    exploration, search, projection = (record.config.get(key, "?") for key in ("exploration", "search", "projection"))
    uses = {
        "morph": f"z explored by {exploration}, φ searched by {search}, projection {projection}",
        "direct": "φ follows the returns of the designs that are explored",
        "no_hw_opt": "φ stays as it is",
    }
    lines = [f"Method {record.method}" + (f": {uses[record.method]}." if record.method in uses else ".")]
    options = options_of(record.task, record.task_options)
    if options:
        lines.append("Options: " + ", ".join(f"{name} {value}" for name, value in options.items()) + ".")
    rule = success_rule(record.task)
    return [*lines, f"Success: {rule}"] if rule else lines


def options_of(task: str, given: dict[str, object]) -> dict[str, object]:
    """Return the options that a run was given, and all that are one of a few words."""
    try:
        made = make_task(task, given)
    except (ValueError, TypeError):  # a task of another version
        return given
    kinds = typing.get_type_hints(type(made))
    words = [
        field.name
        for field in dataclasses.fields(TASKS[task])
        if field.init and typing.get_origin(kinds[field.name]) is typing.Literal
    ]
    return {name: getattr(made, name) for name in words} | given


def success_rule(task: str) -> str:
    """Return what the docstring of a task says under its heading Success; empty for a task of another version."""
    text = inspect.getdoc(TASKS[task]) if task in TASKS else None
    match = re.search(r"^Success: (.+?)(?=\n\n|\n[A-Z]\w*: |\Z)", text or "", re.DOTALL | re.MULTILINE)
    return " ".join(match[1].replace("`", "").split()) if match else ""
