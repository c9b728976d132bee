"""The shell's `mpmjax`: its options, and what is refused before a room is imported, which takes a second."""

import hashlib
import importlib
import importlib.util
import itertools
import json
import math
import os
import platform
import re
import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import wraps
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer

from mpmjax._tables import SCHEMA, scene_table

app = typer.Typer(
    help="A differentiable Material Point Method.", no_args_is_help=True, add_completion=False, rich_markup_mode=None
)
_handles_signals = False


def main() -> None:
    """Entry point of the `mpmjax` command."""
    global _handles_signals
    _handles_signals = True
    _keep_programs()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # quiet too while that goes on
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    app()


@contextmanager
def _package(imports: Sequence[str] | None = None) -> Iterator[Any]:
    """`mpmjax.cli` with 64-bit numbers, after the import of modules, each by its name or the path of its .py file:
    files know what these register from then on."""
    for name in imports or ():
        if name.endswith(".py"):
            _require(Path(name).is_file(), f"--import: there is no file {name}.")
        else:
            there = importlib.util.find_spec(name.partition(".")[0])
            _require(there, f"--import: Python finds no module {name!r}; name its .py file instead.")
    import jax

    from mpmjax import cli, io

    if _handles_signals:
        io.end_on_signals()
    with jax.enable_x64(True):
        for name in imports or ():
            path = Path(name)
            try:
                if path.suffix != ".py":
                    importlib.import_module(name)
                elif (spec := importlib.util.spec_from_file_location(path.stem, path)) and spec.loader:
                    sys.modules[path.stem] = module = importlib.util.module_from_spec(spec)
                    spec.loader.exec_module(module)
            except Exception as error:  # of the user's own code, which may raise anything
                place = traceback.extract_tb(error.__traceback__)[-1]
                placed = isinstance(error, (ImportError, SyntaxError))  # which say the place themselves
                where = "" if placed else f" ({place.filename}, line {place.lineno})"
                raise ValueError(f"--import {name}: {type(error).__name__}: {error}{where}") from None
        yield cli


def _keep_programs() -> None:
    """Have JAX keep what it compiles for the next command on such a processor, and not fill pages on other ones."""
    with suppress(OSError):
        cpu = Path("/proc/cpuinfo").read_bytes() if Path("/proc/cpuinfo").exists() else b""
        kind = b"".join(re.findall(rb"(?im)^(?:flags|features).*", cpu)[:1]) or platform.processor().encode()
        caches = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
        folder = caches / "mpmjax" / hashlib.sha256(kind).hexdigest()[:8]
        folder.mkdir(parents=True, exist_ok=True)
        settings = {"JAX_COMPILATION_CACHE_DIR": str(folder), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        os.environ.update({**settings, **os.environ})  # the user's own hold
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") == "1":  # or is what JAX set in a process that starts this one
        os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"  # else XLA names features at each program that it takes from there


def _require(condition: Any, message: str) -> None:
    if not condition:
        raise ValueError(message)


def _require_folder(path: Path | None) -> None:
    there = path is None or path.resolve().parent.is_dir()
    _require(there, f"{path} cannot be written (no folder {path and path.parent}): name a place that can be.")


def _command(command: Callable[..., None]) -> Callable[..., None]:
    """Make a function a command, which tells its errors in one line and exits with code 2."""

    def tell(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    @wraps(command)
    def guarded(*args: Any, **kwargs: Any) -> None:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("default", UserWarning)
                warnings.showwarning = lambda message, *_: tell(f"warning: {' '.join(str(message).split())}")
                command(*args, **kwargs)
                sys.stdout.flush()
        except BrokenPipeError:  # who reads, such as `head`, has enough; what is left must not fail at the exit again
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(1) from None
        except typer.Exit:  # a RuntimeError too
            raise
        except (ValueError, RuntimeError, OSError, MemoryError, ImportError) as error:
            tell(f"mpmjax: {' '.join(str(error).split()) or 'there is not enough memory for this'}")
            raise typer.Exit(2) from None

    return app.command()(guarded)


def _numbers_of(span: str) -> list[str]:
    """The changes KEY=VALUE of one --vary."""
    key, _, numbers = span.partition("=")
    try:
        first, last, n, *logarithmic = numbers.split(":")
        a, b, parts = float(first), float(last), int(n) - 1
        log = logarithmic == ["log"]
        valid = key and parts > 0 and math.isfinite(b - a) and (log or not logarithmic) and (a > 0 < b or not log)
    except ValueError:
        valid, a, b, parts, log = False, 0.0, 0.0, 1, False
    example = "material.youngs_modulus=1e5:1e6:5, or with :log for equal ratios of positive numbers"
    _require(valid, f"--vary must be KEY=A:B:N, two numbers at least, such as {example}, got {span!r}.")
    inside = [a * (b / a) ** (i / parts) if log else a + (b - a) * i / parts for i in range(1, parts)]
    return [f"{key}={float(f'{value:.15g}')!r}" for value in (a, *inside, b)]  # 0.3, not 0.30000000000000004


MostSeconds = Annotated[
    float | None,
    typer.Option(help="What pilot runs may take, compilation included. Default: the file's most_seconds, or 60."),
]
Imports = Annotated[
    list[str] | None,
    typer.Option(
        "--import",
        metavar="MODULE",
        help="A module, or its .py file, that registers classes of your own (mpm.register); its code is executed.",
    ),
]
ScenePath = Annotated[
    Path, typer.Argument(metavar="SCENE", help="A TOML scene file; docs/scene_files.md is its schema.")
]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="An HDF5 file of a run.")]
Changes = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change the file's key, such as grid.spacing=0.05; repeatable."),
]


