"""Ctrl-C and SIGTERM: a command of the shell ends at once, between two writes, and says where its files stand.

Python's own way is an exception in the main thread. It waits until compiled code returns, which can take minutes, and
then comes anywhere: amid a trace, a callback of the compiler, a call of HDF5. So none is raised here. A thread is told
of the signal, waits for the write in progress, and ends the process with 128 + the signal's number. Between two writes
what is in files is whole (see `_staged`).
"""

import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_NAMES = {"SIGINT": "interrupted", "SIGTERM": "told to end", "SIGHUP": "the terminal was closed"}
_writing = threading.RLock()
_reports: list[Callable[[], str]] = []


@contextmanager
def undisturbed() -> Iterator[None]:
    """No signal ends the process within this block."""
    with _writing:
        yield


@contextmanager
def reporting(report: Callable[[], str]) -> Iterator[None]:
    """A signal that comes within this block is answered with what `report` returns, which another thread calls."""
    _reports.append(report)
    try:
        yield
    finally:
        _reports.remove(report)


def end_on_signals() -> None:
    """From now on SIGINT, SIGTERM and SIGHUP end the process as said above, but for those that are ignored already.

    For commands only: it is called once, in the main thread. A program that uses the package keeps its own handlers.
    """
    woken, waker = socket.socketpair()
    waker.setblocking(False)
    signal.set_wakeup_fd(waker.detach(), warn_on_full_buffer=False)
    told = {getattr(signal, name): what for name, what in _NAMES.items() if hasattr(signal, name)}
    for number in told:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _nothing)
    threading.Thread(target=_wait, args=(woken, told), daemon=True).start()


def _nothing(*_: object) -> None:
    """The handler in the main thread: the other thread does the work."""


def _wait(woken: socket.socket, told: dict[int, str]) -> None:
    number = 0
    while number not in told:
        number = woken.recv(1)[0]
    with undisturbed():
        printed = threading.Thread(target=sys.stdout.flush, daemon=True)  # it may wait for whoever reads
        printed.start()
        printed.join(1.0)
        where = " ".join(report() for report in _reports) or "No file was being written."
        os.write(2, f"mpmjax: {told[number]}. {where}\n".encode())
        os._exit(128 + number)
