"""The shell's commands: `mpmjax run`, `mpmjax fit`, `mpmjax chart`, `mpmjax render`, `mpmjax info`."""

import importlib
import importlib.util
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from functools import wraps
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import typer

from mpmjax.analysis import Trial, energy, grid_mass, name_of, pieces, work_precision
from mpmjax.checks import require, shortened
from mpmjax.cli._fit_file import FitFile, read_fit, refinements
from mpmjax.cli._scene_file import Simulation, read_scene_file, read_simulation, stable_step
from mpmjax.fitting import (
    Experiment,
    FitProblem,
    Profile,
    fit,
    fit_multistart,
    fit_refined,
    fit_staged,
    predict_observations,
    profile,
)
from mpmjax.io import check_place, end_on_signals, load, record, reporting, steps_in, stopping
from mpmjax.native import backend
from mpmjax.simulation import Run
from mpmjax.viz import COLOURS, draw_chart, draw_fit, render, write_fit, write_trials

app = typer.Typer(
    help="A differentiable Material Point Method.", no_args_is_help=True, add_completion=False, rich_markup_mode=None
)


def _reporting(command: Callable[..., None]) -> Callable[..., None]:
    """Decorate a command to tell its errors in one line and exit with code 2."""

    @wraps(command)
    def guarded(*args: Any, **kwargs: Any) -> None:
        try:
            with jax.enable_x64(True), warnings.catch_warnings():
                warnings.simplefilter("default", UserWarning)
                warnings.showwarning = lambda message, *_: _print_error(f"warning: {' '.join(str(message).split())}")
                command(*args, **kwargs)
        except typer.Exit:  # a RuntimeError too
            raise
        except (ValueError, RuntimeError, OSError, MemoryError) as error:
            told = " ".join(str(error).split()) or "there is not enough memory for this"
            print(f"mpmjax: {told}", file=sys.stderr)
            raise typer.Exit(2) from None

    return guarded


MostSeconds = Annotated[
    float | None,
    typer.Option(help="What pilot runs may take, compilation included. Default: the file's most_seconds, or 60."),
]


def _import(modules: list[str] | None) -> None:
    """Import modules, each by its name or by the path of its .py file: files know what they register from then on."""
    for name in modules or []:
        path = Path(name)
        if path.suffix == ".py":
            require(path.is_file(), f"--import: there is no file {name}.")
        else:
            spec = importlib.util.find_spec(name.partition(".")[0])
            require(spec, f"--import: Python finds no module {name!r}; name its .py file instead.")
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


Imports = Annotated[
    list[str] | None,
    typer.Option(
        "--import",
        metavar="MODULE",
        help="A module, or its .py file, that registers classes of your own (mpm.register); its code is executed.",
    ),
]
ScenePath = Annotated[Path, typer.Argument(help="A TOML scene file; docs/scene_files.md is its schema.")]


@app.command("run")
@_reporting
def run_command(
    scene: ScenePath,
    output: Annotated[Path, typer.Option("--output", "-o", help="The HDF5 file to write; ParaView opens it.")],
    overwrite: Annotated[bool, typer.Option(help="Replace the output file if it exists.")] = False,
    resume: Annotated[bool, typer.Option(help="Continue the output file from its last frame.")] = False,
    quiet: Annotated[bool, typer.Option(help="No progress bar.")] = False,
    most_seconds: MostSeconds = None,
    imports: Imports = None,
) -> None:
    """Simulate a scene and write its frames."""
    _import(imports)
    require(not (overwrite and resume), "--overwrite starts a file anew and --resume continues it: give one of them.")
    done = steps_in(output) if resume else 0
    if not resume:
        check_place(output, overwrite=overwrite)
    simulation = _chosen(scene, most_seconds, quiet=quiet)
    begun = time.perf_counter()
    run = record(
        output,
        simulation.scene,
        simulation.particles,
        t1=simulation.t1,
        dt=simulation.dt,
        method=simulation.method,
        save_every=simulation.save_every,
        overwrite=overwrite,
        resume=resume,
        progress=not quiet,
    )
    taken, seconds = int(run.statistics.steps) - done, time.perf_counter() - begun
    with reporting(lambda: f"{output} is complete."):
        print(_summary(simulation, run, taken, seconds))
    reached = f"complete already: it reaches t = {float(run.final_step * run.dt):.6g} s" if resume and not taken else ""
    print(f"written            {output} {reached}".rstrip())


def _chosen(scene: Path, most_seconds: float | None, *, quiet: bool = False) -> Simulation:
    """The simulation of a scene file; pilot runs are reported on standard error, their choice on standard output."""
    told = {} if quiet else {"progress": lambda trial: _print_error(_line(trial)), "say": _print_error}
    simulation = read_simulation(scene, most_seconds=most_seconds, **told)
    if simulation.choice is not None:
        print(f"{'chosen':<18} {simulation.choice}")
    return simulation


