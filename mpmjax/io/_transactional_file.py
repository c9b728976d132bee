"""Files that are whole at every moment, also when the disk is full or a signal ends the process.

`replacing` writes a new file aside and puts it in its place. A `StagedFile` changes by commits: all of what was written
since the last one, or nothing; and one writer at a time. HDF5 writes as it sees fit, also while it closes, and what a
full disk refuses then is lost in silence. So it writes to memory, and a commit puts that on the disk: what lengthens
the file first, since this is where room runs out, then what lies within it. If the disk refuses, it is made as it was.

On Ctrl-C and SIGTERM a command of the shell ends at once, between two writes, and says where its files stand. Python's
exception would wait until compiled code returns, and then come amid a trace or a call of HDF5. So a thread is told of
the signal, waits for the write in progress, and ends the process with 128 + the signal's number. What is better ended
in good order, such as a fit, asks for it by `stopping`.
"""

import io
import os
import re
import signal
import socket
import struct
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpmjax.checks import require

try:
    import fcntl
except ImportError:  # a system without POSIX's locks: two writers are not told from one
    fcntl = None

_BUSY = "{} is being written by another run: wait until that ends or stop it, or choose another name."
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


@dataclass
class Stop:
    """A request to stop in good order."""

    what: str  # a sentence on what is done about it
    ready: bool = False  # whether there is anything to keep; as long as not, a signal ends the process at once
    signal: int = 0  # number of the signal that came; zero if none did


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
            signal.signal(number, lambda *_: None)  # the other thread does the work

    def wait() -> None:
        while True:
            if (number := woken.recv(1)[0]) not in told:
                continue
            stop = next((s for s in list(_stops) if s.ready and not s.signal), None)
            if stop is None:
                break
            stop.signal = number  # and the process is left to stop in good order
            os.write(2, f"mpmjax: {told[number]}. {stop.what}\n".encode())
        with undisturbed():
            printed = threading.Thread(target=sys.stdout.flush, daemon=True)  # it may wait for whoever reads
            printed.start()
            printed.join(1.0)
            where = " ".join(report() for report in _reports) or "No file was being written."
            os.write(2, f"mpmjax: {told[number]}. {where}\n".encode())
            os._exit(128 + number)

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield the name under which to write the file. At every moment `path` is what it was or the whole new file. A
    place that cannot be written is a ValueError; what the disk refuses an OSError, and `path` is what it was."""
    aside = path.resolve().with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")

    def dropped() -> str:
        aside.unlink(missing_ok=True)
        return f"{path} was not written."

    try:
        aside.touch()
    except OSError as error:
        raise ValueError(f"{path} cannot be written ({reason(error)}): name a place that can be.") from None
    with reporting(dropped):
        try:
            yield aside
            with open(aside, "rb+") as file:
                os.fsync(file.fileno())
            with undisturbed():
                os.replace(aside, path.resolve())
        except OSError as error:
            raise OSError(f"{path} could not be written: {reason(error).rstrip('.')}. It is as it was.") from None
        finally:
            aside.unlink(missing_ok=True)


def save_figure(figure: Any, path: Path, dpi: float | int) -> None:
    """Write a figure of matplotlib, of the kind that the suffix says, PNG where there is none (see `replacing`). It
    is drawn in memory first: matplotlib's writers do not all report what the disk refuses."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format=path.suffix[1:] or "png", dpi=dpi)
    with replacing(path) as aside:
        aside.write_bytes(drawn.getbuffer())


def reason(error: BaseException) -> str:
    """The system's message of an error, or the first line of the library's."""
    text = (isinstance(error, OSError) and error.strerror) or str(error) or type(error).__name__
    match = re.search(r"error message = '(.*?)'", text)
    return match[1] if match else text.splitlines()[0].strip("'\"")


