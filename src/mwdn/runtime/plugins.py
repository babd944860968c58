"""Names that other packages add: networks, solvers, masks and cameras, through entry points (docs/plugins.md)."""

import inspect
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from mwdn.errors import MwdnError, ParameterError, PluginError, reason

Entry = TypeVar("Entry")


class Registry(Mapping[str, Entry]):
    """Entries by name: those of this package, then those of installed plugins.

    Plugins are looked up only where a name is not one of this package, or where all names are listed: reading the entry
    points of all installed packages takes some hundredths of a second, and the import of a plugin any time. A list
    leaves out plugins that cannot be loaded, each with one warning.

    Args:
        own: of this package. A plugin cannot replace them.
        group: of the entry points: ``mwdn.solvers``.
        accepts: whether an object may be an entry.
        must_be: the same in words, for the message.
        reserved: further names that no plugin can have, of other things that are named in the same places.
    """

    def __init__(
        self,
        own: Mapping[str, Entry],
        group: str,
        *,
        accepts: Callable[[Any], bool],
        must_be: str,
        reserved: frozenset[str] = frozenset(),
    ) -> None:
        self.own, self.group, self._accepts, self._must_be, self._reserved = own, group, accepts, must_be, reserved
        self._loaded: dict[str, Entry] = {}
        self._broken: set[str] = set()

    @cached_property
    def _points(self) -> dict[str, EntryPoint]:
        """Entry points of plugins by name. Of two with the same name, the alphabetically first package's is used."""
        points: dict[str, EntryPoint] = {}
        for point in sorted(entry_points(group=self.group), key=lambda point: (point.name, _package(point))):
            is_own = point.name in {*self.own, *self._reserved}
            owner = "mwdn" if is_own else _package(points.get(point.name))
            if not owner:
                points[point.name] = point
            elif owner != _package(point):
                warnings.warn(
                    f"`{point.name}` in `{self.group}` of the package `{_package(point)}` is ignored: `{owner}` has "
                    "this name already.",
                    stacklevel=2,
                )
        return points

    def __contains__(self, name: object) -> bool:
        return name in self.own or name in self._points

    def __getitem__(self, name: str) -> Entry:
        """The entry of a name.

        Raises:
            KeyError: there is none.
            ParameterError: it is a plugin's, and cannot be loaded.
        """
        if name in self.own:
            return self.own[name]
        if name not in self._loaded:
            self._loaded[name] = self._load(self._points[name])
        return self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        yield from self.own
        for name in self._points:
            if name in self._broken:
                continue
            try:
                _ = self[name]
            except ParameterError as error:
                self._broken.add(name)
                warnings.warn(str(error), stacklevel=2)
            else:
                yield name

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def refresh(self) -> None:
        """Look for plugins again, for instance after one was installed."""
        vars(self).pop("_points", None)
        self._loaded.clear()
        self._broken.clear()

    def _load(self, point: EntryPoint) -> Entry:
        package = _package(point)
        start = f"`{point.name}` in `{self.group}` of the package `{package}` cannot be used:"
        end = f"Update it, or remove it: `pip uninstall {package}`."
        try:
            entry = point.load()
        except (Exception, SystemExit) as error:  # the import of another package can raise anything
            raise ParameterError(f"{start} {type(error).__name__}: {reason(error)}. {end}") from error
        if not self._accepts(entry):
            raise ParameterError(f"{start} `{point.value}` must be {self._must_be}. {end}")
        return entry


def check_complete(entry: Callable[..., Any], what: str, options: Mapping[str, Any]) -> None:
    """Check that the options of a class or a function hold all its arguments without a default, as plugins may have.

    Raises:
        ParameterError: one is missing.
    """
    for name, argument in inspect.signature(entry).parameters.items():
        can_be_named = argument.kind in (argument.KEYWORD_ONLY, argument.POSITIONAL_OR_KEYWORD)
        if can_be_named and argument.default is argument.empty and name not in options:
            raise ParameterError(f"`{name}` of {what} is missing: it has no default.")


@contextmanager
def plugin_errors(name: str, of: Callable[..., Any]) -> Iterator[None]:
    """Turn an error of a plugin's own code into one that names the plugin.

    Errors of mwdn's own classes, and those of a lack of memory, are raised unchanged.

    Args:
        name: of the plugin, or of what is made with it.
        of: class or function whose code runs.

    Raises:
        PluginError: the plugin raised an error, or wanted to end the process.
    """
    try:
        yield
    except MwdnError:
        raise
    except (Exception, SystemExit) as error:
        from mwdn.runtime.devices import is_out_of_memory  # which imports torch

        if of.__module__.partition(".")[0] == "mwdn" or is_out_of_memory(error):
            raise
        text = f"The plugin `{name}` (module `{of.__module__}`) failed: {type(error).__name__}: {reason(error)}."
        raise PluginError(text) from error


def _package(point: EntryPoint | None) -> str:
    """Name of the package that an entry point belongs to; empty for none."""
    return "" if point is None else point.dist.name if point.dist else point.value