def _print_error(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _summary(simulation: Simulation, run: Run, taken: int, seconds: float) -> str:
    """The cost of a run, with `taken` of its steps done in these seconds, and how well it kept mass and energy."""
    s, p, steps = run.statistics, run.final.count, max(int(run.statistics.steps), 1)
    before, after = energy(run.scene, simulation.particles), energy(run.scene, run.final)
    whole, parts = pieces(run.scene, simulation.particles), pieces(run.scene, run.final)
    mass, linearisation = float(run.final.mass.sum()), float(s.linearisation_error)
    lost = (float(grid_mass(run.scene, run.final)) - mass) / mass
    lines = [
        (True, "particles", f"{p}"),
        (True, "steps", f"{int(s.steps)} of {float(run.dt):.4g} s with {type(run.method).__name__}"),
        (
            True,
            "wall time",
            f"{seconds:.3g} s, {taken * p / seconds:.3g} particle-steps per second, both with compilation",
        ),
        (True, "sums", f"{backend()}"),
        (
            int(s.iterations) > 0,
            "solver",
            f"{int(s.iterations) / steps:.3g} iterations a step, at most {int(s.most_iterations)}, worst relative "
            f"residual {float(s.worst_residual):.2g}",
        ),
        (linearisation > 0, "linearisation", f"error of at most {linearisation:.2g} of the elastic force in a step"),
        (int(s.newton) > 0, "Newton", f"{int(s.newton) / steps:.3g} a step, {int(s.line_search)} halvings"),
        (
            int(s.indefinite) > 0,
            "indefinite",
            f"the system of {int(s.indefinite)} of {steps} steps: compressed material; if the motion looks wrong, "
            'reduce dt or take hessian = { kind = "AnalyticHessian", projected = true }',
        ),
        (int(s.violations) > 0, "contact", f"{int(s.violations)} conditions left violated"),
        (
            parts > whole,
            "pieces",
            f"{whole} at the start, {parts} at the end; if nothing was to part, this is numerical fracture: more "
            "particles a cell, or TotalLagrangian",
        ),
    ]
    for name in ("kinetic", "elastic", "potential", "total"):
        a, b = float(getattr(before, name)), float(getattr(after, name))
        lines.append((True, f"{name} energy", f"{a + 0.0:.6g} J to {b + 0.0:.6g} J, change {b - a:+.3g} J"))
    lines.append((True, "mass", f"{mass:.6g} kg; relative error of the grid's mass {lost:+.1e}"))
    return "\n".join(f"{name:<18} {text}" for shown, name, text in lines if shown)


@app.command("fit")
@_reporting
def fit_command(
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
    most_seconds: MostSeconds = None,
    imports: Imports = None,
) -> None:
    """Fit parameters to what was measured, as the file's [fit] table says: a table, a picture, and its numbers as
    JSON. Ctrl-C ends it after the iteration in progress, with the best so far."""
    _import(imports)
    begun = time.perf_counter()
    require(log is not None or not resume, "--resume continues the fit of a log: name it by --log.")
    asked = read_fit(scene, lambda file: _chosen(file, most_seconds))
    grids = asked.refine
    if refine is not None:
        try:
            numbers = tuple(int(part) for part in refine.split(","))
        except ValueError:
            text = shortened(refine, 20)
            raise ValueError(f"--refine must be whole numbers with commas, such as 2, got {text!r}.") from None
        grids = refinements(numbers, "--refine")
    if grids:
        asked.refined(grids[-1])  # a grid that cannot be is refused before the first fit
    plot = Path(f"{scene.stem}_fit.png") if plot is None else plot
    require(plot.resolve().parent.is_dir(), f"{plot} cannot be written (no folder {plot.parent}).")
    labels = FitProblem(asked.experiments, asked.parameters).labels
    unknown = [name for name in profiles or () if name not in labels]
    require(not unknown, f"--profile names {unknown[:1]}, but what is fitted is {', '.join(labels)}.")
    common: dict[str, Any] = {"report": asked.report, "level": asked.level, "optimiser": asked.optimiser}
    common |= {"log": log, "resume": resume}
    with stopping("The fit ends after the iteration in progress; a second signal ends it at once.") as stop:

        def progress(line: str) -> None:
            stop.ready = not line.startswith("compiling")
            _print_error(line)
            if stop.signal:
                raise KeyboardInterrupt

        asked = _from_a_better_start(asked, progress)
        if grids:
            outcome = fit_refined(
                lambda n: asked.refined(n)[0], asked.parameters, refinements=grids, progress=progress, **common
            )
            fits, whole = outcome.fits, asked.refined(outcome.refinements[-1])[1]
        else:
            outcome = fit(asked.experiments, asked.parameters, progress=progress, **common)
            fits, whole = (outcome,), asked.whole
        print(outcome)
        result, iterations = fits[-1], sum(len(each.history) for each in fits)
        drawn: list[Profile] = []  # after a signal those that are done
        wanted = [] if result.interrupted else profiles or []
        try:
            for name in wanted:
                drawn.append(profile(result, name, progress=progress))
        except KeyboardInterrupt:
            _print_error(f"{len(drawn)} of {len(wanted)} profiles are done.")
    for each in drawn:
        print(each)
    print(f"{iterations} simulations with exact derivatives, {time.perf_counter() - begun:.3g} s in all", flush=True)
    report = whole, tuple(drawn), predict_observations(result, whole)
    numbers = write_fit(outcome, plot.with_suffix(".json"), *report)
    print(f"written {draw_fit(result, plot, *report)} and {numbers}")
    if stop.signal or result.interrupted:
        raise typer.Exit(128 + (stop.signal or signal.SIGINT))


def _from_a_better_start(asked: FitFile, progress: Callable[[str], None]) -> FitFile:
    """The fit, started where many searches or a fit to growing horizons ended, if the file asks for these, to the data
    that the horizons reach."""
    common: dict[str, Any] = {"level": asked.level, "progress": progress, "optimiser": asked.optimiser}
    if asked.starts > 1:
        look = {"starts": asked.starts, "fraction": asked.fraction}
        many = fit_multistart(asked.experiments, asked.parameters, **look, **common)
        print(many)
        return asked._replace(parameters=many.best.restarted(asked.parameters))
    if not asked.horizons:
        return asked
    times = None if asked.horizons is True else asked.horizons
    staged = fit_staged(asked.experiments, asked.parameters, horizons=times, **common)
    print(staged)

    def until(experiments: tuple[Experiment, ...]) -> tuple[Experiment, ...]:
        return tuple(e.until(end) for e, end in zip(experiments, staged.horizons, strict=True))

    def refined(n: int) -> tuple[tuple[Experiment, ...], tuple[Experiment, ...]]:
        fitted, whole = asked.refined(n)
        return until(fitted), whole

    parameters = staged.result.restarted(asked.parameters)
    return asked._replace(parameters=parameters, experiments=until(asked.experiments), refined=refined)


@app.command("chart")
@_reporting
def chart_command(
    scene: ScenePath,
    error: Annotated[float, typer.Option(help="The relative error of the motion that is asked for.")] = 1e-2,
    most_seconds: MostSeconds = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="The chart to write, its numbers beside it as .csv.")
    ] = None,
    imports: Imports = None,
) -> None:
    """Chart a scene's error against seconds, and name the cheapest setting for an error."""
    _import(imports)
    file = read_scene_file(scene)
    output = Path(f"{scene.stem}_chart.png") if output is None else output
    print(
        f"{'method':>24} {'spacing':>10} {'dt [s]':>10} {'steps':>9} {'seconds':>9} {'error':>9} {'linearisation':>13}",
        flush=True,
    )
    dt = stable_step(scene, file) if file.run.dt == "stable" else file.run.dt
    extra = () if dt is None or file.run.method is None else ((file.run.method, float(dt)),)
    comparison = work_precision(
        file.build,
        t1=file.run.t1,
        error=error,
        also=extra,
        most_seconds=file.run.most_seconds if most_seconds is None else most_seconds,
        progress=lambda trial: print(_line(trial), flush=True),
        say=_print_error,
    )
    print(comparison.verdict())
    print(f"written {draw_chart(comparison, output)} and {write_trials(comparison, output.with_suffix('.csv'))}")


