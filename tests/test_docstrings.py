"""Every docstring stands alone: help(), --help and forms show it without the name above it in the source."""

import ast
import importlib
import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("morph_core", "studio")
MODULES = sorted(
    path.relative_to(ROOT)
    for package in PACKAGES
    for path in (ROOT / package).rglob("*.py")
    if path.name != "__main__.py" and (path.parent / "__init__.py").is_file()
)
PREFIX = re.compile(r"(\([\w, ()*+-]+\) )?([\w/^²]+: )?")
"""Shape, and a symbol or a unit with a colon, which may stand before a sentence."""
CODE = re.compile(r"[`/\"]|\w+(_\w|\.\w|\()")
FRAGMENT = re.compile(r"(Of|By|For|In|On|At|As|With|Along|Times|Than|Which|Are|Is|Its|The same)\b", re.IGNORECASE)
"""First words that continue the name of a field or a function, so that the sentence can't be read without it."""

QUESTION = re.compile(r"(What|How|Where|Which|When|Who)\b")
"""First words of a clause, which names neither a number nor its unit: "How far" is a distance, "How much" a share."""


def _fault(docstring: str | None) -> str | None:
    """Return why a docstring does not stand alone, or None."""
    text = (docstring or "").strip()
    prefix = PREFIX.match(text)
    sentence = text[prefix.end() :] if prefix else text
    if not text:
        return "has no docstring"
    if sentence == text and not text[0].isupper() and not CODE.match(text):
        return "begins with neither a capital letter nor code"
    if FRAGMENT.match(sentence) or len(sentence.split()) < 2:
        return "is the rest of a sentence, a shape or a unit"
    return None if text.endswith(".") else "does not end with a full stop"


def _members(module: ModuleType) -> Iterator[tuple[str, str | None]]:
    """Yield the public classes, functions and methods of a module with what help() says of them."""
    for name, item in vars(module).items():
        if name.startswith("_") or getattr(item, "__module__", None) != module.__name__:
            continue
        if inspect.isclass(item):
            own = "" if (item.__doc__ or "").startswith(f"{name}(") else item.__doc__  # a dataclass's own signature
            yield name, own
            yield from (
                (f"{name}.{member}", _inherited(item, member)) for member in vars(item) if _is_told(item, member)
            )
        elif inspect.isroutine(item) or hasattr(item, "__wrapped__"):
            yield name, item.__doc__


def _is_told(owner: type, member: str) -> bool:
    item = vars(owner)[member]
    kinds = (property, classmethod, staticmethod)
    return not member.startswith("_") and (inspect.isfunction(item) or isinstance(item, kinds) or hasattr(item, "func"))


def _inherited(owner: type, member: str) -> str | None:
    """Return the docstring that help() shows; one from another library is that library's."""
    ours = {*PACKAGES, owner.__module__.split(".")[0]}
    for base in owner.__mro__:
        docstring = getattr(vars(base).get(member), "__doc__", None)
        if docstring:
            return docstring if base.__module__.split(".")[0] in ours else "Inherited from another library."
    return None


def _fields(body: list[ast.stmt], owner: str = "") -> Iterator[tuple[str, ast.expr | None, str]]:
    """Yield the constants and fields that have a docstring under them: name, value and docstring."""
    for statement, below in zip(body, [*body[1:], None], strict=True):
        match statement, below:
            case ast.ClassDef(name=name, body=inner), _:
                yield from _fields(inner, f"{owner}{name}.")
            case (
                (ast.Assign(targets=[target], value=value) | ast.AnnAssign(target=target, value=value)),
                ast.Expr(value=ast.Constant(value=str(docstring))),
            ):
                yield owner + ast.unparse(target), value, docstring


