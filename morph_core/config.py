"""Settings: frozen dataclasses that check themselves, each number with its range beside it."""

import dataclasses
import difflib
import functools
import math
import typing
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, Literal

from msgspec import Meta

Projection = Literal["none", "one_sided", "as_printed"]
Utility = Literal["standardised", "log_rank"]
InitialWeights = Literal["uniform", "orthogonal"]

LARGEST = 2**53 - 1
"""The largest whole number, up to the sign: beyond it browsers and floats no longer tell them apart."""


def most(largest: float, why: str) -> Meta:
    """Return the upper end of a field's range, with the reason for it in words that follow a colon."""
    return Meta(le=largest, description=why)


_ROOM = most(1e6, "what is larger is a slip of the keyboard; a field that needs more says so")
Count = Annotated[int, Meta(ge=1), _ROOM]
CountOrNone = Annotated[int, Meta(ge=0), _ROOM]
Positive = Annotated[float, Meta(gt=0), _ROOM]
NotNegative = Annotated[float, Meta(ge=0), _ROOM]
Share = Annotated[float, Meta(ge=0), most(1, "it is a share")]
Fraction = Annotated[float, Meta(gt=0), most(1, "it is a share")]
LARGEST_WEIGHT = most(1e6, "networks learn returns of order one, in single precision")
"""The upper end of what a term of the reward may weigh."""
LARGEST_ALPHA = 1e6
Alpha = Annotated[
    NotNegative, most(LARGEST_ALPHA, "Eq. 2 is summed in single precision, which would keep nothing of the task")
]
"""What alpha may be, when a run starts and when a user changes it."""


@dataclass(frozen=True)
class Settings:
    """A frozen dataclass that refuses values outside the ranges that its annotations give.

    A field is a number with its range (`Annotated[float, msgspec.Meta(gt=0)]`), one of a few words (`Literal`), or
    again Settings. Where a field can be given several kinds of Settings, such as a search, their `name` chooses.
    """

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if field.init:
                checked = check_value(field.name, kinds_of(type(self))[field.name], getattr(self, field.name))
                object.__setattr__(self, field.name, checked)


@functools.cache
def kinds_of(kind: type) -> Mapping[str, Any]:
    """Return the annotation of every field of a dataclass, its range included."""
    return MappingProxyType(typing.get_type_hints(kind, include_extras=True))  # slow: all settings are checked with it


def range_of(annotation: Any) -> tuple[Any, Meta | None]:
    """Return the bare type of an annotation and its range, if it has one: of several, what a later one says counts."""
    if typing.get_origin(annotation) is not Annotated:
        return annotation, None
    bare, *more = typing.get_args(annotation)
    metas = [m for m in more if isinstance(m, Meta)]
    return bare, functools.reduce(_narrowed, metas) if metas else None


def _narrowed(wide: Meta, narrow: Meta) -> Meta:
    """Return a range with the ends of `narrow`, and those of `wide` where that has none."""
    lower = wide if narrow.ge is None and narrow.gt is None else narrow
    upper = wide if narrow.le is None and narrow.lt is None else narrow
    ends: dict[str, Any] = {"ge": lower.ge, "gt": lower.gt, "le": upper.le, "lt": upper.lt}
    return Meta(**ends, description=upper.description, multiple_of=narrow.multiple_of or wide.multiple_of)


def limits(meta: Meta | None) -> tuple[float | None, float | None]:
    """Return the two ends of a range, whether they are in it or not; None where it has no such end."""
    if meta is None:
        return None, None
    return meta.ge if meta.gt is None else meta.gt, meta.le if meta.lt is None else meta.lt


def check_value(name: str, annotation: Any, value: object) -> object:
    """Return `value` as its annotation has it, a float for a whole number where one belongs.

    Raise ValueError with a sentence that names the field and what is allowed.
    """
    bare, meta = range_of(annotation)
    choices = typing.get_args(bare) if typing.get_origin(bare) is Literal else ()
    if choices:
        if value not in choices:
            words = [str(choice) for choice in choices]
            raise ValueError(f'unknown {name} "{value}"{guess(str(value), words)}; choose from: {", ".join(words)}')
        return value
    if bare not in (int, float):
        if isinstance(bare, type) and bare is not Any and not isinstance(value, bare):
            raise ValueError(f"{name} must be {_a(bare.__name__)}, not {value!r}")
        return value
    if isinstance(value, bool) or not isinstance(value, int if bare is int else int | float):
        raise ValueError(f"{name} must be {'a whole number' if bare is int else 'a number'}, not {value!r}")
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{name} must be finite, not {value}")
    if isinstance(value, int) and abs(value) > LARGEST:
        allowed = _allowed(meta) if meta else f"lie in [-{LARGEST}, {LARGEST}]"
        raise ValueError(f"{name} must {allowed}, not {'more' if value > 0 else 'less'}")
    if meta:
        _check_range(name, meta, value)
    return bare(value)


