"""The shell's commands, after `mpmjax_command` has read their options: run, study, check, fit, chart, describe."""

import csv
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mpmjax.analysis import METHODS, Trial, energy, grid_mass, name_of, pieces, work_precision
from mpmjax.checks import require, warn
from mpmjax.cli._fit_file import FitFile, read_fit, refinements
from mpmjax.cli._scene_file import Simulation, read_scene_file, read_simulation, step_of
from mpmjax.fitting import Experiment, FitProblem, Profile, fit, fit_refined, fit_staged, profile
from mpmjax.io import FIELDS_WRITTEN, check_place, load, record, replacing, reporting, standing_in, stopping, table
from mpmjax.native import BACKENDS, backend
from mpmjax.simulation import Problem, Run, SimulationError, initial_state, no_steps, run_to
from mpmjax.state import Particles
from mpmjax.stepping import Explicit, stable_dt, step
from mpmjax.viz import draw_chart, render, write_fit, write_trials


def run_scene(
    path: Path,
    output: Path,
    changes: Sequence[str] = (),
    *,
    overwrite: bool = False,
    resume: bool = False,
    quiet: bool = False,
    most_seconds: float | None = None,
) -> None:
    """Simulate a scene file after changes to it, and write the run's frames."""
    done = standing_in(output)[1] if resume else 0
    if not resume:
        check_place(output, overwrite=overwrite)
    started = time.perf_counter()
    simulation = _chosen(path, most_seconds, changes, quiet=quiet)
    begun = time.perf_counter()
    with _compilation() as compiled:
        run = record(
            output,
            simulation.scene,
            simulation.particles,
            **simulation.settings,
            **simulation.output,
            overwrite=overwrite,
            resume=resume,
            progress=not quiet,
        )
    taken, seconds = int(run.statistics.steps) - done, time.perf_counter() - begun
    compiling, frames = min(compiled[0], seconds), standing_in(output)[0]
    with reporting(lambda: f"{output} is complete."):
        for line in _summary(simulation.particles, run, taken, seconds):
            print(_line(*line))
        bound = float(stable_dt(run.scene, run.final, method=run.method)) if taken else np.inf
        if np.isfinite(bound):
            print(_line("dt", f"{float(run.dt) / bound:.3g} of the longest that is stable as particles are at the end"))
        stages = f"{begun - started:.3g} s set-up, {compiling:.3g} s compiling, {seconds - compiling:.3g} s steps"
        print(_line("stages", stages))
        end = f"t = {float(run.final_step * run.dt):.6g} s"
        print(_line("end", f"{end}, {frames} frames"))
    reached = f" complete already: it reaches {end}" if resume and not taken else ""
    print(_line("written", f"{output} ({_bytes(output.stat().st_size)}){reached}"))