def _line(trial: Trial) -> str:
    outcome = "failed" if np.isinf(trial.error) else "foreseen" if np.isnan(trial.error) else f"{trial.error:.2e}"
    linearisation = f"{trial.linearisation_error:.1e}" if trial.linearisation_error > 0 else ""
    return (
        f"{name_of(trial.method):>24} {f'1 / {trial.refinement}':>10} {trial.dt:10.3g} {trial.steps:9d} "
        f"{trial.seconds:9.3g} {outcome:>9} {linearisation:>13}"
    )


def _angles(text: str) -> tuple[float, float]:
    try:
        azimuth, elevation = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not AZIMUTH,ELEVATION in degrees, such as -135,30.") from None
    return azimuth, elevation


@app.command("render")
@_reporting
def render_command(
    run: Annotated[Path, typer.Argument(help="An HDF5 file of a run.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="A picture: .png, .pdf, .svg, or .gif of all frames.")],
    colour: Annotated[
        str, typer.Option(help=f"What colours the particles: {', '.join(COLOURS)}, what a law remembers, none.")
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
    _import(imports)
    render(load(run), output, colour=colour, frame=frame, view=view, fps=fps, dpi=dpi)
    print(f"written {output}")


@app.command("info")
@_reporting
def info_command() -> None:
    """Say which versions run, on which devices, and who sums between particles and nodes."""
    lines = [(name, version(name)) for name in ("mpmjax", "jax", "jaxlib")]
    lines += [("devices", ", ".join(map(str, jax.devices()))), ("sums", f"{backend()}")]
    print("\n".join(f"{name:<10} {text}" for name, text in lines))


def main() -> None:
    """Entry point of the `mpmjax` command."""
    end_on_signals()
    app()
