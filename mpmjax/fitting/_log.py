"""The record of a fit while it runs: lines of progress, and a log from which it continues bit for bit.

The log is an HDF5 file:

    /iterations     a table with one row an iteration: round (of the noise's estimates), number (in the round), cost
                    ½ Σ r², gradient (its largest component), accepted, seconds (since the fit began)
    /coordinates    of the search [-], shape (iterations, n)
    /values         of the parameters, shape (iterations, n); the attribute `labels` names the columns
    /noise/k        the σ of observation k in each round, shape (rounds, ...); the attribute `name` is its name
    /problem        JSON: what is fitted, as names and texts, by which another fit is told from this one
    /resume         what the next iteration needs: the optimiser's state, and its evaluation of the place where it is

The file is replaced as a whole after each iteration (see `mpmjax.io.ReplacedFile`): it holds whole iterations only,
however the process ends. Its last four bytes are CRC-32 of all others.
"""

import enum
import hashlib
import inspect
import io
import json
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple

import equinox as eqx
import h5py
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array
from mpmjax.checks import require
from mpmjax.fitting._optimiser import AbstractOptimiser, Evaluation
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import SHOWN, FitProblem, Sigmas
from mpmjax.fitting._search import Iteration, SearchState, begin
from mpmjax.io import ReplacedFile, check_hdf5, reason

_FORMAT = 2
_ROW = [("round", "i8"), ("number", "i8"), ("cost", "f8"), ("gradient", "f8"), ("accepted", "?"), ("seconds", "f8")]

_MOST = 8  # numbers of an array that are written out
_FREE = ("optimiser.max_steps",)  # choices that may differ in a fit that is continued: it may go on for longer


class _Round(NamedTuple):
    """A search with one noise."""

    sigmas: Sigmas
    search: SearchState
    seconds: tuple[float, ...]  # when each iteration was done, since the fit began [s]


class FitLog:
    """The iterations of a fit in a file. Make it by `opened_log`."""

    def __init__(self, path: Path, file: ReplacedFile, problem: FitProblem, text: dict[str, str], rounds: list[_Round]):
        self._path, self._file, self._problem, self._text, self._rounds = path, file, problem, text, rounds
        self._values = [self._numbers(i) for r in rounds for i in r.search.history]

    @property
    def end(self) -> tuple[int, tuple[Iteration, ...], Sigmas, SearchState, float] | None:
        """Number of rounds before the last one, and their iterations; noise of the last one, its search, and when its
        last iteration was done, since the fit began [s]. None if there is no iteration."""
        if not self._rounds:
            return None
        *done, last = self._rounds
        return len(done), tuple(i for r in done for i in r.search.history), last.sigmas, last.search, last.seconds[-1]

    def append(self, sigmas: Sigmas, state: SearchState, seconds: float) -> None:
        """Write an iteration: the noise of its round, the search after it, and the seconds since the fit began."""
        *earlier, last = state.history
        past = self._rounds.pop().seconds if earlier else ()
        self._rounds.append(_Round(sigmas, state, (*past, seconds)))
        self._values.append(self._numbers(last))
        self.write()

    def write(self) -> None:
        """Write the file; if the disk refuses, the log is what it was."""
        whole = io.BytesIO()
        with h5py.File(whole, "w", libver=("v110", "v110")) as file:
            self._fill(file)
        data = whole.getvalue()
        try:
            self._file.write(data + zlib.crc32(data).to_bytes(4))
        except OSError as error:
            raise OSError(f"{error} If it has no room, make room, then resume the fit.") from None

    def contents(self) -> str:
        """The number of iterations in the log, as a sentence."""
        count = len(self._values)
        return f"{self._path} holds {count} iteration{'s' * (count != 1)}. Resume it to continue."

    def _numbers(self, iteration: Iteration) -> np.ndarray:
        return np.asarray(self._problem.numbers(jnp.asarray(iteration.z, self._problem.dtype)), float)

    def _fill(self, file: Any) -> None:
        rounds, n = self._rounds, self._problem.size

        def put(name: str, data: np.ndarray) -> None:
            """A dataset, with checksums where it has data."""
            checked = {"chunks": data.shape, "fletcher32": True} if data.ndim and data.size else {}
            file.create_dataset(name, data=data, **checked)

        for name, text in {"kind": "mpmjax fit log", "version": version("mpmjax")}.items():
            file.attrs[name] = np.bytes_(text)
        file.attrs["format"] = np.int64(_FORMAT)
        put("problem", np.frombuffer(json.dumps(self._text).encode(), np.uint8))
        rows = [
            (number, i.number, i.cost, i.gradient, i.accepted, seconds)
            for number, r in enumerate(rounds)
            for i, seconds in zip(r.search.history, r.seconds, strict=True)
        ]
        put("iterations", np.array(rows, _ROW))
        put("coordinates", np.array([i.z for r in rounds for i in r.search.history]).reshape(-1, n))
        put("values", np.array(self._values).reshape(-1, n))
        file["values"].attrs["labels"] = json.dumps(self._problem.labels)
        for k, observation in enumerate(self._problem.observations):
            sigmas = [np.asarray(r.sigmas[k]) for r in rounds]
            shape = sigmas[0].shape if rounds else ()
            put(f"noise/{k}", np.array(sigmas, None if rounds else float).reshape(-1, *shape))
            file[f"noise/{k}"].attrs["name"] = observation.name
        if rounds:
            _, inner, seen, _ = rounds[-1].search
            for k, leaf in enumerate(jax.tree.leaves(eqx.filter(inner, eqx.is_array))):
                put(f"resume/state/{k}", np.asarray(leaf))
            for name, leaf in seen._asdict().items():
                if leaf is not None:
                    put(f"resume/seen/{name}", np.asarray(leaf))


