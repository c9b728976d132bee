"""Fitting a material parameter to a measured curve, by exact differentiation through the rollout."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from mpmjax._types import Array, Float, ParticleScalar, Scalar
from mpmjax.checks import canonical, checked, require, require_finite, shape_of
from mpmjax.geometry import AbstractRegion
from mpmjax.simulation import simulate
from mpmjax.state import Particles, Scene, prepare
from mpmjax.stepping import AbstractIntegrator


class StressStretch(eqx.Module):
    """The curve of a tension test: mean stretch F_aa and mean nominal stress P_aa [Pa] of a gauge section.

    Args:
        weight: share of each particle in the means, summing to one, shape (p,).
        axis: direction a of the pull.
    """

    weight: ParticleScalar
    axis: int = eqx.field(static=True)

    def __call__(self, scene: Scene, particles: Particles) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Stretch [-] and nominal stress [Pa]."""
        (body,) = scene.material_points(particles)
        F, a = body.deformation, self.axis
        require(
            F.ndim == 3, f"The curve of a tension test needs a law of F, got {type(body.law).__name__}, of J alone."
        )
        P = body.law.stress(F)
        return (self.weight * F[a, a]).sum(), (self.weight * P[a, a]).sum()


def gauge(region: AbstractRegion, particles: Particles, axis: int) -> StressStretch:
    """The curve over the particles that start in a region, each weighted by its volume.

    Raises:
        ValueError: no particle starts in the region.
    """
    inside = np.asarray(region.contains(particles.x))
    require(inside.any(), f"The gauge {region} holds no particle at the start: enlarge or move it.")
    require(0 <= axis < particles.dim, f"The gauge's axis must be below {particles.dim}, got {axis}.")
    weight = jnp.where(jnp.asarray(inside), particles.volume, 0)
    return StressStretch(weight / weight.sum(), axis)


class FitResult(eqx.Module):
    """A fitted parameter."""

    parameter: Float[Array, ""]
    """The fitted parameter, in the unit of the scene."""
    value: Float[Array, ""]
    """The property reported, e.g. μ = E / (2 (1 + ν)) [Pa]."""
    standard_error: Float[Array, ""]
    """Standard error of `value`: √(s² / (JᵀJ)) with s² = Σ r² / (n − 1) and J the derivative of the n fitted points by
    `value`."""
    curve: tuple[Float[Array, "f"], Float[Array, "f"]]
    """The simulated curve at the fit."""
    predicted: Float[Array, "m"]
    """The simulated ordinate at every measured abscissa; NaN where the run did not reach it."""
    simulations: int = eqx.field(static=True)
    """How many values of the parameter were tried, each with its exact derivative."""


@checked
def fit_curve(
    scene: Scene,
    particles: Particles,
    *,
    t1: Scalar,
    dt: Scalar,
    method: AbstractIntegrator,
    curve: Callable[[Scene, Particles], tuple[Array, Array]],
    measured_x: np.ndarray,
    measured_y: np.ndarray,
    fitted: np.ndarray,
    parameter: Callable[[Scene], Any],
    report: Callable[[Scene], Any] | None = None,
) -> FitResult:
    """Least squares over a positive parameter, in units of its first guess, by SciPy's trust-region method.

    The Jacobian is that of the whole rollout, in forward mode through every implicit solve.

    Args:
        scene: the scene, its own value of the parameter being the first guess.
        particles: its particles.
        t1: end time [s].
        dt: step [s].
        method: update of the grid velocity.
        curve: (scene, particles) to one point of the simulated curve; x must grow with time over the measured range.
        measured_x: measured abscissae, (m,).
        measured_y: measured ordinates, (m,).
        fitted: which of them the fit uses, bool (m,); the others are predicted.
        parameter: selects the parameter's leaf, as in `eqx.tree_at`.
        report: computes the property to report from the scene. Default: the parameter itself.

    Raises:
        ValueError: fewer than two points, data that are not finite, or an abscissa that the simulation does not reach.
        SimulationError: the rollout at the fit met a fault.
        RuntimeError: the least-squares iteration did not converge, or a tangent solve of the rollout did not.
    """
    fitted = np.asarray(fitted, bool)
    require(fitted.sum() >= 2, f"A fit with a standard error needs two points at least, got {int(fitted.sum())}.")
    require_finite("Measured abscissae", measured_x)
    require_finite("Measured ordinates", measured_y)
    report = parameter if report is None else report
    dtype = particles.x.dtype
    scene = canonical(scene, dtype)
    particles = prepare(scene, particles)
    guess = parameter(scene)
    require(
        shape_of(guess) == () and np.all(guess > 0), f"The fitted parameter must be one positive number, got {guess}."
    )
    x, y = jnp.asarray(measured_x[fitted], dtype), jnp.asarray(measured_y[fitted], dtype)
    scale = jnp.abs(y).max()

    def at(ratio: Scalar) -> Scene:
        return eqx.tree_at(parameter, scene, ratio * guess)

    def simulated(candidate: Scene) -> tuple[Array, Array]:
        return simulate(candidate, particles, t1=t1, dt=dt, method=method, observe=curve).observed

    first = simulated(scene)
    _require_reached(first, measured_x[fitted])
    until = _time_to_reach(np.asarray(first[0]), float(x.max()), float(dt))

    def model(ratio: Scalar) -> tuple[Array, Array]:
        run = simulate(
            at(ratio),
            particles,
            t1=until,
            dt=dt,
            method=method,
            observe=curve,
            adjoint=diffrax.ForwardMode(),
            throw=False,
        )
        misfit = (jnp.interp(x, *run.observed) - y) / scale
        assert run.report is not None
        return jnp.where(run.statistics.healthy, misfit, jnp.nan), run.report

    @jax.jit
    def misfit(ratio: Scalar) -> _Misfit:
        (r, _), (J, unsolved) = jax.jvp(model, (ratio,), (jnp.ones_like(ratio),))
        return _Misfit(r, J, unsolved)

    ratio, variance, simulations = _least_squares(misfit, dtype)
    best = at(ratio)
    curve_x, curve_y = simulated(best)
    _require_reached((curve_x[: round(until / float(dt)) + 1], curve_y), measured_x[fitted])
    value, slope = jax.jvp(lambda r: report(at(r)), (ratio,), (jnp.ones_like(ratio),))
    inside = (measured_x >= float(curve_x[0])) & (measured_x <= float(curve_x.max()))
    predicted = jnp.interp(jnp.asarray(measured_x, dtype), curve_x, curve_y)
    return FitResult(
        parameter=parameter(best),
        value=value,
        standard_error=jnp.abs(slope) * np.sqrt(variance),
        curve=(curve_x, curve_y),
        predicted=jnp.where(jnp.asarray(inside), predicted, jnp.nan),
        simulations=simulations,
    )


