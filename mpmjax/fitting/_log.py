"""The record of a fit while it runs: lines of progress, and a log from which it continues bit for bit.

The log is an HDF5 file, whose layout is in docs/fitting.md. It is replaced as a whole after each iteration (see
`mpmjax.io.ReplacedFile`): it holds whole iterations only, however the process ends. Its last four bytes are its CRC-32.
"""

import enum
import hashlib
import inspect
import io
import json
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import fields, is_dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import CodeType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax.checks import require
from mpmjax.fitting._evaluation import Evaluation
from mpmjax.fitting._parameter import AbstractParameter, changes
from mpmjax.fitting._problem import SHOWN, FitProblem
from mpmjax.fitting._search import AbstractOptimiser, Iteration, Search
from mpmjax.io import ReplacedFile, check_hdf5, reason, reporting

_FORMAT = 4
_ROW = [("round", "i8"), ("number", "i8"), ("cost", "f8"), ("gradient", "f8"), ("accepted", "?"), ("seconds", "f8")]
_MOST = 8  # numbers of an array that are written out
_FREE = ("optimiser.max_steps",)  # choices that may differ in a fit that is continued: it may go on for longer

Progress = Callable[[str], None]
Past = tuple[int, tuple[Iteration, ...], FitProblem, Search]  # rounds before the last, their iterations; the last one


@contextmanager
def recorded(
    problem: FitProblem, optimiser: AbstractOptimiser, progress: Progress | None, path: Path | None, *, resume: bool
) -> Iterator[tuple[Past | None, Callable[[FitProblem, Search], None]]]:
    """The past of a fit that a log holds, if it is to `resume`, and a function that records a search, of the problem
    with the noise of its round, after each iteration: in the log at this path, by lines of progress, or both."""
    log, past = _Log(problem, {} if path is None else described(problem, optimiser)), None
    with ExitStack() as stack:
        file = None
        if path is not None:
            if resume:
                check_hdf5(path)
            file = stack.enter_context(ReplacedFile(path, new=not resume))
            if resume:
                past = log.read(path, optimiser)
            else:
                file.write(log.contents(None))
            standing = f"{path} holds {{}} iteration{{}}. Resume it to continue.".format
            stack.enter_context(reporting(lambda: standing(len(log.iterations), "s" * (len(log.iterations) != 1))))
        begun = time.perf_counter() - (log.iterations[-1][-1] if log.iterations else 0.0)
        say = None if progress is None else _lines(problem, optimiser, progress, len(log.iterations))

        def record(problem: FitProblem, search: Search) -> None:
            seconds = time.perf_counter() - begun
            if file is not None:
                log.add(problem, search.history[-1], seconds)
                try:
                    file.write(log.contents(search))
                except OSError as error:
                    raise OSError(f"{error} If it has no room, make room, then resume the fit.") from None
            if say is not None:
                say(search, seconds)

        yield past, record


