"""A dataclass as the fields of a form: which of them are a choice."""

from dataclasses import dataclass
from typing import Literal

from studio.fields import fields_of


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
