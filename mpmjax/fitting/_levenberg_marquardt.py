"""Levenberg-Marquardt by optimistix, one iteration at a time."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix

from mpmjax._types import Array, Scalar
from mpmjax.checks import require_fields, require_tolerance, require_whole
from mpmjax.fitting._optimiser import AbstractOptimiser, Evaluation, evaluated_once
from mpmjax.fitting._problem import Coordinates, FitProblem, Sigmas


class LevenbergMarquardt(AbstractOptimiser):
    """The Levenberg-Marquardt method of optimistix on the residuals and their Jacobian.

    One compiled function makes an iteration: it evaluates residuals and Jacobian together, once. A step at which a
    simulation fails has residuals of NaN, is not taken, and the next is shorter.

    Near a bound the coordinate hides the value from it: the damping then holds a step that the data ask for. There the
    next one is the Gauss-Newton step of values that follow their coordinates in straight lines up to their bounds.

    It ends by optimistix's criterion, or where the next Gauss-Newton step, no longer than to a bound, would be less
    than a ten-thousandth of the standard error that the misfit gives, or where a step is refused and could lower the
    sum of squares by no more than its rounding: in single precision residuals are never still. Where it can only make
    steps far shorter than the Gauss-Newton step, since the simulation fails beyond or the misfit has a kink, it has not
    converged.

    Args:
        rtol: relative and absolute tolerance of coordinates and residuals.
        max_steps: most iterations.
        mode: how the Jacobian is made: "forward", by a tangent a coordinate beside the simulation; "reverse", by a pass
            back a measured number. Default: what costs less.
    """

    rtol: Scalar = 1e-6
    max_steps: int = eqx.field(static=True, default=50)
    mode: Literal["forward", "reverse"] | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        require_fields(self)
        require_tolerance("LevenbergMarquardt's rtol", self.rtol)
        require_whole("LevenbergMarquardt's max_steps", self.max_steps, 1)

    def begin(self, problem: FitProblem, z: Coordinates, sigmas: Sigmas) -> Any:
        args = problem, sigmas, self.mode
        shape, _ = jax.eval_shape(lambda z: _residuals(z, args), z)
        return self._solver.init(_residuals, z, args, {}, shape, None, frozenset())

    def iterate(
        self, problem: FitProblem, z: Coordinates, sigmas: Sigmas, state: Any
    ) -> tuple[Coordinates, Any, Evaluation]:
        z, state, _ = self._solver.step(_residuals, z, (problem, sigmas, self.mode), {}, state, frozenset())
        r, J = state.f_info.residual, state.f_info.jac.as_matrix()
        dtype = problem.dtype
        room = problem.room(z.astype(dtype))
        return z, state, Evaluation((r**2).sum() / 2, J.T @ r, r.astype(dtype), J.astype(dtype), room)

    def directed(self, z: Coordinates, state: Any, seen: Evaluation) -> Any:
        r, J, step, _ = _gauss_newton(seen)
        if not np.isfinite(step).all() or int(state.num_steps_since_acceptance) > 0:
            return state
        (down, up), square = np.asarray(seen.room, float), np.maximum((J**2).sum(axis=0), np.finfo(float).tiny)
        near = square * np.minimum(down, up) ** 2 <= _HIDDEN**2 * (r**2).sum() / max(len(r) - len(step), 1)
        side = np.where(down < up, 1, -1)
        straight = side * np.log1p(np.maximum(side * step, np.exp(-_LEAP) - 1))
        wanted = np.where(near, straight, step)
        if not (near & (np.abs(np.asarray(state.y_eval - z, float)) < np.abs(wanted) / 2)).any():
            return state
        # The factor is what a refusal takes off the length of steps: damped ones go on as if it had not been tried.
        return eqx.tree_at(
            lambda s: (s.y_eval, s.search_state.step_size),
            state,
            (z + jnp.asarray(wanted, z.dtype), state.search_state.step_size * 4),
        )

    def has_converged(self, state: Any, seen: Evaluation) -> bool:
        if (bool(state.terminate) and not self._is_held_back(state)) or self.distance(state, seen) <= 1:
            return True
        # Refused, and what it could have lowered Σ r² by is lost in the rounding.
        r, J, step, _ = _gauss_newton(seen)
        rounding = _ROUNDINGS * float(np.finfo(np.asarray(seen.residuals).dtype).eps) * (r**2).sum()
        gain = (r**2).sum() - ((r + J @ step) ** 2).sum()
        return bool(int(state.num_steps_since_acceptance) > 0 and gain <= rounding)

    def has_stalled(self, state: Any) -> bool:
        return bool(state.terminate) and self._is_held_back(state)

    def _is_held_back(self, state: Any) -> bool:
        """Whether the steps are short because longer ones were refused, and not because the minimum is near: the
        simulation fails beyond, or the misfit has a kink."""
        r, J = np.asarray(state.f_info.residual, float), np.asarray(state.f_info.jac.as_matrix(), float)
        if not (np.isfinite(r).all() and np.isfinite(J).all()):
            return False
        damping = np.eye(J.shape[1]) / float(state.search_state.step_size)
        wanted, taken = np.linalg.lstsq(J, -r)[0], np.linalg.solve(J.T @ J + damping, -J.T @ r)
        far = np.abs(wanted).max() > _FAR * float(self.rtol)
        return bool(far and np.abs(taken).max() < _REFUSED * np.abs(wanted).max())

    def distance(self, state: Any, seen: Evaluation) -> float:
        del state
        r, J, step, limited = _gauss_newton(seen)
        rows, columns = J.shape
        if rows <= columns or not np.isfinite(step).all():
            return float("nan")
        error = np.sqrt((r**2).sum() / (rows - columns))
        # Data without noise leave no error to compare with: towards a bound the tolerance of residuals ends it.
        least = float(self.rtol) if limited.any() and np.abs(step[~limited]).max(initial=0) <= self.rtol else 0.0
        length = float(np.linalg.norm(J @ step))
        return length / max(_NEGLIGIBLE * float(error), least) if length > 0 else 0.0

    @property
    def _solver(self) -> Any:
        tolerance: Any = self.rtol
        solver: Any = optimistix.LevenbergMarquardt(rtol=tolerance, atol=tolerance)
        return eqx.tree_at(lambda s: s.search, solver, _TrustRegion())


class _TrustRegion(optimistix.ClassicalTrustRegion):
    """A trust region that takes no step uphill, though its quadratic foretells one: near a bound that is of
    coordinates, and the step of values."""

    def predict_reduction(self, y_diff: Any, f_info: Any) -> Any:
        return jnp.minimum(super().predict_reduction(y_diff, f_info), 0)


def _gauss_newton(seen: Evaluation) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """r, J, the next Gauss-Newton step, were values straight lines in their coordinates up to their bounds, NaN if it
    is unknown, and which coordinates it brings to a bound."""
    r, J = np.asarray(seen.residuals, float), np.asarray(seen.jacobian, float)
    if not (np.isfinite(r).all() and np.isfinite(J).all()):
        return r, J, np.full(J.shape[1], np.nan), np.zeros(J.shape[1], bool)
    length = np.linalg.norm(J, axis=0)
    length = np.where(length > 0, length, 1)
    down, up = np.asarray(seen.room, float) * length
    step = np.linalg.lstsq(J / length, -r, rcond=1e-10)[0]
    if ((step <= -down) | (step >= up)).any():
        from scipy.optimize import lsq_linear  # here, since it takes long to import

        step = lsq_linear(J / length, -r, (-down, up), method="bvls").x
    return r, J, step / length, (step <= -down) | (step >= up)


def _residuals(z: Coordinates, args: tuple[FitProblem, Sigmas, Any]) -> tuple[Array, None]:
    """The residuals, as optimistix asks for them."""
    problem, sigmas, mode = args

    def evaluate(z: Coordinates) -> tuple[Array, Array]:
        r, J = problem.jacobian(z.astype(problem.dtype), sigmas, mode)
        return r.astype(z.dtype), J.astype(z.dtype)

    return evaluated_once(evaluate)(z), None


_FAR = 100.0  # a step is short below so many tolerances
_REFUSED = 0.1  # part of the Gauss-Newton step below which a step is held back
_LEAP = 9.0  # longest step to a bound [-]: to a ten-thousandth of the distance from it
_HIDDEN = 3.0  # standard errors from a bound within which a coordinate is near it
_NEGLIGIBLE = 1e-4  # a step of so many standard errors is none
_ROUNDINGS = 10  # rounding of Σ r², in ε: a smaller change of it cannot be told