@contextmanager
def opened_log(path: Path, problem: FitProblem, optimiser: AbstractOptimiser, *, resume: bool) -> Iterator[FitLog]:
    """A log that is begun or, with `resume`, read and continued."""
    text = described(problem, optimiser)
    if not resume:
        with ReplacedFile(path, new=True) as file:
            log = FitLog(path, file, problem, text, [])
            log.write()
            yield log
        return
    check_hdf5(path)
    with ReplacedFile(path, new=False) as file:
        yield FitLog(path, file, problem, text, _read(path, problem, optimiser, text))


def _read(path: Path, problem: FitProblem, optimiser: AbstractOptimiser, text: dict[str, str]) -> list[_Round]:
    """The rounds in a log, which must be whole and of the same fit."""
    damaged = f"{path} is damaged ({{}}): begin the fit anew with another log."
    try:
        data = path.read_bytes()
        with h5py.File(io.BytesIO(data), "r") as file:
            is_log = file.attrs.get("kind") == b"mpmjax fit log"
            layout = int(np.asarray(file.attrs["format"])) if is_log else 0
            whole = zlib.crc32(data[:-4]) == int.from_bytes(data[-4:])
            require(whole or layout != _FORMAT, "it is not what was written")
            datasets: list[Any] = []
            file.visititems(lambda _, item: datasets.append(item) if isinstance(item, h5py.Dataset) else None)
            arrays = {item.name.lstrip("/"): np.asarray(item[()]) for item in datasets if whole}
        theirs = json.loads(arrays["problem"].tobytes()) if layout == _FORMAT else {}
    except (OSError, KeyError, ValueError, RuntimeError, MemoryError) as error:
        raise ValueError(damaged.format(reason(error))) from None
    require(is_log, f"{path} is not the log of a fit: check its name.")
    require(layout == _FORMAT, f"{path} is a log of format {layout}, this mpmjax reads {_FORMAT}: begin the fit anew.")
    for name in (*theirs, *text):
        here, there = text.get(name, "none"), theirs.get(name, "none")
        require(
            here == there,
            f"{path} is the log of another fit: {name} is {there} there and {here} here. Resume the same fit, or name "
            "a new log.",
        )
    try:
        return _rounds(arrays, problem, optimiser)
    except (KeyError, IndexError, TypeError) as error:
        raise ValueError(damaged.format(reason(error))) from None


