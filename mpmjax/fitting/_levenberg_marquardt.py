"""Levenberg-Marquardt by optimistix, one iteration at a time."""

from typing import Any, Literal

import equinox as eqx
import jax
import numpy as np
import optimistix

from mpmjax._types import Array, Scalar
from mpmjax.checks import require_fields, require_tolerance, require_whole
from mpmjax.fitting._optimiser import AbstractOptimiser, Evaluation
from mpmjax.fitting._problem import Coordinates, FitProblem


class LevenbergMarquardt(AbstractOptimiser):
    """The Levenberg-Marquardt method of optimistix on the residuals and their Jacobian.

    One compiled function makes an iteration: it evaluates residuals and Jacobian together, once. A step at which a
    simulation fails has residuals of NaN, is not taken, and the next is shorter.

    It ends by optimistix's criterion, or where the next Gauss-Newton step would be less than a ten-thousandth of the
    standard error that the misfit gives, or where a step is refused and could lower the sum of squares by no more than
    its rounding: in single precision residuals are never still. Where it can only make steps far shorter than the
    Gauss-Newton step, since the simulation fails beyond or the misfit has a kink, it has not converged.

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

    def begin(self, problem: FitProblem, z: Coordinates, sigmas: tuple[Array, ...]) -> Any:
        args = problem, sigmas, self.mode
        shape, _ = jax.eval_shape(lambda z: _residuals(z, args), z)
        return self._solver.init(_residuals, z, args, {}, shape, None, frozenset())

    def iterate(
        self, problem: FitProblem, z: Coordinates, sigmas: tuple[Array, ...], state: Any
    ) -> tuple[Coordinates, Any, Evaluation]:
        z, state, _ = self._solver.step(_residuals, z, (problem, sigmas, self.mode), {}, state, frozenset())
        r, J = state.f_info.residual, state.f_info.jac.as_matrix()
        own = problem.dtype
        return z, state, Evaluation((r**2).sum() / 2, J.T @ r, r.astype(own), J.astype(own))

    def has_converged(self, state: Any, seen: Evaluation) -> bool:
        ended = bool(state.terminate) and not self._is_held_back(state)
        return ended or self.distance(state, seen) <= 1 or _is_lost_in_rounding(state, seen)

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
        total, gain = _squares(seen)
        rows, columns = np.asarray(seen.jacobian).shape
        if rows <= columns or np.isnan(gain):
            return float("nan")
        return float(np.sqrt(gain / total * (rows - columns))) / _NEGLIGIBLE if total > 0 else 0.0

    @property
    def _solver(self) -> Any:
        tolerance: Any = self.rtol
        return optimistix.LevenbergMarquardt(rtol=tolerance, atol=tolerance)


def _is_lost_in_rounding(state: Any, seen: Evaluation) -> bool:
    """Whether a step was refused which could lower Σ r² by no more than its rounding."""
    total, gain = _squares(seen)
    rounding = _ROUNDINGS * float(np.finfo(np.asarray(seen.residuals).dtype).eps) * total
    return bool(int(state.num_steps_since_acceptance) > 0 and gain <= rounding)


def _squares(seen: Evaluation) -> tuple[float, float]:
    """Σ r², and what the next Gauss-Newton step p would take off it were r linear, ‖J p‖²; NaN if that is unknown."""
    r, J = np.asarray(seen.residuals, float), np.asarray(seen.jacobian, float)
    if not (np.isfinite(r).all() and np.isfinite(J).all()):
        return float("nan"), float("nan")
    U, singular, _ = np.linalg.svd(J, full_matrices=False)
    change = U[:, singular > 1e-10 * singular.max(initial=0)].T @ r
    return float((r**2).sum()), float((change**2).sum())


_FAR = 100.0
"""A step is short below so many tolerances."""
_REFUSED = 0.1
"""Part of the Gauss-Newton step below which a step is held back."""
_NEGLIGIBLE = 1e-4
"""A step of so many standard errors is none."""
_ROUNDINGS = 10
"""Of Σ r²: a smaller change of it cannot be told."""


def _residuals(z: Coordinates, args: tuple[FitProblem, tuple[Array, ...], Any]) -> tuple[Array, None]:
    """The residuals, evaluated together with their derivative, once."""
    problem, sigmas, mode = args

    def jacobian(z: Coordinates) -> tuple[Array, Array]:
        r, J = problem.jacobian(z.astype(problem.dtype), sigmas, mode)
        return r.astype(z.dtype), J.astype(z.dtype)

    @jax.custom_jvp
    def residuals(z: Coordinates) -> Array:
        return jacobian(z)[0]

    @residuals.defjvp
    def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
        r, J = jacobian(primals[0])
        return r, J @ tangents[0]

    return residuals(z), None
