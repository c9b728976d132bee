"""`python -m mpmjax.cli`, the shell's command without its script."""

from mpmjax.cli._commands import main

main()