class StagedFile(io.RawIOBase):
    """A file object for h5py that stages all changes in memory, on top of an existing file. A context manager: leaving
    it drops what was not committed."""

    def __init__(self, path: Path):
        """Open a file and lock it for writing while the process lives; `ValueError`s say why not. Readers are free."""
        try:
            self._raw = open(path, "r+b", buffering=0)  # noqa: SIM115 (closed by `close`)
            try:
                _lock(self._raw.fileno(), shared=False)
            except BaseException:
                self._raw.close()
                raise
        except BlockingIOError:
            raise ValueError(_BUSY.format(path)) from None
        except OSError as error:
            raise ValueError(f"{path} cannot be written ({reason(error)}): name a place that can be.") from None
        self._at = 0
        self._drop()

    def _drop(self) -> None:
        """Forget what is staged."""
        self._size = self._base = self._length = os.fstat(self._raw.fileno()).st_size
        self._writes: list[tuple[int, bytes]] = []  # in their order, over the disk's bytes up to `_base`, then zeros

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a position."""
        self._at = {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._length}[whence] + offset
        return self._at

    def readinto(self, into: Any) -> int:
        """Read into a buffer; bytes beyond the end are zero."""
        view, begin = memoryview(into).cast("B"), self._at
        end = self._at = begin + len(view)
        view[:] = self._stored(begin, min(end, self._base) - begin).ljust(len(view), b"\0")
        for at, data in self._writes:
            low, high = max(begin, at), min(end, at + len(data))
            if low < high:
                view[low - begin : high - begin] = data[low - at : high - at]
        return len(view)

    def write(self, data: Any) -> int:
        """Stage bytes at the position."""
        staged = bytes(memoryview(data).cast("B"))
        if staged:
            self._writes.append((self._at, staged))
            self._at += len(staged)
            self._length = max(self._length, self._at)
        return len(staged)

    def truncate(self, size: int | None = None) -> int:
        """Stage the file's length."""
        size = self._at if size is None else size
        self._base, self._length = min(self._base, size), size
        self._writes = [(at, data[: size - at]) for at, data in self._writes if at < size]
        return size

    def commit(self) -> None:
        """Bring the file up to date; an OSError if the disk refuses: the file is as it was, what was staged is lost."""
        with undisturbed():
            size, grown = self._size, bytearray(max(0, self._length - self._size))
            self.seek(size)
            self.readinto(grown)  # what lengthens the file comes first: this is where room runs out
            inside = [(self._base, bytes(max(0, min(self._length, size) - self._base)))]  # cut off, and grown again
            inside += [(at, data[: size - at]) for at, data in self._writes if at < size]
            before = [(at, self._stored(at, len(data))) for at, data in inside]
            try:
                for at, data in [(size, grown), *inside]:
                    self._put(at, data)
                self._raw.truncate(self._length)
            except BaseException:
                with suppress(OSError):
                    self._raw.truncate(size)
                    for at, data in before:
                        self._put(at, data)
                raise
            finally:
                self._drop()

    def is_at(self, path: Path) -> bool:
        """Whether the open file is the one that has this name. A file that is removed or replaced stays open for its
        writer, who does not notice otherwise."""
        try:
            return os.path.samestat(os.fstat(self._raw.fileno()), os.stat(path))
        except (OSError, ValueError):  # no such name, or closed
            return False

    def sync(self) -> None:
        """Wait until what was committed is on the disk."""
        os.fsync(self._raw.fileno())

    def close(self) -> None:
        """Close the file, without what was not committed. HDF5 may still write to the object, for nothing."""
        self._raw.close()

    def _stored(self, at: int, size: int) -> bytes:
        """The bytes of the file on the disk at a position, as far as it has them."""
        parts, left = [], 0 if self._raw.closed else size
        if left > 0:
            self._raw.seek(at)
        while left > 0 and (part := self._raw.read(left)):
            parts.append(part)
            left -= len(part)
        return b"".join(parts)

    def _put(self, at: int, data: bytes | bytearray) -> None:
        self._raw.seek(at)
        view = memoryview(data)
        while len(view):
            view = view[self._raw.write(view) :]


def require_no_writer(path: Path) -> None:
    """Raise `ValueError` if a `StagedFile` is open on that file, here or in another process."""
    try:
        with open(path, "rb", buffering=0) as raw:
            _lock(raw.fileno(), shared=True)
    except BlockingIOError:
        raise ValueError(_BUSY.format(path)) from None
    except OSError:
        return  # whoever opens it next says why it cannot


def _lock(file: int, *, shared: bool) -> None:
    """Lock an open file until it is closed; a BlockingIOError if another has it.

    On Linux the lock is one of open file descriptions, which HDF5's in other programs do not meet: ParaView can open a
    run that is being written. Elsewhere it is `flock`. File systems that know no locks are written without one."""
    if fcntl is None:
        return
    try:
        if hasattr(fcntl, "F_OFD_SETLK"):
            kind = fcntl.F_RDLCK if shared else fcntl.F_WRLCK
            whole = struct.pack("hhqqi", kind, os.SEEK_SET, 0, 0, 0)  # struct flock
            fcntl.fcntl(file, fcntl.F_OFD_SETLK, whole)
        else:
            fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        return


class ReplacedFile:
    """A file that holds all of its last `write` at every moment. A context manager: leaving it unlocks the file."""

    def __init__(self, path: Path, *, new: bool):
        """Lock a file that is there, or with `new` the one that the first `write` makes; a ValueError says why not."""
        if new:
            require(not path.exists(), f"{path} exists: choose another name, remove it, or ask to resume it.")
            require(path.resolve().parent.is_dir(), f"{path} cannot be written (no folder {path.parent}).")
        self._path, self._lock = path, None if new else _locked(path)

    def write(self, data: bytes) -> None:
        """Replace what the file holds; an OSError, and no change, if the disk refuses or another file has the name."""
        if self._lock is not None and self._path.exists() and not self._lock.is_at(self._path):
            raise OSError(f"{self._path} was replaced by another file while it was written: choose another name.")
        with undisturbed():
            with replacing(self._path) as aside:
                aside.write_bytes(data)
                lock = _locked(aside)  # of the file that is about to have the name
            self.close()
            self._lock = lock

    def close(self) -> None:
        """Give up the lock."""
        if self._lock is not None:
            self._lock.close()

    def __enter__(self) -> "ReplacedFile":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _locked(path: Path) -> StagedFile | None:
    """The file, open and locked; None on a system without locks, where no file can replace an open one."""
    held = StagedFile(path)
    if fcntl is not None:
        return held
    held.close()
    return None
