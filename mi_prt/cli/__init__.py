"""The command line: mi-prt doctor | info | precompute | relight | compare."""

from .commands import main

__all__ = ["main"]