@app.callback(invoke_without_command=True)
def _(
    show_version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False,
) -> None:
    if show_version:
        print(f"mpmjax {version('mpmjax')}")
        raise typer.Exit


@_command
def run(
    scene: ScenePath,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The HDF5 file to write; ParaView opens it. Default: SCENE.vtkhdf here."),
    ] = None,
    overwrite: Annotated[bool, typer.Option(help="Replace the output file if it exists.")] = False,
    resume: Annotated[bool, typer.Option(help="Continue the output file from its last frame.")] = False,
    dt: Annotated[str | None, typer.Option(metavar="S", help='Another step [s], "stable" or "auto".')] = None,
    t1: Annotated[float | None, typer.Option(help="Another end time [s].")] = None,
    steps: Annotated[int | None, typer.Option(help="End after so many steps, whatever t1.")] = None,
    method: Annotated[str | None, typer.Option(help="Another method, such as Explicit.")] = None,
    changes: Changes = None,
    spans: Annotated[
        list[str] | None,
        typer.Option(
            "--vary",
            metavar="KEY=A:B:N[:log]",
            help="A study: a run for each of N numbers from A to B, of several keys for each combination. No frames "
            "are kept: SCENE_study.csv, or -o, has a row with the end of each run.",
        ),
    ] = None,
    quiet: Annotated[bool, typer.Option(help="No progress bar.")] = False,
    most_seconds: MostSeconds = None,
    imports: Imports = None,
) -> None:
    """Simulate a scene and write its frames."""
    _require(not (overwrite and resume), "--overwrite starts a file anew and --resume continues it: give one of them.")
    _require(steps is None or t1 is None, "--steps and --t1 both say where the run ends: give one of them.")
    output = Path(f"{scene.stem}_study.csv" if spans else f"{scene.stem}.vtkhdf") if output is None else output
    _require(not spans or output.suffix == ".csv", f"--vary writes a table, a .csv file, got -o {output}.")
    _require(not (spans and resume), "--resume continues one run, not a study: leave it or --vary out.")
    free = overwrite or resume or not output.exists()
    _require(free, f"{output} exists: choose another name, or give --overwrite or --resume.")
    _require_folder(output)
    overrides = {"dt": dt, "t1": t1, "method": method}
    changed = [*(changes or ()), *(f"run.{key}={value}" for key, value in overrides.items() if value is not None)]
    more = bool(imports)
    settings = scene_table(scene, changed, more=more)["run"]
    if steps is not None:
        step = settings.get("dt") if isinstance(settings, dict) else None
        known = isinstance(step, (int, float)) and steps > 0
        _require(known, "--steps must be positive and needs a step in seconds, from the file or by --dt.")
        changed.append(f"run.t1={steps * float(step or 0)!r}")
    members = list(itertools.product(*map(_numbers_of, spans or ())))
    if spans:
        scene_table(scene, [*changed, *members[0]], more=more)
        _require("auto" not in map(settings.get, ("dt", "method")), '--vary needs a method, and a step or "stable".')
        with _package(imports) as cli:
            cli.study_scene(scene, output, changed, members, quiet=quiet)
        return
    options = {"overwrite": overwrite, "resume": resume, "quiet": quiet, "most_seconds": most_seconds}
    with _package(imports) as cli:
        cli.run_scene(scene, output, changed, **options)