def study_scene(
    path: Path, output: Path, changes: Sequence[str], members: Sequence[Sequence[str]], *, quiet: bool = False
) -> None:
    """Simulate a scene file once for each of some sets of further changes, by one compiled program, and write a CSV
    file with a row each: what changes, the numbers of the last frame (see `table`), and what a run that failed says."""

    def simulation(member: Sequence[str]) -> Simulation:
        return read_simulation(path, [*changes, *member])

    def shapes(simulation: Simulation) -> Any:
        parts = simulation.scene, simulation.particles, simulation.method
        return jax.tree.structure(parts), [np.shape(leaf) for leaf in jax.tree.leaves(parts)]

    first, rows = simulation(members[0]), list[dict[str, Any]]()
    same = True
    with suppress(ValueError):  # one that cannot be is a row
        same = shapes(simulation(members[-1])) == shapes(first)
    require(same, f"--vary takes numbers that change neither particles nor nodes, but {', '.join(members[-1])} does.")
    standing = f"{output} has {{}} of {len(members)} rows.".format
    with TemporaryDirectory() as folder, reporting(lambda: standing(len(rows))):
        frames = Path(folder) / "frames"
        for member in members:
            failure = ""
            try:
                here = simulation(member)
                settings = here.settings | {"save_every": first.save_every}
                record(frames, here.scene, here.particles, **settings, **here.output)
            except (ValueError, SimulationError) as error:
                failure = str(error).split(f" {frames}")[0]
            numbers = {name: column[-1] for name, column in table(frames).items()} if frames.exists() else {}
            rows.append(dict(change.split("=", 1) for change in member) | numbers | {"failure": failure})
            frames.unlink(missing_ok=True)
            names = sorted({name: None for row in rows for name in row}, key=lambda name: name == "failure")
            with replacing(output) as aside, open(aside, "w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, names)
                writer.writeheader()
                writer.writerows(rows)
            if not quiet:
                end = failure or f"t = {numbers['time [s]']:.6g} s, total energy {numbers['total energy [J]']:.6g} J"
                print(f"{len(rows)} of {len(members)}: {', '.join(member)}: {end}", flush=True)
    failed = sum(bool(row["failure"]) for row in rows)
    print(f"written {output} ({len(rows)} rows{f', {failed} of runs that failed' * (failed > 0)})")


@contextmanager
def _compilation() -> Iterator[list[float]]:
    """The seconds that XLA has compiled in this process since the block began."""
    spent = [0.0]

    def add(event: str, duration_secs: float, **_: Any) -> None:
        spent[0] += duration_secs if event.endswith("backend_compile_duration") else 0.0

    jax.monitoring.register_event_duration_secs_listener(add)
    try:
        yield spent
    finally:
        jax.monitoring.unregister_event_duration_listener(add)


def _chosen(scene: Path, most_seconds: float | None, changes: Sequence[str] = (), *, quiet: bool = False) -> Simulation:
    """The simulation of a scene file; pilot runs are reported on standard error, their choice on standard output."""
    told = {} if quiet else {"progress": lambda trial: _print_error(_row(trial)), "say": _print_error}
    simulation = read_simulation(scene, changes, most_seconds=most_seconds, **told)
    if simulation.choice is not None:
        print(_line("chosen", simulation.choice))
    return simulation


def _print_error(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _line(name: str, text: str) -> str:
    return f"{name:<18} {text}"


def _bytes(size: int | float) -> str:
    k, unit = next((k, unit) for k, unit in ((1e9, "GB"), (1e6, "MB"), (0, "kB")) if size >= k)
    return f"{size / (k or 1e3):.3g} {unit}"


def _summary(start: Particles, run: Run, taken: int = 0, seconds: float = 0.0) -> Iterator[tuple[str, str]]:
    """The cost of `taken` steps of a run in these seconds, if any, and how well it kept mass and energy."""
    s, p, steps = run.statistics, run.final.count, max(int(run.statistics.steps), 1)
    before, after = energy(run.scene, start), energy(run.scene, run.final)
    whole, parts = pieces(run.scene, start), pieces(run.scene, run.final)
    mass, linearisation = float(run.final.mass.sum()), float(s.linearisation_error)
    yield "particles", f"{p}"
    yield "steps", f"{int(s.steps)} of {float(run.dt):.4g} s with {type(run.method).__name__}"
    if taken:
        rate = f"{taken * p / (seconds or 1):.3g} particle-steps per second"
        yield "wall time", f"{seconds:.3g} s, {rate}, both with compilation"
        yield "sums", f"{backend()}"
    if int(s.iterations):
        iterations = f"{int(s.iterations) / steps:.3g} iterations a step, at most {int(s.most_iterations)}"
        yield "solver", f"{iterations}, worst relative residual {float(s.worst_residual):.2g}"
    if linearisation > 0:
        yield "linearisation", f"error of at most {linearisation:.2g} of the elastic force in a step"
    if int(s.newton):
        yield "Newton", f"{int(s.newton) / steps:.3g} a step, {int(s.line_search)} halvings"
    if int(s.indefinite):
        advice = 'if the motion looks wrong, reduce dt or take hessian = { kind = "AnalyticHessian", projected = true }'
        yield "indefinite", f"the system of {int(s.indefinite)} of {steps} steps: compressed material; {advice}"
    if int(s.violations):
        yield "contact", f"{int(s.violations)} conditions left violated"
    if parts > whole:
        advice = "this is numerical fracture: more particles a cell, or TotalLagrangian"
        yield "pieces", f"{whole} at the start, {parts} at the end; if nothing was to part, {advice}"
    end = float(run.final_step * run.dt)
    for what, received in (("collider", run.final_collider_impulse), ("boundary", run.final_boundary_impulse)):
        for k, impulse in enumerate(() if received is None or not end > 0 else np.asarray(received.impulse)):
            yield f"on {what} {k}", f"a mean force of {', '.join(f'{a:.6g}' for a in impulse / end)} N"
    for name in ("kinetic", "elastic", "potential", "total"):
        a, b = float(getattr(before, name)), float(getattr(after, name))
        yield f"{name} energy", f"{a + 0.0:.6g} J to {b + 0.0:.6g} J, change {b - a:+.3g} J"
    lost = (float(grid_mass(run.scene, run.final)) - mass) / mass
    yield "mass", f"{mass:.6g} kg; relative error of the grid's mass {lost:+.1e}"


def fit_scene(
    scene: Path,
    changes: Sequence[str],
    plot: Path,
    grids: tuple[int, ...] | None,
    profiles: Sequence[str],
    *,
    log: Path | None,
    resume: bool,
    most_seconds: float | None,
) -> None:
    """Fit what a scene file's [fit] table names, after changes to that file: on its grids, or those asked for, with
    profiles of some of it."""
    begun = time.perf_counter()
    asked = read_fit(scene, lambda file: _chosen(file, most_seconds, changes if file == scene else ()))
    grids = asked.refine if grids is None else refinements(grids, "--refine")
    if grids:
        asked.refined(grids[-1])  # a grid that cannot be is refused before the first fit
    labels = FitProblem(asked.experiments, asked.parameters).labels
    unknown = [name for name in profiles if name not in labels]
    require(not unknown, f"--profile names {unknown[:1]}, but what is fitted is {', '.join(labels)}.")
    common: dict[str, Any] = {"report": asked.report, "level": asked.level, "optimiser": asked.optimiser}
    common |= {"log": log, "resume": resume, "starts": asked.starts}
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
            common["discretisation"] = asked.discretisation
            outcome = fit(asked.experiments, asked.parameters, progress=progress, **common)
            fits, whole = (outcome,), asked.whole
        print(outcome)
        result, iterations = fits[-1], sum(len(each.history) for each in fits)
        drawn: list[Profile] = []  # after a signal those that are done
        wanted = [] if result.interrupted else profiles
        try:
            for name in wanted:
                drawn.append(profile(result, name, progress=progress))
        except KeyboardInterrupt:
            _print_error(f"{len(drawn)} of {len(wanted)} profiles are done.")
    for each in drawn:
        print(each)
    if not result.interrupted:
        result.warn_of_runs()
    print(f"{iterations} simulations with exact derivatives, {time.perf_counter() - begun:.3g} s in all", flush=True)
    print(f"written {plot} and {write_fit(outcome, plot, whole, tuple(drawn))}")
    if stop.signal or result.interrupted:
        sys.exit(128 + (stop.signal or signal.SIGINT))


def _from_a_better_start(asked: FitFile, progress: Callable[[str], None]) -> FitFile:
    """The fit, started where a fit to growing horizons ended if the file asks for these, to the data they reach."""
    if not asked.horizons:
        return asked
    times = None if asked.horizons is True else asked.horizons
    common: dict[str, Any] = {"level": asked.level, "progress": progress, "optimiser": asked.optimiser}
    staged = fit_staged(asked.experiments, asked.parameters, horizons=times, **common)
    print(staged)

    def until(experiments: tuple[Experiment, ...]) -> tuple[Experiment, ...]:
        return tuple(e.until(fitted.t1) for e, fitted in zip(experiments, staged.experiments, strict=True))

    def refined(n: int) -> tuple[tuple[Experiment, ...], tuple[Experiment, ...]]:
        fitted, whole = asked.refined(n)
        return until(fitted), whole

    parameters = staged.restarted(asked.parameters)
    return asked._replace(parameters=parameters, experiments=until(asked.experiments), refined=refined)


def chart_scene(scene: Path, output: Path, changes: Sequence[str], *, error: float, most_seconds: float | None) -> None:
    """Chart a scene file's error against seconds, and name the cheapest setting for an error."""
    file = read_scene_file(scene, changes)
    print(
        f"{'method':>24} {'spacing':>10} {'dt [s]':>10} {'steps':>9} {'seconds':>9} {'error':>9} {'linearisation':>13}",
        flush=True,
    )
    dt = step_of(scene, file)
    extra = () if dt is None or file.run.method is None else ((file.run.method, dt),)
    comparison = work_precision(
        file.build,
        t1=file.run.t1,
        error=error,
        also=extra,
        most_seconds=file.run.most_seconds if most_seconds is None else most_seconds,
        progress=lambda trial: print(_row(trial), flush=True),
        say=_print_error,
    )
    print(comparison.verdict())
    print(f"written {draw_chart(comparison, output)} and {write_trials(comparison, output.with_suffix('.csv'))}")


def _row(trial: Trial) -> str:
    outcome = "failed" if np.isinf(trial.error) else "foreseen" if np.isnan(trial.error) else f"{trial.error:.2e}"
    linearisation = f"{trial.linearisation_error:.1e}" if trial.linearisation_error > 0 else ""
    return (
        f"{name_of(trial.method):>24} {f'1 / {trial.refinement}':>10} {trial.dt:10.3g} {trial.steps:9d} "
        f"{trial.seconds:9.3g} {outcome:>9} {linearisation:>13}"
    )


def check_scene(path: Path, changes: Sequence[str], plot: Path | None) -> None:
    """Say what a scene file holds, how long its steps may be, and what a step of it takes, by trying one."""
    file = read_scene_file(path, changes)
    scene, particles, run = file.scene, file.particles, file.run
    x, dx = np.asarray(particles.x), float(scene.grid.spacing)

    def say(name: str, text: str) -> None:
        print(_line(name, text), flush=True)

    say("materials", ", ".join(scene.titles))
    each = float(scene.grid.section(x, particles.volume).mean()) / dx**particles.dim
    say("particles", f"{particles.count} of {particles.x.dtype}, {1 / each:.3g} a cell, {particles.mass.sum():.6g} kg")
    say("from, to", f"{x.min(axis=0)} m, {x.max(axis=0)} m")
    say("grid", f"{' x '.join(map(str, scene.grid.shape))} = {scene.grid.size} nodes, {dx:.4g} m apart")
    bounds = {name_of(method): float(stable_dt(scene, particles, method=method)) for method in METHODS}
    say("longest step", ", ".join(f"{name} {dt:.3g} s" for name, dt in bounds.items() if np.isfinite(dt)))
    say("without bound", ", ".join(name for name, dt in bounds.items() if np.isinf(dt)))
    method, dt = run.method, step_of(path, file)
    if method is not None and dt is not None:
        of_explicit, bound = dt / bounds[name_of(Explicit())], float(stable_dt(scene, particles, method=method))
        say("steps", f"{run.t1 / dt:.0f} of {dt:.4g} s with {name_of(method)}, {of_explicit:.3g} of Explicit's longest")
        begun = time.perf_counter()
        stepped = jax.jit(lambda q, t: step(scene, q, t, dt, method=method)[0]).lower(particles, 0.0).compile()
        after, begun, compiled = stepped(particles, 0.0), time.perf_counter(), time.perf_counter() - begun
        jax.block_until_ready(stepped(after, dt))
        seconds = time.perf_counter() - begun
        say("a step takes", f"{seconds:.2g} s once compiled ({compiled:.2g} s): {seconds * run.t1 / dt:.2g} s in all")
        used = stepped.memory_analysis()
        if used is not None:
            say("memory", f"{_bytes(used.temp_size_in_bytes + used.argument_size_in_bytes)} in a step")
        fields = file.output.get("fields", FIELDS_WRITTEN)
        numbers = 16 + 9 * (particles.C is not None) + len(fields) + 8 * ("stress" in fields)  # 16 of x, v, J and F
        frames = run.t1 / dt / (run.save_every or 1) + 1
        say("file", f"at most {_bytes(frames * particles.count * numbers * particles.x.dtype.itemsize)}")
        if dt > bound:
            warn(f"the step is {dt / bound:.3g} times the longest stable one: the run is likely to blow up.")
        if not np.asarray(after.v).any():
            warn("nothing moves in the first step: there is no gravity, load, velocity or motion yet.")
        if (far := dt * float(np.abs(np.asarray(after.v)).max()) / dx) > 1:
            warn(f"particles cross {far:.3g} cells in a step: take a shorter one.")
    else:
        say("steps", f"are chosen by pilot runs: mpmjax chart {path} shows them")
    if plot is not None:
        zero = jnp.zeros(1, particles.x.dtype)
        problem = Problem(scene, particles, zero[0], Explicit())
        state = initial_state(problem)
        frames = jax.tree.map(lambda a: a[None], state)
        render(run_to(problem, state, 0, no_steps(particles.x.dtype), frames, steps=zero), plot, colour=None)
        say("written", str(plot))


def describe_run(path: Path, table_path: Path | None = None) -> str:
    """A run's file in words; its table as CSV, if a place for that is given."""
    run = load(path)
    described = [
        ("file", f"{path}, {_bytes(path.stat().st_size)}, {run.final.x.dtype}"),
        ("frames", f"{len(run)}, from t = {float(run.times[0]):.6g} s to {float(run.times[-1]):.6g} s"),
        ("materials", ", ".join(run.scene.titles)),
        *_summary(run.frame(0), run),
    ]
    if table_path is not None:
        columns = table(path)
        with replacing(table_path) as aside:
            head = ",".join(columns)
            np.savetxt(aside, np.stack(list(columns.values()), axis=1), "%.17g", ",", header=head, comments="")
        described.append(("written", str(table_path)))
    return "\n".join(_line(*line) for line in described)


def installation() -> str:
    """The versions that run, the devices, and who sums between particles and nodes."""
    lines = [(name, version(name)) for name in ("mpmjax", "jax", "jaxlib")]
    lines += [("devices", ", ".join(map(str, jax.devices()))), ("sums", f"{backend()}")]
    lines += [(kind.name, kind.absence() or "can be used") for kind in BACKENDS]
    return "\n".join(f"{name:<10} {text}" for name, text in lines)
