"""Scene files and the shell's commands."""

from mpmjax.cli._commands import main as main