@_command
def check(
    scene: ScenePath,
    plot: Annotated[Path | None, typer.Option(help="A picture of the particles as they start, to write.")] = None,
    changes: Changes = None,
    imports: Imports = None,
) -> None:
    """Describe a scene: size, longest step, seconds, what looks wrong."""
    scene_table(scene, changes or (), fit=True, more=bool(imports))
    _require_folder(plot)
    with _package(imports) as cli:
        cli.check_scene(scene, changes or (), plot)


@_command
def fit(
    scene: ScenePath,
    plot: Annotated[Path | None, typer.Option(help="The picture to write. Default: SCENE_fit.png here.")] = None,
    log: Annotated[
        Path | None, typer.Option(help="An HDF5 file that is to hold each iteration; with --refine one a grid.")
    ] = None,
    resume: Annotated[bool, typer.Option(help="Continue the fit of the log.")] = False,
    refine: Annotated[
        str | None, typer.Option(metavar="N[,N]", help="Fit on N times as many cells a direction too, and extrapolate.")
    ] = None,
    profiles: Annotated[
        list[str] | None,
        typer.Option("--profile", metavar="NAME", help="A fitted number whose profile is drawn; repeatable."),
    ] = None,
    changes: Changes = None,
    most_seconds: MostSeconds = None,
    imports: Imports = None,
) -> None:
    """Fit parameters to what was measured.

    What to fit says the file's [fit] table. It prints a table, and writes a picture and its numbers as JSON. Ctrl-C
    ends it after the iteration in progress, with the best so far."""
    _require(log is not None or not resume, "--resume continues the fit of a log: name it by --log.")
    table = scene_table(scene, changes or (), fit=True, more=bool(imports))
    _require("fit" in table, f"{scene} has no [fit] table: there is nothing to fit.")
    plot = Path(f"{scene.stem}_fit.png") if plot is None else plot
    _require_folder(plot)
    try:
        grids = tuple(int(part) for part in refine.split(",")) if refine is not None else None
    except ValueError:
        raise ValueError(f"--refine must be whole numbers with commas, such as 2, got {str(refine)[:20]!r}.") from None
    with _package(imports) as cli:
        options = {"log": log, "resume": resume, "most_seconds": most_seconds}
        cli.fit_scene(scene, changes or (), plot, grids, profiles or (), **options)


@_command
def chart(
    scene: ScenePath,
    error: Annotated[float, typer.Option(help="The relative error of the motion that is asked for.")] = 1e-2,
    changes: Changes = None,
    most_seconds: MostSeconds = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="The chart to write, its numbers beside it as .csv.")
    ] = None,
    imports: Imports = None,
) -> None:
    """Find the cheapest method and step for an error."""
    scene_table(scene, changes or (), more=bool(imports))
    output = Path(f"{scene.stem}_chart.png") if output is None else output
    _require_folder(output)
    with _package(imports) as cli:
        cli.chart_scene(scene, output, changes or (), error=error, most_seconds=most_seconds)


def _angles(text: str) -> tuple[float, float]:
    try:
        azimuth, elevation = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not AZIMUTH,ELEVATION in degrees, such as -135,30.") from None
    return azimuth, elevation


