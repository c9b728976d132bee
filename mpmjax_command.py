"""Where the shell's `mpmjax` begins. Outside of the package, whose import takes seconds in which Ctrl-C should end the
command as quietly as SIGTERM does, and not with a traceback of what was being imported."""

import signal


def main() -> None:
    """Entry point of the `mpmjax` command."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from mpmjax.cli import main as command  # which sets its own handlers

    command()


if __name__ == "__main__":  # `python -m mpmjax_command`, the command without its script
    main()
