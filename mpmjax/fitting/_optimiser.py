"""Methods that search the least sum of squares: Levenberg-Marquardt of optimistix by residuals and their Jacobian,
L-BFGS and Adam of optax by the gradient alone."""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix

from mpmjax._types import Array, Bool, Float, Int, Scalar
from mpmjax.checks import as_floats, positive, require_fields, require_positive, tolerance, whole
from mpmjax.fitting._evaluation import Evaluated, parts_kept
from mpmjax.fitting._problem import Coordinates, FitProblem, Sigmas
from mpmjax.fitting._search import AbstractOptimiser, Evaluation


class LevenbergMarquardt(AbstractOptimiser):
    """The Levenberg-Marquardt method of optimistix on the residuals and their Jacobian.

    A step at which a simulation fails has residuals of NaN, is not taken, and the next is shorter.

    Near a bound the coordinate hides the value from it: the damping then holds a step that the data ask for. There the
    next one is the Gauss-Newton step of values that follow their coordinates in straight lines up to their bounds.

    It ends by optimistix's criterion, or where the next Gauss-Newton step, no longer than to a bound, would be less
    than a ten-thousandth of the standard error that the misfit gives, or where a step is refused and could lower the
    sum of squares by no more than its rounding, as in single precision. Where only steps far shorter than the
    Gauss-Newton step are taken, since the simulation fails beyond or the misfit has a kink, it has not converged.

    Args:
        rtol: relative and absolute tolerance of coordinates and residuals.
        max_steps: most iterations.
        mode: of the Jacobian: "forward", by a tangent a coordinate beside the simulation; "reverse", by a pass back a
            measured number. Default: the cheaper one.
    """

    rtol: Annotated[Scalar, tolerance] = 1e-6
    max_steps: Annotated[int, whole(1)] = eqx.field(static=True, default=300)
    mode: Literal["forward", "reverse"] | None = eqx.field(static=True, default=None)

    def begin(self, problem: FitProblem, z: Coordinates, sigmas: Sigmas) -> Any:
        if parts_kept(problem, 1 + problem.size) is not None:
            rows = problem.measured + len(jax.eval_shape(problem.prior_residuals, z.astype(problem.dtype)))
        else:
            rows = len(jax.eval_shape(lambda z: problem.jacobian(z.astype(problem.dtype), sigmas, self.mode), z)[0])
        r, J, room = (jnp.zeros(shape, z.dtype) for shape in ((rows,), (rows, len(z)), (2, len(z))))
        at, shape = Evaluated(z, r, J, (room, room)), jax.eval_shape(lambda: r)
        return self._solver.init(_residuals, z, (at, (), None), {}, shape, None, frozenset())

    def place(self, problem: FitProblem, state: Any) -> Coordinates | None:
        return state.y_eval if (self.mode or problem.cheaper_mode) == "forward" else None

    def iterate(
        self, problem: FitProblem | Evaluated, z: Coordinates, sigmas: Sigmas, state: Any
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
        if not (near & (np.abs(np.asarray(state.y_eval) - np.asarray(z)) < np.abs(wanted) / 2)).any():
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
    """A trust region that takes no step uphill, though near a bound its quadratic, of coordinates, may foretell one."""

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


def _residuals(z: Coordinates, args: tuple[FitProblem | Evaluated, Sigmas, Any]) -> tuple[Array, None]:
    """The residuals, as optimistix asks for them."""
    problem, sigmas, mode = args

    def evaluate(z: Coordinates) -> tuple[Array, Array]:
        r, J = problem.jacobian(z.astype(problem.dtype), sigmas, mode)
        return r.astype(z.dtype), J.astype(z.dtype)

    return evaluated_once(evaluate)(z), None


class LBFGS(AbstractOptimiser):
    """The limited-memory BFGS method of optax with its zoom line search, on gradients by reverse mode.

    An iteration is a line search: mostly one simulation with its gradient, whose cost does not grow with the number of
    parameters. The first step is of length one at most. A step at which a simulation or its derivative fails counts as
    infinitely bad. A line search that finds nothing lower is begun again along the negative gradient; where that finds
    nothing either, the search ends, and has not converged.

    It ends where two line searches in a row bring the cost, ½ Σ r², less than `rtol`² σ² lower, foreseen and done,
    σ² = Σ r²/(m − n): some `rtol` standard errors from the minimum. Or where rounding hides what they bring.

    Args:
        rtol: distance from the minimum at which it ends, in standard errors.
        max_steps: most iterations.
        memory: number of past steps that the approximation of the Hessian is made of.
        line_search: most simulations of a line search.
    """

    rtol: Annotated[Scalar, positive] = eqx.field(converter=as_floats, default=1e-3)
    max_steps: Annotated[int, whole(1)] = eqx.field(static=True, default=200)
    memory: Annotated[int, whole(1)] = eqx.field(static=True, default=20)
    line_search: Annotated[int, whole(1)] = eqx.field(static=True, default=20)

    def begin(self, problem: FitProblem, z: Coordinates, sigmas: Sigmas) -> "LBFGSState":
        no, zero, none = jnp.asarray(False), jnp.zeros((), z.dtype), jnp.zeros((), jnp.int32)
        past: Any = optax.scale_by_lbfgs(self.memory).init(z)
        return LBFGSState(no, zero, jnp.zeros_like(z), past, zero + jnp.inf, zero, none, no)

    def iterate(
        self, problem: FitProblem, z: Coordinates, sigmas: Sigmas, state: "LBFGSState"
    ) -> tuple[Coordinates, "LBFGSState", Evaluation]:
        def start(z: Coordinates, state: LBFGSState) -> tuple[Coordinates, LBFGSState]:
            _, cost, gradient = problem.gradient(z, sigmas)
            return z, state._replace(begun=~state.begun, cost=cost, gradient=gradient)

        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers
            z, state = jax.lax.cond(state.begun, partial(self._search, problem, sigmas), start, z, state)
        return z, state, Evaluation(state.cost, state.gradient)

    def has_converged(self, state: "LBFGSState", seen: Evaluation) -> bool:
        return bool((state.small > 1) | (state.stalled & (state.predicted_decrease <= state.decrease_tolerance)))

    def has_stalled(self, state: "LBFGSState") -> bool:
        return bool(state.stalled)

    def _search(
        self, problem: FitProblem, sigmas: Sigmas, z: Coordinates, state: "LBFGSState"
    ) -> tuple[Coordinates, "LBFGSState"]:
        """A line search along the quasi-Newton direction, or where nothing is known yet along the negative gradient."""
        cost, gradient = state.cost, state.gradient
        quasi_newton: Any = optax.scale_by_lbfgs(self.memory)
        fresh = quasi_newton.init(z)
        newton, steepest = (quasi_newton.update(gradient, past, z) for past in (state.past, fresh))
        steep = (state.past.count == 0) | (gradient @ newton[0] <= 0)
        along, past = _where(steep, steepest, newton)
        predicted_decrease = jnp.where(steep, jnp.minimum(state.predicted_decrease, gradient @ along), gradient @ along)
        # The part of the cost that may be rounding: each residual has that of the data, ε √Σ (data/σ)².
        rounding = problem.rounding_of_data(sigmas).astype(cost.dtype)
        slack = jnp.sqrt(2 * cost) * rounding + rounding**2 + float(jnp.finfo(cost.dtype).eps) * cost

        def evaluate(z: Coordinates) -> tuple[Array, Coordinates]:
            """The cost and its derivative; infinite where either fails."""
            _, cost, gradient = problem.gradient(z, sigmas)
            usable = jnp.isfinite(cost) & jnp.isfinite(gradient).all()
            return jnp.where(usable, cost, jnp.inf), jnp.where(usable, gradient, 0)

        line: Any = optax.scale_by_zoom_linesearch(self.line_search, approx_dec_rtol=slack / jnp.maximum(cost, slack))
        value_fn = evaluated_once(evaluate)
        step, at_end = line.update(-along, line.init(z), z, value=cost, grad=gradient, value_fn=value_fn)
        moved = (at_end.learning_rate > 0) & (at_end.value <= cost + slack)
        points = sum((jnp.isfinite(o.data).sum() for o in problem.observations), jnp.zeros((), int))
        freedom = jnp.maximum(points + problem.fixed_by_priors - problem.size, 1).astype(cost.dtype)
        decrease_tolerance = jnp.maximum(jnp.asarray(self.rtol, z.dtype) ** 2 * (2 * cost / freedom), slack)
        small = moved & (predicted_decrease <= decrease_tolerance) & (cost - at_end.value <= decrease_tolerance)
        after = LBFGSState(
            begun=state.begun,
            cost=at_end.value,
            gradient=at_end.grad,
            past=past,
            predicted_decrease=jnp.where(moved & ~small, jnp.inf, predicted_decrease),
            decrease_tolerance=decrease_tolerance,
            small=jnp.where(small, state.small + 1, 0),
            stalled=~moved & steep,
        )
        stayed = after._replace(cost=cost, gradient=gradient, past=fresh)
        return _where(moved, (z + step, after), (z, stayed))


class LBFGSState(NamedTuple):
    """State of L-BFGS."""

    begun: Bool[Array, ""]  # whether the cost is known where it is
    cost: Float[Array, ""]
    gradient: Coordinates
    past: optax.ScaleByLBFGSState  # past steps and the changes of the gradient in them
    predicted_decrease: Float[Array, ""]  # of the cost, by the gradient, for the last line search that lowered nothing
    decrease_tolerance: Float[Array, ""]  # decrease of the cost below which a line search is negligible
    small: Int[Array, ""]  # how many line searches in a row brought next to nothing
    stalled: Bool[Array, ""]  # whether nothing lower was found along the negative gradient


def evaluated_once(evaluate: Callable[[Coordinates], tuple[Array, Array]]) -> Callable[[Coordinates], Array]:
    """A function whose value and derivative are evaluated together, once."""

    @jax.custom_jvp
    def value(z: Coordinates) -> Array:
        return evaluate(z)[0]

    @value.defjvp
    def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
        at, derivative = evaluate(primals[0])
        return at, derivative @ tangents[0]

    return value


class Adam(AbstractOptimiser):
    """The Adam method of optax on gradients by reverse mode: for costs that are rough, where a line search is caught.

    An iteration is one simulation with its gradient. The search keeps the best place that it has seen. Where a
    simulation or its derivative fails, or `patience` iterations in a row find nothing lower, it goes back there and
    begins anew, its steps half as long. It ends where these are shorter than `atol` coordinates.

    Args:
        learning_rate: length of a step in each coordinate [-], 0.05 for five per cent of a `Positive` parameter, or a
            schedule of it, a function of the number of the iteration such as those of optax.
        atol: length of the steps at which it ends [-].
        max_steps: most iterations.
        patience: iterations in a row without a lower cost, after which steps are halved.
    """

    learning_rate: Scalar | Callable[[Any], Any] = eqx.field(converter=as_floats, default=0.05)
    atol: Annotated[Scalar, positive] = eqx.field(converter=as_floats, default=1e-4)
    max_steps: Annotated[int, whole(1)] = eqx.field(static=True, default=500)
    patience: Annotated[int, whole(1)] = eqx.field(static=True, default=10)

    def __check_init__(self):
        require_fields(self)
        require_positive("Adam's learning_rate", self.rate(0))

    def rate(self, number: Any) -> Any:
        """The learning rate of an iteration, before any halving."""
        return self.learning_rate(number) if callable(self.learning_rate) else self.learning_rate

    def begin(self, problem: FitProblem, z: Coordinates, sigmas: Sigmas) -> "AdamState":
        one, zero, rate = jnp.ones((), z.dtype), jnp.zeros((), jnp.int32), jnp.asarray(self.rate(0), z.dtype)
        return AdamState(zero, z, _MOMENTS.init(z), one * jnp.inf, jnp.zeros_like(z), one, rate, zero)

    def iterate(
        self, problem: FitProblem, z: Coordinates, sigmas: Sigmas, state: "AdamState"
    ) -> tuple[Coordinates, "AdamState", Evaluation]:
        _, cost, gradient = problem.gradient(state.trial, sigmas)
        first = state.number == 0
        usable = jnp.isfinite(cost) & jnp.isfinite(gradient).all()
        lower = usable & (cost < state.cost)
        fruitless = jnp.where(lower, 0, state.fruitless + 1)
        back = ~usable | (fruitless >= self.patience)
        z, best, slope = _where(lower | first, (state.trial, cost, gradient), (z, state.cost, state.gradient))

        anew = z, slope, _MOMENTS.init(z)
        start, from_here, moments = _where(back, anew, (state.trial, gradient, state.moments))
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers and floats
            direction, moments = _MOMENTS.update(from_here, moments)
        factor = jnp.where(back, state.factor / 2, state.factor)
        step = factor * jnp.asarray(self.rate(state.number), z.dtype)
        after = AdamState(
            number=state.number + 1,
            trial=start - step * direction,
            moments=moments,
            cost=best,
            gradient=slope,
            factor=factor,
            step=step,
            fruitless=jnp.where(back, 0, fruitless),
        )
        return z, after, Evaluation(best, slope)

    def has_converged(self, state: "AdamState", seen: Evaluation) -> bool:
        return bool(state.step < self.atol)


class AdamState(NamedTuple):
    """State of Adam."""

    number: Int[Array, ""]  # how many simulations there were
    trial: Coordinates  # where the next one is
    moments: optax.ScaleByAdamState  # means of gradients and of their squares
    cost: Float[Array, ""]  # the lowest cost, that where it is
    gradient: Coordinates
    factor: Float[Array, ""]  # by what the learning rate is multiplied
    step: Float[Array, ""]  # length of the next step [-]
    fruitless: Int[Array, ""]  # how many simulations in a row found nothing lower


_MOMENTS: Any = optax.scale_by_adam()


def _where(condition: Bool[Array, ""], yes: Any, no: Any) -> Any:
    """One of two pytrees."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


_FAR = 100.0  # a step is short below so many tolerances
_REFUSED = 0.1  # part of the Gauss-Newton step below which a step is held back
_LEAP = 9.0  # longest step to a bound [-]: to a ten-thousandth of the distance from it
_HIDDEN = 3.0  # standard errors from a bound within which a coordinate is near it
_NEGLIGIBLE = 1e-4  # a step of so many standard errors is none
_ROUNDINGS = 10  # rounding of Σ r², in ε: a smaller change of it cannot be told
