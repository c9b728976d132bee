"""Scene files and the shell's commands."""

from mpmjax.cli._commands import main

__all__ = ["main"]
