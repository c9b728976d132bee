"""A staged file is what was written; the disk has it when it is committed, all or nothing; one writer at a time."""

import os
import subprocess
import sys

import h5py
import numpy as np
import pytest
from disk import full_beyond

from mpmjax.io._transactional_file import StagedFile, require_no_writer


def content(file: StagedFile) -> bytes:
    """All of a staged file."""
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    return file.read(size)


@pytest.mark.parametrize("seed", range(20))
def test_a_staged_file_is_a_file_that_reaches_the_disk_by_commits(seed, tmp_path):
    """Against a byte array: writes across pages, beyond the end, truncations both ways, reads beyond the end."""
    rng, path = np.random.default_rng(seed), tmp_path / "a"
    model = bytearray(rng.bytes(int(rng.integers(0, 20000))))
    path.write_bytes(model)
    with StagedFile(path) as file:
        committed = bytes(model)
        for _ in range(60):
            at, size = int(rng.integers(0, len(model) + 9000)), int(rng.integers(0, 12000))
            match rng.integers(5):
                case 0 | 1:
                    data = rng.bytes(size)
                    file.seek(at)
                    assert file.write(memoryview(data)) == size
                    if size:
                        model.extend(bytes(max(0, at - len(model))))
                        model[at : at + size] = data
                case 2:
                    file.truncate(size=at)
                    model[at:] = bytes(max(0, at - len(model)))
                case 3:
                    file.seek(at)
                    assert file.read(size) == bytes(model[at : at + size]).ljust(size, b"\0")
                    assert file.tell() == at + size
                case _:
                    file.flush()
                    file.commit()
                    committed = bytes(model)
            assert path.read_bytes() == committed
            assert content(file) == model
    assert path.read_bytes() == committed


def test_what_the_disk_refuses_leaves_the_file_as_it_was(tmp_path):
    """Also what lies within the file, and what had been written before the refusal; with room it can be committed."""
    path, before = tmp_path / "a", bytes(range(256)) * 40
    path.write_bytes(before)
    with StagedFile(path) as file:
        for grown in (bytes(10**5), bytes(10)):
            file.seek(100)
            file.write(b"changed")
            file.truncate(len(before) - 1000)
            file.seek(len(before) - 500)
            file.write(grown)
            if len(grown) > 10:
                with full_beyond(2 * len(before)), pytest.raises(OSError, match="File too large"):
                    file.commit()
                assert path.read_bytes() == content(file) == before
        file.commit()
        assert path.read_bytes() == content(file) != before


HOLD = """
import sys
from pathlib import Path
from mpmjax.io._transactional_file import StagedFile
file = StagedFile(Path(sys.argv[1]))
print("held", flush=True)
sys.stdin.read()
"""


def test_one_writer_at_a_time_however_it_ends_and_readers_are_free(tmp_path):
    """In this process and in another, which is killed; HDF5's own locks, as other programs take them, are not met."""
    path = tmp_path / "a.h5"
    h5py.File(path, "w").close()
    with StagedFile(path):
        for attempt in (StagedFile, require_no_writer):
            with pytest.raises(ValueError, match="is being written by another run"):
                attempt(path)
    require_no_writer(path)
    command = [sys.executable, "-c", HOLD, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(ValueError, match="is being written by another run"):
            StagedFile(path)
        h5py.File(path, "r").close()
        other.kill()
        other.wait()
    StagedFile(path).close()
