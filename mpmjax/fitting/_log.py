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
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import SHOWN, FitProblem
from mpmjax.fitting._search import AbstractOptimiser, Iteration, Search
from mpmjax.io import ReplacedFile, check_hdf5, reason, reporting

_FORMAT = 3
_ROW = [("round", "i8"), ("number", "i8"), ("cost", "f8"), ("gradient", "f8"), ("accepted", "?"), ("seconds", "f8")]
_MOST = 8  # numbers of an array that are written out
_FREE = ("optimiser.max_steps",)  # choices that may differ in a fit that is continued: it may go on for longer

Past = tuple[int, tuple[Iteration, ...], FitProblem, Search]
"""Number of rounds before the last one, and their iterations; the problem with its noise, and its search."""


@contextmanager
def recorded(
    problem: FitProblem,
    optimiser: AbstractOptimiser,
    progress: Callable[[str], None] | None,
    path: Path | None,
    *,
    resume: bool,
) -> Iterator[tuple[Past | None, Callable[[FitProblem, Search], None]]]:
    """The past of a fit that a log holds, if it is to `resume`, and a function that records a search of the problem,
    with the noise of its round, after each iteration: in the log at this path, by lines of progress, or both."""
    rows, places, values, noise, past = [], [], [], [], None
    with ExitStack() as stack:
        if path is not None:
            text = described(problem, optimiser)
            if resume:
                check_hdf5(path)
            file = stack.enter_context(ReplacedFile(path, new=not resume))
            if resume:
                rows, places, values, noise, past = _read(path, problem, optimiser, text)

            def write(last: Search | None) -> None:
                """Write the file; if the disk refuses, the log is what it was."""
                import h5py  # here, since it takes long to import

                whole = io.BytesIO()
                with h5py.File(whole, "w", libver=("v110", "v110")) as contents:
                    attributes = {"kind": np.bytes_("mpmjax fit log"), "version": np.bytes_(version("mpmjax"))}
                    contents.attrs.update(attributes, format=np.int64(_FORMAT))
                    arrays = {
                        "problem": np.frombuffer(json.dumps(text).encode(), np.uint8),
                        "iterations": np.array(rows, _ROW),
                        "coordinates": np.array(places).reshape(-1, problem.size),
                        "values": np.array(values).reshape(-1, problem.size),
                    }
                    for k in range(len(problem.observations)):
                        each = [np.asarray(sigmas[k]) for sigmas in noise]
                        arrays[f"noise/{k}"] = np.array(each, None if noise else float)
                    if last is not None:
                        state = jax.tree.leaves(eqx.filter(last.inner, eqx.is_array))
                        arrays |= {f"resume/state/{k}": np.asarray(leaf) for k, leaf in enumerate(state)}
                        seen = {name: a for name, a in last.seen._asdict().items() if a is not None and name != "runs"}
                        arrays |= {f"resume/seen/{name}": np.asarray(a) for name, a in seen.items()}
                    for name, array in arrays.items():  # with checksums where there are data
                        checked = {"chunks": array.shape, "fletcher32": True} if array.ndim and array.size else {}
                        contents.create_dataset(name, data=array, **checked)
                    contents["values"].attrs["labels"] = json.dumps(problem.labels)
                    for k, observation in enumerate(problem.observations):
                        contents[f"noise/{k}"].attrs["name"] = observation.name
                data = whole.getvalue()
                try:
                    file.write(data + zlib.crc32(data).to_bytes(4))
                except OSError as error:
                    raise OSError(f"{error} If it has no room, make room, then resume the fit.") from None

            if not resume:
                write(None)
            stack.enter_context(
                reporting(lambda: f"{path} holds {len(rows)} iteration{'s' * (len(rows) != 1)}. Resume it to continue.")
            )
        begun = time.perf_counter() - (rows[-1][-1] if rows else 0.0)
        say = None if progress is None else _lines(problem, optimiser, progress, len(rows))

        def record(problem: FitProblem, search: Search) -> None:
            iteration, seconds = search.history[-1], time.perf_counter() - begun
            if path is not None:
                if iteration.number == 0:
                    noise.append(problem.sigmas)
                rows.append((len(noise) - 1, *iteration[:4], seconds))
                places.append(iteration.z)
                values.append(np.asarray(problem.numbers(jnp.asarray(iteration.z, problem.dtype)), float))
                write(search)
            if say is not None:
                say(search, seconds)

        yield past, record


