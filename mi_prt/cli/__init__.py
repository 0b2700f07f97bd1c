"""The command line: mi-prt doctor | info | precompute | relight | compare."""

from .program import main

__all__ = ["main"]