class _Log:
    """The content of a log: iterations with the number of their round and seconds, their values, noise of rounds."""

    def __init__(self, problem: FitProblem, text: dict[str, str]):
        self.problem, self.text = problem, text
        self.iterations, self.values, self.noise = list[tuple[int, Iteration, float]](), list[np.ndarray](), list[Any]()

    def add(self, problem: FitProblem, iteration: Iteration, seconds: float) -> None:
        """Add an iteration, with the noise of its round if it is the first one."""
        if iteration.number == 0:
            self.noise.append(problem.sigmas)
        self.iterations.append((len(self.noise) - 1, iteration, seconds))
        self.values.append(np.asarray(problem.numbers(jnp.asarray(iteration.z, problem.dtype)), float))

    def contents(self, last: Search | None) -> bytes:
        """The file, with what the next iteration needs of the `last` search."""
        import h5py  # here, since it takes long to import

        size, observations, whole = self.problem.size, self.problem.observations, io.BytesIO()
        arrays = {
            "problem": np.frombuffer(json.dumps(self.text).encode(), np.uint8),
            "iterations": np.array([(n, *i[:4], seconds) for n, i, seconds in self.iterations], _ROW),
            "coordinates": np.array([i.z for _, i, _ in self.iterations]).reshape(-1, size),
            "values": np.array(self.values).reshape(-1, size),
        }
        for k in range(len(observations)):
            each = [np.asarray(sigmas[k]) for sigmas in self.noise]
            arrays[f"noise/{k}"] = np.array(each, None if each else float)
        if last is not None:
            state = jax.tree.leaves(eqx.filter(last.inner, eqx.is_array))
            arrays |= {f"resume/state/{k}": np.asarray(leaf) for k, leaf in enumerate(state)}
            seen = {name: a for name, a in last.seen._asdict().items() if a is not None and name != "runs"}
            arrays |= {f"resume/seen/{name}": np.asarray(a) for name, a in seen.items()}
        with h5py.File(whole, "w", libver=("v110", "v110")) as file:
            attributes = {"kind": np.bytes_("mpmjax fit log"), "version": np.bytes_(version("mpmjax"))}
            file.attrs.update(attributes, format=np.int64(_FORMAT))
            for name, array in arrays.items():
                file[name] = array
            file["values"].attrs["labels"] = json.dumps(self.problem.labels)
            for k, observation in enumerate(observations):
                file[f"noise/{k}"].attrs["name"] = observation.name
        data = whole.getvalue()
        return data + zlib.crc32(data).to_bytes(4)

    def read(self, path: Path, optimiser: AbstractOptimiser) -> Past | None:
        """Take what a file holds, which must be whole and the log of the same fit; the past of the fit."""
        import h5py

        damaged, arrays = f"{path} is damaged ({{}}): begin the fit anew with another log.", dict[str, np.ndarray]()
        try:
            data = path.read_bytes()
            with h5py.File(io.BytesIO(data), "r") as file:
                is_log = file.attrs.get("kind") == b"mpmjax fit log"
                layout = int(np.asarray(file.attrs["format"])) if is_log else 0
                whole = zlib.crc32(data[:-4]) == int.from_bytes(data[-4:])
                require(whole or layout != _FORMAT, "it is not what was written")

                def read(name: str, item: Any) -> None:
                    if isinstance(item, h5py.Dataset):
                        arrays[name] = np.asarray(item[()])

                if whole:
                    file.visititems(read)
            theirs = json.loads(arrays["problem"].tobytes()) if layout == _FORMAT else {}
        except (OSError, KeyError, ValueError, RuntimeError, MemoryError) as error:
            raise ValueError(damaged.format(reason(error))) from None
        require(is_log, f"{path} is not the log of a fit: check its name.")
        this = f"this mpmjax reads {_FORMAT}: begin the fit anew."
        require(layout == _FORMAT, f"{path} is a log of format {layout}, {this}")
        for name in (*theirs, *self.text):
            here, there = self.text.get(name, "none"), theirs.get(name, "none")
            differs = f"{name} is {there} there and {here} here. Resume the same fit, or name a new log."
            require(here == there, f"{path} is the log of another fit: {differs}")
        try:
            return self._past(arrays, optimiser)
        except (KeyError, IndexError, TypeError) as error:
            raise ValueError(damaged.format(reason(error))) from None

    def _past(self, arrays: dict[str, np.ndarray], optimiser: AbstractOptimiser) -> Past | None:
        rows: list[Any] = arrays["iterations"].tolist()
        each = zip(rows, arrays["coordinates"], strict=True)
        self.iterations = [(n, Iteration(*i, z), seconds) for (n, *i, seconds), z in each]  # pyright: ignore
        if not rows:
            return None
        last, observations = rows[-1][0], range(len(self.problem.observations))
        self.values = list(arrays["values"])
        self.noise = [tuple(jnp.asarray(arrays[f"noise/{k}"][n]) for k in observations) for n in range(last + 1)]
        earlier, history = (tuple(i for n, i, _ in self.iterations if (n == last) is now) for now in (False, True))
        parts: dict[str, Any] = {name.rpartition("/")[2]: a for name, a in arrays.items() if "/seen/" in name}
        like = eqx.filter_eval_shape(optimiser.begin, self.problem, jnp.zeros(self.problem.size))
        shapes, rest = eqx.partition(like, lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct))
        leaves, tree = jax.tree.flatten(shapes)
        state = [jnp.asarray(arrays[f"resume/state/{k}"]) for k in range(len(leaves))]
        inner = eqx.combine(jax.tree.unflatten(tree, state), rest)
        search = Search(jnp.asarray(history[-1].z), inner, Evaluation(**parts), history)
        return last, earlier, self.problem.with_noise(self.noise[-1]), search


