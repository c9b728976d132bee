"""A small file that is replaced as a whole each time it changes, and has one writer."""

from pathlib import Path

from mpmjax.checks import require
from mpmjax.io._aside import replacing
from mpmjax.io._hdf5 import staged_file
from mpmjax.io._interrupt import undisturbed
from mpmjax.io._staged import StagedFile, fcntl


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