def _rounds(arrays: dict[str, np.ndarray], problem: FitProblem, optimiser: AbstractOptimiser) -> list[_Round]:
    rows: Any = arrays["iterations"]
    places = arrays["coordinates"]
    rounds = []
    for number in range(int(rows["round"][-1]) + 1 if len(rows) else 0):
        at = np.flatnonzero(rows["round"] == number)
        numbers = rows[["number", "cost", "gradient", "accepted"]][at]
        history = tuple(Iteration(*row.item(), z) for row, z in zip(numbers, places[at], strict=True))  # pyright: ignore[reportCallIssue]
        sigmas = tuple(jnp.asarray(arrays[f"noise/{k}"][number]) for k in range(len(problem.observations)))
        names = [name for name in Evaluation._fields if f"resume/seen/{name}" in arrays]
        seen = Evaluation(**{name: jnp.asarray(arrays[f"resume/seen/{name}"]) for name in names})
        state = SearchState(jnp.asarray(places[at[-1]]), None, seen, history)
        rounds.append(_Round(sigmas, state, tuple(rows["seconds"][at].tolist())))
    if rounds:
        last = rounds[-1]
        like = eqx.filter_eval_shape(begin, problem, optimiser, jnp.zeros(problem.size), last.sigmas)
        shapes, rest = eqx.partition(like, lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct))
        leaves, tree = jax.tree.flatten(shapes)
        read = [_like(leaf, arrays[f"resume/state/{k}"]) for k, leaf in enumerate(leaves)]
        inner = eqx.combine(jax.tree.unflatten(tree, read), rest)
        rounds[-1] = last._replace(search=last.search._replace(inner=inner))
    return rounds


def _like(leaf: Any, data: np.ndarray) -> Array:
    """An array of the file, as weakly typed as the one that it stands for."""
    if (data.shape, data.dtype) != (leaf.shape, leaf.dtype):
        raise TypeError(f"the optimiser remembers {leaf.shape} of {leaf.dtype}, not {data.shape} of {data.dtype}")
    return jnp.asarray(data.item() if leaf.weak_type and data.ndim == 0 else data)


def described(problem: FitProblem, optimiser: AbstractOptimiser) -> dict[str, str]:
    """Every number, choice and function of a fit by its dotted path.

    Arrays stand as a digest, functions as their name and a digest of their code, and the `where` of a parameter as the
    numbers that change with it.
    """
    texts = dict(_texts(optimiser, "optimiser"))
    for k, experiment in enumerate(problem.experiments):
        texts |= dict(_texts(experiment, f"experiments.{k}"))
    for name, parameter, start in zip(problem.names, problem.parameters, problem.starts, strict=True):
        texts[f"parameters.{name}"] = _changed(problem, parameter, start)
        texts |= dict(_texts(parameter, f"parameters.{name}"))
    return {name: text for name, text in texts.items() if name not in _FREE}


def _changed(problem: FitProblem, parameter: AbstractParameter, start: Any) -> str:
    """The numbers of an experiment that change with a parameter."""
    experiment = problem.experiments[0 if parameter.only is None else parameter.only[0]]
    put = parameter.put(experiment, start + 1 + jnp.abs(start))
    before, after = (jax.tree_util.tree_leaves_with_path(tree) for tree in (experiment, put))
    names = [
        jax.tree_util.keystr(path).lstrip(".")
        for (path, a), (_, b) in zip(before, after, strict=False)
        if eqx.is_array_like(a) and not np.array_equal(a, b)
    ]
    return f"{type(parameter).__name__} of {', '.join(names)}"


