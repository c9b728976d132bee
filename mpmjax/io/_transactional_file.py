"""A file that changes by commits: all of what was written since the last one, or nothing; and one writer at a time.

HDF5 writes as it sees fit, also while it closes, and what a full disk refuses then is lost in silence. So it writes to
memory, and a commit puts that on the disk: what lengthens the file first, since this is where room runs out, then what
lies within it. If the disk refuses, the file is made what it was.
"""

import os
import struct
from contextlib import suppress
from pathlib import Path
from typing import Any

from mpmjax.checks import require
from mpmjax.io._atomic_write import reason, replacing
from mpmjax.io._interrupt import undisturbed

try:
    import fcntl
except ImportError:  # a system without POSIX's locks: two writers are not told from one
    fcntl = None

_PAGE = 4096
BUSY = "{} is being written by another run: wait until that ends or stop it, or choose another name."


class StagedFile:
    """A file object for h5py that stages all changes in memory, on top of an existing file.

    A context manager: leaving it drops what was not committed.
    """

    def __init__(self, path: Path):
        """Open a file and lock it for writing. The lock goes with the process, however that ends; readers are free.

        Raises:
            BlockingIOError: another writer is at it.
            OSError: it cannot be opened.
        """
        self._raw = open(path, "r+b", buffering=0)  # noqa: SIM115 (closed by `close`)
        try:
            _lock(self._raw.fileno(), shared=False)
        except BaseException:
            self._raw.close()
            raise
        self._at = 0
        self._drop()

    def _drop(self) -> None:
        """Forget what is staged."""
        self._size = os.fstat(self._raw.fileno()).st_size
        self._base = self._size  # up to here the file holds, but for pages; from here on it is the tail
        self._pages: dict[int, bytearray] = {}
        self._tail = bytearray()

    # What h5py calls

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a position."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._base + len(self._tail)}
        self._at = start[whence] + offset
        return self._at

    def tell(self) -> int:
        """The position."""
        return self._at

    def read(self, size: int) -> bytes:
        """Read a number of bytes; those beyond the end are zero."""
        into = bytearray(size)
        self.readinto(into)
        return bytes(into)

    def readinto(self, into: Any) -> int:
        """Read into a buffer; bytes beyond the end are zero."""
        view, begin = memoryview(into).cast("B"), self._at
        end = self._at = begin + len(view)
        inside = max(0, min(end, self._base) - begin)
        view[:] = self._stored(begin, inside).ljust(len(view), b"\0")
        for number in self._touched(begin, begin + inside):
            if number in self._pages:
                low, high = max(begin, number * _PAGE), min(begin + inside, (number + 1) * _PAGE)
                view[low - begin : high - begin] = self._pages[number][low % _PAGE :][: high - low]
        if end > self._base:
            first = begin + inside - self._base
            part = self._tail[first : first + len(view) - inside]
            view[inside : inside + len(part)] = part
        return len(view)

    def write(self, data: Any) -> int:
        """Stage bytes at the position."""
        view, begin = memoryview(data).cast("B"), self._at
        end = self._at = begin + len(view)
        inside = max(0, min(end, self._base) - begin)
        for number in self._touched(begin, begin + inside):
            low, high = max(begin, number * _PAGE), min(begin + inside, (number + 1) * _PAGE)
            if number not in self._pages:
                self._pages[number] = bytearray(self._stored(number * _PAGE, _PAGE))
            self._pages[number][low % _PAGE : low % _PAGE + high - low] = view[low - begin : high - begin]
        if end > self._base:
            first, rest = begin + inside - self._base, view[inside:]
            self._tail += bytes(max(0, first - len(self._tail)))
            overlap = min(len(self._tail) - first, len(rest))
            with memoryview(self._tail) as tail:
                tail[first : first + overlap] = rest[:overlap]
            self._tail += rest[overlap:]
        return len(view)

    def truncate(self, size: int) -> int:
        """Stage the file's length."""
        if size < self._base:
            self._base, self._tail = size, bytearray()
            self._pages = {number: page for number, page in self._pages.items() if number * _PAGE < size}
        tail = size - self._base
        del self._tail[tail:]
        self._tail += bytes(tail - len(self._tail))
        return size

    def flush(self) -> None:
        """Do nothing: only `commit` writes."""

    # What its owner calls

    def commit(self) -> None:
        """Bring the file up to date.

        Raises:
            OSError: the disk refused; the file is what it was, and what was staged is lost.
        """
        with undisturbed():
            parts: list[tuple[int, bytes | bytearray]] = [(self._base, self._tail)]
            for number, page in sorted(self._pages.items()):
                parts.append((number * _PAGE, page[: self._base - number * _PAGE]))
            before = [(at, self._stored(at, min(len(data), self._size - at))) for at, data in parts if at < self._size]
            try:
                for at, data in parts:
                    self._put(at, data)
                self._raw.truncate(self._base + len(self._tail))
            except BaseException:
                with suppress(OSError):
                    self._raw.truncate(self._size)
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
        """Wait until what was committed is on the disk.

        Raises:
            OSError: it cannot be brought there.
        """
        os.fsync(self._raw.fileno())

    def close(self) -> None:
        """Close the file, without what was not committed."""
        self._raw.close()

    def __enter__(self) -> "StagedFile":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _stored(self, at: int, size: int) -> bytes:
        """The bytes of the file on the disk at a position, as far as it has them."""
        self._raw.seek(at)
        parts, left = [], size
        while left > 0 and (part := self._raw.read(left)):
            parts.append(part)
            left -= len(part)
        return b"".join(parts)

    def _put(self, at: int, data: bytes | bytearray) -> None:
        self._raw.seek(at)
        view = memoryview(data)
        while len(view):
            view = view[self._raw.write(view) :]

    @staticmethod
    def _touched(begin: int, end: int) -> range:
        """The pages that hold the bytes from `begin` up to `end`."""
        return range(begin // _PAGE, -(-end // _PAGE) if end > begin else begin // _PAGE)


def require_no_writer(path: Path) -> None:
    """Raise `BlockingIOError` if a `StagedFile` is open on that file, here or in another process."""
    with open(path, "rb", buffering=0) as raw:
        _lock(raw.fileno(), shared=True)


def _lock(file: int, *, shared: bool) -> None:
    """Lock an open file until it is closed.

    On Linux the lock is one of open file descriptions, which the locks that HDF5 takes in other programs do not meet,
    so that ParaView can open a run that is being written. Elsewhere it is `flock`, and such a program may have to wait.
    File systems that know no locks are written without one.

    Raises:
        BlockingIOError: another has it.
    """
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


def staged_file(path: Path) -> StagedFile:
    """The file, locked and ready to be changed."""
    try:
        return StagedFile(path)
    except BlockingIOError:
        raise ValueError(BUSY.format(path)) from None
    except OSError as error:
        raise ValueError(f"{path} cannot be written ({reason(error)}): name a place that can be.") from None


class ReplacedFile:
    """A file that holds all of its last `write`, at every moment, however the process ends.

    A context manager: leaving it gives up the lock.
    """

    def __init__(self, path: Path, *, new: bool):
        """Take the lock of a file that is there; with `new`, of one that the first `write` makes.

        Raises:
            ValueError: with `new`, a file that is there, or no folder; else one that cannot be written or is being
                written.
        """
        if new:
            require(not path.exists(), f"{path} exists: choose another name, remove it, or ask to resume it.")
            require(path.resolve().parent.is_dir(), f"{path} cannot be written (no folder {path.parent}).")
        self._path, self._lock = path, None if new else _locked(path)

    def write(self, data: bytes) -> None:
        """Replace what the file holds.

        Raises:
            OSError: the disk refused, or another file has the name; that is what it was.
        """
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
    held = staged_file(path)
    if fcntl is not None:
        return held
    held.close()
    return None