class _Misfit(NamedTuple):
    """r, NaN where the run met a fault; its derivative J by the parameter; and the relative residual of the first
    tangent solve that did not converge, zero if all did."""

    r: Float[Array, "n"]
    J: Float[Array, "n"]
    unsolved: Float[Array, ""]


def _least_squares(misfit: Callable[[Array], _Misfit], dtype: Any) -> tuple[Array, float, int]:
    """The positive number that minimises Σ r², from 1, its variance s² / (JᵀJ), and the number of evaluations.

    Where a run meets a fault the search tries a smaller change of the parameter.

    Args:
        misfit: One compiled function gives r and J, and what SciPy asks for twice is computed once.
        dtype: of the number.
    """
    known: dict[float, _Misfit] = {}

    def evaluate(ratio: np.ndarray) -> _Misfit:
        key = float(ratio[0])
        if key not in known:
            known[key] = misfit(jnp.asarray(key, dtype))
        return known[key]

    def slope(ratio: np.ndarray) -> np.ndarray:
        _, J, unsolved = evaluate(ratio)
        if float(unsolved) > 0:
            raise RuntimeError(
                f"The fit has no derivative at {float(ratio[0]):.4g} times the first guess: the tangent solve of a "
                f"step did not converge (relative residual {float(unsolved):.2g}). Raise the "
                "max_steps of the method's adjoint_solver, or leave its preconditioner at DiagonalPreconditioner()."
            )
        if not np.isfinite(J).all():
            raise RuntimeError(
                f"The fit has no derivative at {float(ratio[0]):.4g} times the first guess: that of the simulated "
                "curve is not finite. Look for a law or a curve that cannot be differentiated where the run takes it."
            )
        return np.asarray(J)[:, None]

    jacobian: Any = slope  # SciPy's annotation knows only strings
    solution = scipy.optimize.least_squares(
        lambda ratio: np.asarray(evaluate(ratio).r), np.ones(1), jac=jacobian, bounds=(0, np.inf), xtol=1e-6
    )
    if not solution.success:
        raise RuntimeError(
            f"The fit did not converge in {len(known)} simulations: start from a closer value, or check "
            "the data's units."
        )
    J2 = float((solution.jac**2).sum())
    variance = 2 * solution.cost / (len(solution.fun) - 1) / J2
    return jnp.asarray(solution.x[0], dtype), variance, len(known)


def _time_to_reach(x: np.ndarray, wanted: float, dt: float) -> float:
    """When the curve passes an abscissa, and a tenth more, since that shifts a little with the parameter [s]."""
    steps = int(np.argmax(x >= wanted))
    return min(int(np.ceil(1.1 * steps)) + 1, len(x) - 1) * dt


def _require_reached(curve: tuple[Array, Array], wanted: np.ndarray) -> None:
    x = np.asarray(curve[0])
    require(
        np.isfinite(x).all() and (np.diff(x) > 0).all(),
        "The simulated abscissa must grow with every step of the run: slow the loading down, or reduce dt.",
    )
    require(
        (x[0] <= wanted) & (wanted <= x[-1]),
        f"The simulation covers {x[0]:.4g} to {x[-1]:.4g}, which leaves out measured points to be fitted "
        f"({', '.join(f'{w:.4g}' for w in wanted if not x[0] <= w <= x[-1])}): pull further, or narrow the range.",
    )
