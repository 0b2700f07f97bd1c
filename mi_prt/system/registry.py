"""Kinds of a thing by name: bases, lights, layouts, transports, material models, output formats.

A kind is one file with one registration. The files of the registry's own package are found by
themselves, those of other projects through their entry points in the group `mi_prt.plugins` (each
names a module, which registers when it is imported).
"""

import importlib
import importlib.metadata
import pkgutil
import reprlib
from collections.abc import Mapping

from ..errors import SettingsError

ENTRY_POINTS = "mi_prt.plugins"


class Registry(Mapping):
    """Kinds by name.

    Parameters
    ----------
    what : str
        What the kinds are, in errors: "basis".
    package : str
        Absolute name of the package whose modules hold the kinds; all of them are imported before
        the first look-up.
    error : type
        Raised for an unknown name, an `InputError`.
    """

    def __init__(self, what, package, error: type[Exception] = SettingsError):
        self._what, self._package, self._error = what, package, error
        self._kinds, self._complete = {}, False

    def register(self, kind):
        """Add a kind under its attribute `kind`; returns it, so that this is a decorator of
        classes.
        """
        self._kinds[kind.kind] = kind
        return kind

    def add(self, name):
        """A decorator that adds a function or object under a name."""

        def register(entry):
            self._kinds[name] = entry
            return entry

        return register

    def restore(self, kinds):
        """Hold these kinds, a dict by name, and no others; for tests of what is registered."""
        self._kinds = dict(kinds)

    def __getitem__(self, name):
        """The kind of a name.

        Raises
        ------
        InputError
            Of the registry's type, with the names that there are.
        """
        self._import()
        if not isinstance(name, str) or name not in self._kinds:
            shown = reprlib.repr(name)  # of a hostile file: any text
            raise self._error(f"{self._what} {shown} is not known: use {', '.join(self)}")
        return self._kinds[name]

    def __contains__(self, name):
        self._import()
        return name in self._kinds

    def __iter__(self):
        self._import()
        return iter(sorted(self._kinds))

    def __len__(self):
        self._import()
        return len(self._kinds)

    def _import(self):
        if self._complete:
            return
        self._complete = True  # before the imports: they may look kinds up themselves
        package = importlib.import_module(self._package)
        for module in pkgutil.iter_modules(package.__path__):
            importlib.import_module(f"{self._package}.{module.name}")
        load_plugins()


_plugins_loaded = False


def load_plugins():
    """Import what other projects register through entry points, once."""
    global _plugins_loaded
    if not _plugins_loaded:
        _plugins_loaded = True
        for plugin in importlib.metadata.entry_points(group=ENTRY_POINTS):
            plugin.load()