def _read(path: Path, problem: FitProblem, optimiser: AbstractOptimiser, text: dict[str, str]) -> tuple[Any, ...]:
    """Rows, coordinates and values of the iterations in a log, which must be whole and of the same fit, the noise of
    its rounds, and the past of the fit."""
    import h5py

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
        rows: list[Any] = arrays["iterations"].tolist()
        places, past = list(arrays["coordinates"]), None
        rounds, observations = rows[-1][0] + 1 if rows else 0, range(len(problem.observations))
        noise = [tuple(jnp.asarray(arrays[f"noise/{k}"][n]) for k in observations) for n in range(rounds)]
        if rows:
            each: Any = [(n, Iteration(*i, z)) for (n, *i, _), z in zip(rows, places, strict=True)]  # pyright: ignore
            earlier, history = (tuple(i for n, i in each if (n == rounds - 1) is last) for last in (False, True))
            names = [name for name in Evaluation._fields if f"resume/seen/{name}" in arrays]
            parts: dict[str, Any] = {name: arrays[f"resume/seen/{name}"] for name in names}
            seen = Evaluation(**parts)
            like = eqx.filter_eval_shape(optimiser.begin, problem, jnp.zeros(problem.size))
            shapes, rest = eqx.partition(like, lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct))
            leaves, tree = jax.tree.flatten(shapes)
            state = []
            for k, leaf in enumerate(leaves):
                data = arrays[f"resume/state/{k}"]
                if (data.shape, data.dtype) != (leaf.shape, leaf.dtype):
                    raise TypeError(
                        f"the optimiser remembers {leaf.shape} of {leaf.dtype}, not {data.shape} of {data.dtype}"
                    )
                # As weakly typed as it was, or the next iteration would compile anew.
                state.append(jnp.asarray(data.item() if leaf.weak_type and data.ndim == 0 else data))
            inner = eqx.combine(jax.tree.unflatten(tree, state), rest)
            past = (
                rounds - 1,
                earlier,
                problem.with_noise(noise[-1]),
                Search(jnp.asarray(places[-1]), inner, seen, history),
            )
        return rows, places, list(arrays["values"]), noise, past
    except (KeyError, IndexError, TypeError) as error:
        raise ValueError(damaged.format(reason(error))) from None


def described(problem: FitProblem, optimiser: AbstractOptimiser) -> dict[str, str]:
    """Every number, choice and function of a fit by its dotted path: arrays as a digest, functions as their name and a
    digest of their code, and the `where` of a parameter as the numbers that change with it."""
    texts = dict(_texts(optimiser, "optimiser"))
    for k, experiment in enumerate(problem.experiments):
        texts |= dict(_texts(experiment, f"experiments.{k}"))
    for name, parameter, start in zip(problem.names, problem.parameters, problem.starts, strict=True):
        experiment = problem.experiments[0 if parameter.only is None else parameter.only[0]]
        put = parameter.put(experiment, start + 1 + jnp.abs(start))
        before, after = (jax.tree_util.tree_leaves_with_path(tree) for tree in (experiment, put))
        changed = [
            jax.tree_util.keystr(path).lstrip(".")
            for (path, a), (_, b) in zip(before, after, strict=False)
            if eqx.is_array_like(a) and not np.array_equal(a, b)
        ]
        texts[f"parameters.{name}"] = f"{type(parameter).__name__} of {', '.join(changed)}"
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
    problem: FitProblem, optimiser: AbstractOptimiser, say: Callable[[str], None], done: int
) -> Callable[[Search, float], None]:
    """A line an iteration: misfit Σ r², gradient, parameters, seconds, and the time that is left of the present search.
    The first one says that an iteration is compiled; `done` are in the log.

    The time left is the median time of an iteration times how many are left: about so many as the optimiser's distance
    from converged needs to fall to one, where it falls; else at most those up to `max_steps`. It is not said while only
    the iteration that was compiled is timed, and at the end.
    """
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
