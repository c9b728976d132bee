"""Ctrl-C and SIGTERM: a command of the shell ends at once, between two writes, and says where its files stand.

Python's own way is an exception in the main thread. It waits until compiled code returns, which can take minutes, and
then comes anywhere: amid a trace, a callback of the compiler, a call of HDF5. So none is raised here. A thread is told
of the signal, waits for the write in progress, and ends the process with 128 + the signal's number. Between two writes
what is in files is whole (see `_transactional_file`). What is better ended in good order, such as a fit, asks for it by
`stopping`.
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
_stops: list["Stop"] = []


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


class Stop:
    """A request to stop in good order.

    Args:
        what: what is done about it, as a sentence.
    """

    def __init__(self, what: str):
        self.what = what
        self.ready = False
        """Whether there is anything to keep; as long as not, a signal ends the process at once."""
        self.signal = 0
        """Number of the signal that came; zero if none did."""


@contextmanager
def stopping(what: str) -> Iterator[Stop]:
    """The first signal that comes within this block while its `ready` is set does not end the process: the block is to
    look at `signal` now and then, and to stop. The second one ends the process at once."""
    stop = Stop(what)
    _stops.append(stop)
    try:
        yield stop
    finally:
        _stops.remove(stop)


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
    while number not in told or _postponed(number, told[number]):
        number = woken.recv(1)[0]
    with undisturbed():
        printed = threading.Thread(target=sys.stdout.flush, daemon=True)  # it may wait for whoever reads
        printed.start()
        printed.join(1.0)
        where = " ".join(report() for report in _reports) or "No file was being written."
        os.write(2, f"mpmjax: {told[number]}. {where}\n".encode())
        os._exit(128 + number)


def _postponed(number: int, told: str) -> bool:
    """Whether the process is left to stop in good order."""
    for stop in list(_stops):
        if stop.ready and not stop.signal:
            stop.signal = number
            os.write(2, f"mpmjax: {told}. {stop.what}\n".encode())
            return True
    return False