def guess(word: str, words: Iterable[str]) -> str:
    """Return which of `words` may be meant by one that is none of them, in brackets; "" where none is near."""
    known = {other.lower(): other for other in words}
    begun = [other for other in known if len(word) > 1 and other.startswith(word.lower())]
    near = begun or difflib.get_close_matches(word.lower(), known, 1)
    return f" (did you mean {known[near[0]]}?)" if near else ""


def _check_range(name: str, meta: Meta, value: float) -> None:
    lo, hi = limits(meta)
    below = lo is not None and (value < lo if meta.gt is None else value <= lo)
    above = hi is not None and (value > hi if meta.lt is None else value >= hi)
    if below or above:
        why = f": {meta.description}" if above and meta.description else ""
        raise ValueError(f"{name} must {_allowed(meta)}, not {value:.12g}{why}")
    if meta.multiple_of is not None and value % meta.multiple_of:
        raise ValueError(f"{name} must be a multiple of {meta.multiple_of}, not {value}")


def range_in_signs(meta: Meta | None) -> str:
    """Return a range as a form or a help text shows it: "> 0", "0 to 1"; empty where there is none."""
    lo, hi = limits(meta)
    if meta is None or (lo is None and hi is None):
        return ""
    low, high = (">" if meta.ge is None else "\u2265"), ("<" if meta.le is None else "\u2264")
    ends = [f"{low} {lo:.12g}"] if lo is not None else []
    ends += [f"{high} {hi:.12g}"] if hi is not None else []
    return ", ".join(ends + ([f"a multiple of {meta.multiple_of}"] if meta.multiple_of else []))


def _allowed(meta: Meta) -> str:
    """Return the range in words, to follow "must"."""
    lo, hi = limits(meta)
    if lo is not None and hi is not None:
        return f"lie in {'[' if meta.gt is None else '('}{lo:.12g}, {hi:.12g}{']' if meta.lt is None else ')'}"
    if hi is not None:
        return f"be {'at most' if meta.lt is None else 'below'} {hi:.12g}"
    if lo == 0:
        return "not be negative" if meta.gt is None else "be positive"
    return f"be {'at least' if meta.gt is None else 'above'} {lo:.12g}"


def _a(noun: str) -> str:
    return f"an {noun}" if noun[0] in "AEIOU" else f"a {noun}"


def paths_of(settings: Settings) -> Iterator[tuple[str, object]]:
    """Yield the dotted name and the value of everything that can be set: `search` and `search.ridge` alike."""
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if not field.init:
            continue
        if not isinstance(value, Settings):
            yield field.name, value
            continue
        if hasattr(value, "name"):
            yield field.name, value.name  # pyright: ignore[reportAttributeAccessIssue]
        yield from ((f"{field.name}.{name}", inner) for name, inner in paths_of(value))


def recorded(settings: Settings) -> dict[str, object]:
    """Return the settings as JSON has them: nested, each part that was chosen with its `name`."""
    record: dict[str, object] = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if field.init and isinstance(value, Settings):
            chosen = {"name": value.name} if hasattr(value, "name") else {}  # pyright: ignore[reportAttributeAccessIssue]
            record[field.name] = chosen | recorded(value)
        elif field.init:
            record[field.name] = value
    return record


def flattened(record: dict[str, Any], prefix: str = "") -> dict[str, object]:
    """Return what `recorded` made under dotted names, as `paths_of` has them."""
    flat: dict[str, object] = {}
    for name, value in record.items():
        if isinstance(value, dict):
            flat |= flattened(value, f"{prefix}{name}.")
        else:
            flat[prefix.removesuffix(".") if name == "name" and prefix else prefix + name] = value
    return flat