def _texts(value: Any, path: str) -> Iterator[tuple[str, str]]:
    """The text of everything within a value."""
    match value:
        case AbstractParameter():
            for f in fields(value):
                if f.name not in ("where", "update", "unit"):
                    yield from _texts(getattr(value, f.name), f"{path}.{f.name}")
        case eqx.Module() if is_dataclass(value):
            yield path, type(value).__name__
            for f in fields(value):
                yield from _texts(getattr(value, f.name, None), f"{path}.{f.name}")
        case Mapping():
            for key, part in value.items():
                yield from _texts(part, f"{path}.{key}")
        case tuple() | list() if len(value) > 0 and not all(isinstance(part, (bool, int, float)) for part in value):
            yield path, f"{len(value)} of them"
            for k, part in enumerate(value):
                yield from _texts(part, f"{path}.{k}")
        case None | bool() | str():
            yield path, repr(value)
        case partial():
            yield from _texts((value.func, *value.args, *value.keywords.values()), path)
        case _ if eqx.is_array_like(value) or isinstance(value, (tuple, list)):
            data = np.asarray(value)
            digest = _digest(repr(data.dtype).encode() + np.ascontiguousarray(data).tobytes())
            whole = f"an array of shape {data.shape} ({digest})"
            yield path, repr(data.tolist()) if data.size <= _MOST else whole
        case _ if callable(value):
            code = getattr(value, "__code__", None)
            digest = f" of code {_digest(_code(code))}" if code is not None else ""
            name = getattr(value, "__qualname__", type(value).__qualname__)
            yield path, f"{getattr(value, '__module__', '')}.{name}{digest}"
            held = inspect.getclosurevars(value).nonlocals if code is not None else {}
            yield from _texts({key: v for key, v in held.items() if not callable(v)}, path)
        case enum.Enum():
            yield path, repr(value.value)
        case _:
            yield path, type(value).__qualname__


def _code(code: CodeType) -> bytes:
    """The code of a function, without the place where it stands; sets in an order that each process has."""
    constants = [
        _code(c) if isinstance(c, CodeType) else repr(sorted(c, key=repr) if isinstance(c, frozenset) else c).encode()
        for c in code.co_consts
    ]
    return b"\0".join([code.co_code, repr(code.co_names).encode(), *constants])


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:12]


class Progress:
    """A line an iteration: misfit Σ r², gradient, parameters, seconds, and the time that is left.

    The time left is that of the present search. It is the usual time of an iteration times how many are left: about so
    many as the optimiser's distance from converged needs to fall to one at the rate of the last three iterations, where
    it is known and falls; else at most those up to `max_steps`.
    """

    def __init__(self, problem: FitProblem, optimiser: AbstractOptimiser, say: Callable[[str], None], done: int):
        """Say that the first iteration begins, which is compiled before; a log may hold iterations that are done."""
        self._problem, self._optimiser, self._say = problem, optimiser, say
        self._durations: list[float] = []
        self._distances: list[float] = []
        self._last = time.perf_counter()
        named = ", ".join(problem.labels[:SHOWN]) + (", …" if problem.size > SHOWN else "")
        after = f" after {done} iterations of the log" if done else ""
        count = f"{problem.size} number{'s' * (problem.size > 1)}"
        say(f"compiling the fit of {count} ({named}) to {problem.points} that were measured{after}")

    def __call__(self, state: SearchState, seconds: float) -> None:
        """Say where the search stands after an iteration, and so many seconds since the fit began."""
        iteration, now = state.history[-1], time.perf_counter()
        if iteration.number == 0:
            self._distances = []
        self._durations.append(now - self._last)
        self._distances.append(self._optimiser.distance(state.inner, state.seen))
        self._last = now
        self._say(
            f"{iteration.number:4d}  misfit {2 * iteration.cost:10.4g}  gradient {iteration.gradient:8.2g}  "
            f"{self._problem.shown(iteration.z)}  {_clock(seconds)}{self._left(len(state.history))}"
        )

    def _left(self, done: int) -> str:
        """The time left, in words; nothing while only the iteration that was compiled is timed, and at the end."""
        most = self._optimiser.max_steps - done
        if len(self._durations) < 2 or most == 0 or self._distances[-1] <= 1:
            return ""
        pace, steps = float(np.median(self._durations[1:])), iterations_left(self._distances)
        if steps is None or steps > most:
            return f", at most {_clock(pace * most)} left"
        return f", about {_clock(pace * steps)} left"


def iterations_left(distances: list[float]) -> int | None:
    """How many iterations the distance needs to fall to one, at the mean rate of its last three values; None where it
    does not fall, or is not known."""
    last = np.asarray(distances[-3:])
    if len(last) < 3 or not (np.isfinite(last).all() and 0 < last[-1] < last[0]):
        return None
    return max(1, int(np.ceil(np.log(last[-1]) / (np.log(last[0] / last[-1]) / 2))))


def _clock(seconds: float) -> str:
    """Seconds as people say them."""
    if seconds < 100:
        return f"{seconds:.3g} s" if seconds >= 0.1 else "0.1 s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