@_command
def render(
    path: RunPath,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="A picture: .png, .pdf, .svg; a film: .gif or .mp4 of all frames.")
    ],
    colour: Annotated[
        str,
        typer.Option(
            help="What colours the particles: speed, J, energy, pressure, von_mises, density, material, mass, volume, "
            "particle, none, or what a law remembers."
        ),
    ] = "speed",
    frame: Annotated[int | None, typer.Option(help="The frame of a still; negative from the end.")] = None,
    view: Annotated[
        tuple,
        typer.Option(
            parser=_angles, metavar="AZIMUTH,ELEVATION", help="Of the eye, in degrees: where a run in 3-D is seen from."
        ),
    ] = "30,20",  # pyright: ignore[reportArgumentType]  # parsed as if it had been given
    dpi: Annotated[float, typer.Option(help="Resolution.")] = 120.0,
    fps: Annotated[int, typer.Option(help="Frames a second of an animation.")] = 20,
    imports: Imports = None,
) -> None:
    """Draw a run's particles."""
    _require(path.exists(), f"{path} does not exist: check its name.")
    _require_folder(output)
    with _package(imports):
        import mpmjax as mpm

        mpm.render(mpm.load(path), output, colour=colour, frame=frame, view=view, fps=fps, dpi=dpi)
    print(f"written {output}")


@_command
def info(
    path: Annotated[Path | None, typer.Argument(metavar="RUN", help="An HDF5 file of a run, to describe.")] = None,
    table: Annotated[
        Path | None, typer.Option(help="A CSV file to write: energies, reactions and solver statistics of each frame.")
    ] = None,
    imports: Imports = None,
) -> None:
    """Describe a run's file, or the installation.

    Without a file it says which versions run, on which devices, and who sums between particles and nodes."""
    _require(path is None or path.exists(), f"{path} does not exist: check its name.")
    _require(path is not None or table is None, "--table is of a run: name its file.")
    _require_folder(table)
    with _package(imports) as cli:
        print(cli.installation() if path is None else cli.describe_run(path, table))


@_command
def schema(imports: Imports = None) -> None:
    """Print the JSON schema of scene files, for editors.

    Save it, and begin a scene file with the line "#:schema scene.schema.json"."""
    if imports:
        with _package(imports) as cli:
            print(json.dumps(cli.scene_schema(), separators=(",", ":")))
    else:
        print(SCHEMA.read_text(encoding="utf-8"), end="")


@_command
def example(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="Such as jelly. Without it they are listed.")
    ] = None,
) -> None:
    """Copy an example into examples/ here, or list them."""
    here = Path(__file__).parent
    folder = next(path for path in (here / "mpmjax/examples", here / "examples") if path.is_dir())  # wheel, clone
    titles = {}
    for path in sorted((*folder.glob("*.toml"), *folder.glob("*.py"))):
        text = re.sub(r'^(# %% \[markdown\])?[#"\s]*', "", path.read_text(encoding="utf-8"))
        titles[path.name] = re.split(r"[.:;](?:\s|$)", text, maxsplit=1)[0].replace("\n# ", " ")
    if name is None:
        print("\n".join(f"{file:<22} {title}" for file, title in titles.items()))
        return
    names = [file for file in titles if name in (file, Path(file).stem)]
    _require(names, f"There is no example {name!r}; there are {', '.join(titles)}.")
    for file in names:  # grows by the files that each names
        target, text = Path("examples", file), (folder / file).read_text(encoding="utf-8")
        same = not target.exists() or target.read_text(encoding="utf-8") == text
        _require(same, f"{target} exists and differs: move it away.")
        named = {path.removeprefix("examples/") for path in re.findall(r"[\w/]+\.(?:csv|toml)\b", text)}
        names += sorted(path for path in named - set(names) if (folder / path).is_file())
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text, encoding="utf-8")
        print(f"written {target}")
    commands = re.findall(r"^# +((?:mpmjax|python) .*)$", (folder / names[0]).read_text(encoding="utf-8"), re.MULTILINE)
    print("\n".join(commands or [f"python examples/{names[0]}"]))
