"""Files written aside and put in their place when they are whole."""

import io
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mpmjax.io._interrupt import reporting, undisturbed


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield the name under which to write the file. At every moment `path` is what it was or the whole new file.

    Raises:
        ValueError: a place that cannot be written.
        OSError: the disk refused; `path` is what it was.
    """
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
    """Write a figure of matplotlib, of the kind that the suffix says, PNG where there is none.

    It is drawn in memory first: matplotlib's writers do not all report what the disk refuses.

    Raises:
        ValueError: a kind that matplotlib does not know; see `replacing`.
        OSError: see `replacing`.
    """
    drawn = io.BytesIO()
    figure.savefig(drawn, format=path.suffix[1:] or "png", dpi=dpi)
    with replacing(path) as aside:
        aside.write_bytes(drawn.getbuffer())


def reason(error: BaseException) -> str:
    """The system's message of an error, or the first line of the library's."""
    text = (isinstance(error, OSError) and error.strerror) or str(error) or type(error).__name__
    match = re.search(r"error message = '(.*?)'", text)
    return match[1] if match else text.splitlines()[0].strip("'\"")
