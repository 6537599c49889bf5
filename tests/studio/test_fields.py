"""A dataclass as the fields of a form: which of them are a choice."""

import ast
import threading
import time
from dataclasses import dataclass
from typing import Any, Literal

import pytest

from studio.fields import docs_of, fields_of


@dataclass(frozen=True)
class Options:
    """Options of a task as another package may write them."""

    colour: Literal["red", "blue"] = "red"
    goal: tuple[float, float] = (3.0, 1.4)
    names: list[str] | None = None


def test_only_one_of_a_few_words_is_a_choice() -> None:
    assert {field.name: field.choices for field in fields_of(Options())} == {
        "colour": ["red", "blue"], "goal": None, "names": None,
    }  # fmt: skip


def test_two_browsers_that_come_at_once_read_one_source_after_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python 3.11 raises SystemError where two threads make a syntax tree at once, and a page would stay empty."""
    inside, most, parse = [0], [0], ast.parse

    def slowly(*words: Any, **more: Any) -> Any:
        inside[0] += 1
        most[0] = max(most[0], inside[0])
        time.sleep(0.01)
        inside[0] -= 1
        return parse(*words, **more)

    monkeypatch.setattr("ast.parse", slowly)
    readers = [threading.Thread(target=docs_of.__wrapped__, args=(Options,)) for _ in range(4)]
    for reader in readers:
        reader.start()
    for reader in readers:
        reader.join()
    assert most == [1]
