"""Classes by name: this package's own, and those that installed packages add under an entry-point group."""

import importlib
import inspect
import pkgutil
import threading
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from types import ModuleType
from typing import Any, Generic, TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class Broken:
    """A plug-in that can't be used."""

    group: str
    """The entry-point group, such as "morph.tasks"."""
    name: str
    package: str
    """The distribution that brings it, with its version."""
    reason: str

    def __str__(self) -> str:
        return f'"{self.name}" of {self.package} ({self.group}) can\'t be used: {self.reason}'


class Registry(Generic[T]):
    """The classes of one kind by the name that chooses them.

    Those of this package are found in its folder, one module each; others come from entry points of the group, which
    are loaded when they are first asked for. A plug-in that can't be loaded, that breaks the contract, or whose name
    is taken is listed as broken with the reason, and harms nothing else.
    """

    def __init__(
        self, group: str, kind: type[T], folder: str, first: tuple[str, ...], check: Callable[[type[T]], object]
    ) -> None:
        """`kind` is what each class must be, `folder` the package of our own ones, `first` the names that are
        listed first, `check` raises ValueError for a plug-in that breaks the contract."""
        self.group, self.kind = group, kind
        self._folder, self._first, self._check = folder, first, check
        self._classes: dict[str, type[T]] | None = None
        self._broken: list[Broken] = []
        self._lock = threading.RLock()  # a plug-in may ask for others while it is imported, in the same thread

    def __iter__(self) -> Iterator[str]:
        return iter(self._loaded())

    def __len__(self) -> int:
        return len(self._loaded())

    def __contains__(self, name: object) -> bool:
        return name in self._loaded()

    def __getitem__(self, name: str) -> type[T]:
        """Return the class `name`; ValueError lists the choices, and what is wrong with a plug-in of that name."""
        classes = self._loaded()
        if name in classes:
            return classes[name]
        noun = self.group.removeprefix("morph.").removesuffix("s").replace("searche", "search")
        reasons = "; ".join(str(broken) for broken in self._broken if broken.name == name)
        raise ValueError(
            f'unknown {noun} "{name}"; choose from: {", ".join(classes)}' + (f" ({reasons})" if reasons else "")
        )

    @property
    def broken(self) -> tuple[Broken, ...]:
        """Return the plug-ins that can't be used."""
        self._loaded()
        return tuple(self._broken)

    def add(self, kind: type[T]) -> type[T]:
        """Add a class of this process alone, for a notebook or a test; a trainer process does not see it.

        It can be used as a decorator. Raise ValueError where the name is taken or the contract is broken.
        """
        name = self._name_of(kind)
        if name in self._loaded():
            raise ValueError(f'the name "{name}" is taken in {self.group} by {_place(self._loaded()[name])}')
        self._examine(kind, name)
        self._loaded()[name] = kind
        return kind

    # --- finding them ---

    def _loaded(self) -> dict[str, type[T]]:
        with self._lock:
            if self._classes is None:
                self._classes = own = self._own()
                self._broken = []
                by_name: dict[str, list[EntryPoint]] = {}
                for point in entry_points(group=self.group):
                    by_name.setdefault(point.name, []).append(point)
                for name in sorted(by_name):
                    self._take(name, by_name[name], own)
            return self._classes

    def _own(self) -> dict[str, type[T]]:
        package = importlib.import_module(self._folder)
        modules = (importlib.import_module(m.name) for m in pkgutil.iter_modules(package.__path__, f"{self._folder}."))
        found = [kind for module in modules for kind in self._classes_in(module)]
        by_name = {self._name_of(kind): kind for kind in found}
        return {name: by_name[name] for name in (*self._first, *sorted(by_name.keys() - {*self._first}))}

    def _classes_in(self, module: ModuleType) -> Iterator[type[T]]:
        for value in vars(module).values():
            if inspect.isclass(value) and value.__module__ == module.__name__ and self._is_one(value):
                yield typing.cast(type[T], value)

    def _is_one(self, value: type) -> bool:
        return isinstance(value.__dict__.get("name"), str) and self._inherits(value)

    def _inherits(self, value: type) -> bool:
        """Tell whether a class is a dataclass of this kind; the kind may be a protocol, of which Python can't tell.

        A class that only inherits from a dataclass is none: its own fields would be no settings.
        """
        return "__dataclass_params__" in vars(value) and self.kind in value.__mro__

    @staticmethod
    def _name_of(kind: type) -> str:
        return typing.cast(Any, kind).name

    # --- plug-ins ---

    def _take(self, name: str, points: list[EntryPoint], classes: dict[str, type[T]]) -> None:
        """Load the plug-in `name`, or note why it can't be used."""
        if name in classes:
            for point in points:
                self._refuse(point, f"the name is taken by {_place(classes[name])}")
            return
        if len(points) > 1:
            packages = " and ".join(sorted(_package(point) for point in points))
            for point in points:
                self._refuse(point, f"{packages} have one of this name: uninstall one of them")
            return
        (point,) = points
        try:
            kind = point.load()
            self._examine(kind, name)
        except (Exception, SystemExit) as error:  # whatever another package does when it is imported
            said = isinstance(error, ValueError) and str(error)
            self._refuse(point, said or f"{type(error).__name__}: {error}".removesuffix(": "))
        else:
            classes[name] = kind

    def _refuse(self, point: EntryPoint, reason: str) -> None:
        self._broken.append(Broken(self.group, point.name, _package(point), reason))

    def _examine(self, kind: Any, name: str) -> None:
        """Raise ValueError unless `kind` is a class of this registry's kind under its own name."""
        wanted = f"a frozen dataclass that inherits from {self.kind.__module__}.{self.kind.__name__}"
        if not inspect.isclass(kind) or not self._inherits(kind):
            raise ValueError(f"{kind!r} is not {wanted}")
        found: Any = kind
        if not found.__dataclass_params__.frozen:
            raise ValueError(f"{_place(found)} is not {wanted}")
        if inspect.isabstract(found):
            raise ValueError(f"{_place(found)} lacks {', '.join(sorted(found.__abstractmethods__))}")
        if getattr(found, "name", None) != name:
            raise ValueError(f'{_place(found)} calls itself "{getattr(found, "name", None)}", its entry point "{name}"')
        self._check(found)


def _package(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist else point.value


def _place(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"