def described(problem: FitProblem, optimiser: AbstractOptimiser) -> dict[str, str]:
    """Every number, choice and function of a fit by its dotted path: arrays as a digest, functions as their name and a
    digest of their code, and the `where` of a parameter as the numbers that change with it."""
    texts = dict(_texts(optimiser, "optimiser"))
    for k, experiment in enumerate(problem.experiments):
        texts |= dict(_texts(experiment, f"experiments.{k}"))
    for name, parameter, start in zip(problem.names, problem.parameters, problem.starts, strict=True):
        experiment = problem.experiments[0 if parameter.only is None else parameter.only[0]]
        changed = ", ".join(changes(parameter, experiment, np.asarray(start)))
        texts[f"parameters.{name}"] = f"{type(parameter).__name__} of {changed}"
        texts |= dict(_texts(parameter, f"parameters.{name}"))
    return {name: text for name, text in texts.items() if name not in _FREE}


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


def _lines(
    problem: FitProblem, optimiser: AbstractOptimiser, say: Progress, done: int
) -> Callable[[Search, float], None]:
    """A line an iteration: misfit Σ r², gradient, parameters, seconds, and the time that is left of the present search,
    after a first one that an iteration is compiled; `done` are in the log. The time left is the median time of an
    iteration times how many the optimiser's distance from converged needs to fall to one, or all up to `max_steps`."""
    durations, distances, last = list[float](), list[float](), time.perf_counter()
    labels = ", ".join(problem.labels[:SHOWN]) + (", …" if problem.size > SHOWN else "")
    after = f" after {done} iterations of the log" if done else ""
    count = f"{problem.size} number{'s' * (problem.size > 1)}"
    say(f"compiling the fit of {count} ({labels}) to {problem.points} that were measured{after}")

    def line(search: Search, seconds: float) -> None:
        nonlocal last
        iteration, now = search.history[-1], time.perf_counter()
        if iteration.number == 0:
            distances.clear()
        durations.append(now - last)
        distances.append(optimiser.distance(search.inner, search.seen))
        last, most, left = now, optimiser.max_steps - len(search.history), ""
        if len(durations) > 1 and most > 0 and not distances[-1] <= 1:
            pace, steps = float(np.median(durations[1:])), iterations_left(distances)
            falls = steps is not None and steps <= most
            left = f", {'about' if falls else 'at most'} {_clock(pace * min(steps or most, most))} left"
        say(
            f"{iteration.number:4d}  misfit {2 * iteration.cost:10.4g}  gradient {iteration.gradient:8.2g}  "
            f"{problem.shown(iteration.z)}  {_clock(seconds)}{left}"
        )

    return line


def iterations_left(distances: list[float]) -> int | None:
    """Iterations until the distance is one, at the mean rate of the last three; None where it does not fall."""
    last = np.asarray(distances[-3:])
    if len(last) < 3 or not (np.isfinite(last).all() and 0 < last[-1] < last[0]):
        return None
    return max(1, int(np.ceil(np.log(last[-1]) / (np.log(last[0] / last[-1]) / 2))))


def _clock(seconds: float) -> str:
    """Seconds as people say them."""
    if seconds < 100:
        return f"{seconds:.3g} s" if seconds >= 0.1 else "0.1 s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
