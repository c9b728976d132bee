"""`python -m mpmjax`, the shell's command without its script: a file that Python asks for."""

from mpmjax_command import main

main()