def _quantity_fault(value: ast.expr | None, docstring: str) -> str | None:
    """Return why the docstring of a number or a pattern does not say what it is, or None."""
    if value and _is_number(value) and QUESTION.match(docstring):
        return "begins with a question word where a number's quantity belongs"
    if value and ast.unparse(value).startswith("re.compile(") and not re.search(r"\b[Pp]attern", docstring):
        return "does not say that it is a pattern"
    return None


def _is_number(value: ast.expr) -> bool:
    """Tell whether an expression is made of numbers alone: one, several, or what comes of some."""
    nodes = list(ast.walk(value))
    constants = [node.value for node in nodes if isinstance(node, ast.Constant)]
    others = (ast.Name, ast.Call, ast.Dict, ast.List, ast.Set)
    return {type(constant) for constant in constants} in ({int}, {float}, {int, float}) and not any(
        isinstance(node, others) for node in nodes
    )


def _faults(path: Path) -> list[str]:
    source = (ROOT / path).read_text()
    module = importlib.import_module(".".join(path.with_suffix("").parts).removesuffix(".__init__"))
    fields = list(_fields(ast.parse(source).body))
    told = [(str(path), module.__doc__), *_members(module), *((name, docstring) for name, _, docstring in fields)]
    faults = [f"{name} {fault}: {docstring}" for name, docstring in told if (fault := _fault(docstring))]
    unnamed = ((name, _quantity_fault(value, docstring), docstring) for name, value, docstring in fields)
    return [*faults, *(f"{name} {fault}: {docstring}" for name, fault, docstring in unnamed if fault)]


@pytest.mark.parametrize("path", MODULES, ids=map(str, MODULES))
def test_every_docstring_of_a_module_stands_alone(path: Path) -> None:
    assert _faults(path) == []


@pytest.mark.parametrize(
    ("docstring", "fault"),
    [
        ("Radius of the palm in metres.", None),
        ("`send` is called with the commands.", None),
        ("(N, 3) m: corners of the box.", None),
        ("K: iterations between two searches for phi.", None),
        ("pi_theta(a | s) is a normal distribution.", None),
        ("", "has no docstring"),
        ("names of the parts.", "begins with neither a capital letter nor code"),
        ("Of the zip.", "is the rest of a sentence, a shape or a unit"),
        ("kg: of the mouse.", "is the rest of a sentence, a shape or a unit"),
        ("(N,) bool.", "is the rest of a sentence, a shape or a unit"),
        ("The same at the end.", "is the rest of a sentence, a shape or a unit"),
        ("Radius of the palm", "does not end with a full stop"),
    ],
)
def test_a_docstring_that_does_not_stand_alone_is_found(docstring: str, fault: str | None) -> None:
    assert _fault(docstring) == fault


@pytest.mark.parametrize(
    ("statement", "fault"),
    [
        ("AIR = 0.1", "begins with a question word where a number's quantity belongs"),
        ("AIR: float = -2.0", "begins with a question word where a number's quantity belongs"),
        ("AIR, ABOVE = (1.0, 2 * 3.5)", "begins with a question word where a number's quantity belongs"),
        ('AIR = "0.1"', None),
        ("AIR = re.compile('x')", "does not say that it is a pattern"),
    ],
)
def test_a_number_that_is_called_by_a_question_is_found(statement: str, fault: str | None) -> None:
    ((_, value, docstring),) = _fields(ast.parse(f'{statement}\n"""How far it is."""').body)
    assert _quantity_fault(value, docstring) == fault
    assert _quantity_fault(value, "m: distance, and the pattern of its name.") is None


def test_public_members_without_a_docstring_are_found() -> None:
    told = dict(_members(importlib.import_module(__name__)))
    assert told["Silent"] == ""
    assert told["Silent.area"] is None
    assert told["Silent.width"] == "Width of the thing in metres."
    assert not {"_fault", "Path"} & set(told)


@dataclass
class Silent:
    side: float

    @property
    def width(self) -> float:
        """Width of the thing in metres."""
        return self.side

    def area(self) -> float:
        return self.side**2
