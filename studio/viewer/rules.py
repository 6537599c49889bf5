"""The rules of a run in words: how it learns, the task's options, and what counts as success."""

import inspect
import re

from morph_core.catalogue import TASKS, make_task, read_method
from morph_core.history import History
from studio.fields import fields_of


def rules_of(history: History) -> list[str]:
    """Return sentences for people; fewer for a run of a task that is not there in this version."""
    record = history.record
    try:
        how = read_method(record).rules()
    except ValueError:  # a method of another version, or of a package that is not installed
        how = ""
    lines = [f"Method {record.method}: {how}." if how else f"Method {record.method}."]
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
    return {field.name: field.default for field in fields_of(made) if field.choices} | given


def success_rule(task: str) -> str:
    """Return what the docstring of a task says under its heading Success; empty for a task of another version."""
    text = inspect.getdoc(TASKS[task]) if task in TASKS else None
    match = re.search(r"^Success: (.+?)(?=\n\n|\n[A-Z]\w*: |\Z)", text or "", re.DOTALL | re.MULTILINE)
    return " ".join(match[1].replace("`", "").split()) if match else ""
