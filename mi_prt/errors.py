"""Typed errors.

Every message gives the offending value, the limit it broke and the remedy, in one line.
"""


class PrtError(Exception):
    """Base of all errors that mi_prt raises on purpose. The CLI exits with code 1."""

    exit_code = 1


class RuntimeSetupError(PrtError):
    """The machine lacks something mi_prt needs: a usable LLVM, an OpenGL platform, a Mitsuba
    variant.
    """


class InputError(PrtError, ValueError):
    """What the user passed cannot be used. The CLI exits with code 2."""

    exit_code = 2


class SceneError(InputError):
    """A scene that is missing, malformed, empty, or changed since its asset was made."""


class LightError(InputError):
    """Lighting that is missing, unreadable or physically meaningless (NaN, Inf, negative
    energy).
    """


class AssetError(InputError):
    """An asset file that is missing, truncated, foreign, or of an unknown format version."""


class SettingsError(InputError):
    """A setting out of its range, or an output path that cannot be written."""
