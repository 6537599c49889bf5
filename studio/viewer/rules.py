"""The rules of a run in words: how it learns, the task's options, and what counts as success."""

import functools

from morph_core.catalogue import make_task, read_method
from morph_core.history import History
from morph_core.protocol import RunRecord, decode_record, encode
from morph_core.task import Task
from studio.fields import fields_of


def rules_of(history: History) -> list[str]:
    """Return sentences for people; fewer for a run of a task that is not there in this version."""
    return list(_rules_of(encode(history.record)))


@functools.lru_cache(maxsize=64)
def _rules_of(written: bytes) -> tuple[str, ...]:
    """Return the sentences for a record as it is written: they are asked for several times a second."""
    record = decode_record(written)
    try:
        how = read_method(record).rules()
    except ValueError:  # a method of another version, or of a package that is not installed
        how = ""
    lines = [f"Method {record.method}: {how}." if how else f"Method {record.method}."]
    task = _task_of(record)
    options = record.task_options
    if task:  # all that are one of a few words, and those that the run was given
        options = {field.name: field.default for field in fields_of(task) if field.choices} | options
    if options:
        lines.append("Options: " + ", ".join(f"{name} {value}" for name, value in options.items()) + ".")
    return (*lines, f"Success: {task.success_rule}") if task and task.success_rule else tuple(lines)


def _task_of(record: RunRecord) -> Task | None:
    """Return the task of a run; None for one of another version."""
    try:
        return make_task(record.task, record.task_options)
    except (ValueError, TypeError):
        return None
