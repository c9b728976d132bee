"""Errors under refinement, and observed orders of convergence."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mpmjax._types import Array, Float
from mpmjax.simulation import Run, simulate
from mpmjax.state import Particles
from mpmjax.stepping import AbstractIntegrator, Explicit
from mpmjax.verification._exact_problem import AbstractProblem, discretise, displacement_error

_SAMPLES = 10
Measure = Callable[[AbstractProblem, Particles, Run], Float[Array, "f"]]
"""The error of a run of a problem at each saved frame, shape (f,)."""


def errors(
    problem: AbstractProblem,
    cells: Sequence[int],
    *,
    courant: float | Sequence[float],
    method: AbstractIntegrator = Explicit(),
    staggered: bool | None = None,
    measure: Measure = displacement_error,
    **discretisation: Any,
) -> np.ndarray:
    """The displacement error on each grid [m], or another: the largest at ten times, evenly spaced over the duration.

    The error of a run that fails is infinite.

    Args:
        problem: the problem.
        cells: grid cells to a metre, for each grid.
        courant: Δt c/dx with c the pressure-wave speed at rest, for all grids or for each. It is rounded down so that
            ten whole numbers of steps fill the duration.
        method: the integrator.
        staggered: whether initial velocities are those half a step before the start (see `discretise`). Default: yes,
            except with methods of second order, whose velocities are at the time of the positions.
        measure: the error of a run at each saved frame: `displacement_error`, `stress_error`, or one's own.
        discretisation: further arguments of `discretise`, with `rest` particles of one's own.
    """
    numbers = [courant] * len(cells) if isinstance(courant, (int, float)) else courant
    return np.array(
        [_error(problem, n, c, method, staggered, measure, discretisation) for n, c in zip(cells, numbers, strict=True)]
    )


def orders(errors: np.ndarray, cells: Sequence[int]) -> np.ndarray:
    """The observed order between successive grids, log(e₁/e₂) / log(n₂/n₁)."""
    return np.log(errors[:-1] / errors[1:]) / np.log(np.divide(cells[1:], cells[:-1]))


def _error(
    problem: AbstractProblem,
    cells: int,
    courant: float,
    method: AbstractIntegrator,
    staggered: bool | None,
    measure: Measure,
    discretisation: dict[str, Any],
) -> float:
    longest = courant / (cells * problem.wave_speed)
    every = max(1, math.ceil(problem.duration / _SAMPLES / longest - 1e-9))
    dt = problem.duration / (_SAMPLES * every)
    start = -dt / 2 if staggered or (staggered is None and method.body_force_at == 0) else 0.0
    scene, particles = discretise(problem, cells, velocity_time=start, **discretisation)
    run = simulate(scene, particles, t1=problem.duration, dt=dt, method=method, save_every=every, throw=False)
    worst = float(measure(problem, particles, run).max())
    return worst if bool(run.statistics.healthy) and math.isfinite(worst) else math.inf
