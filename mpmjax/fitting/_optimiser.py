"""Optimisers: methods that search the least sum of squares. L-BFGS and Adam of optax search by the gradient alone."""

import abc
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax

from mpmjax._types import Array, Bool, Float, Int, Scalar
from mpmjax.checks import as_floats, require_fields, require_positive, require_whole
from mpmjax.fitting._problem import Coordinates, FitProblem, Sigmas


class Evaluation(NamedTuple):
    """Cost and derivatives at the place where an optimiser is."""

    cost: Float[Array, ""]
    """½ Σ r²; NaN where a simulation failed."""
    gradient: Coordinates
    """Derivative of the cost by the coordinates, shape (n,)."""
    residuals: Float[Array, "m"] | None = None
    """r [-], of an optimiser that uses them."""
    jacobian: Float[Array, "m n"] | None = None
    """Their derivative."""
    room: Float[Array, "2 n"] | None = None
    """How far values can change until their bounds, see `FitProblem.room`."""


class AbstractOptimiser(eqx.Module):
    """A method that searches the least Σ r², one iteration at a time.

    One of your own gives `begin`, `iterate` and `has_converged`. Its state is a pytree of arrays that says all it
    remembers, so that a search can be written to a file and continued. Its methods are given the problem that is
    minimised, the coordinates z where the search is, and the noise of each observation.
    """

    max_steps: eqx.AbstractVar[int]
    """Most iterations."""

    @abc.abstractmethod
    def begin(self, problem: FitProblem, z: Coordinates, sigmas: Sigmas) -> Any:
        """The state before the first iteration, which starts at z."""

    @abc.abstractmethod
    def iterate(
        self, problem: FitProblem, z: Coordinates, sigmas: Sigmas, state: Any
    ) -> tuple[Coordinates, Any, Evaluation]:
        """One iteration from the state that `begin` or the last iteration returned: where it is now, the state, and
        what it knows of that place. The first one evaluates where it starts. A step at which a simulation fails must
        not be taken."""

    def directed(self, z: Coordinates, state: Any, seen: Evaluation) -> Any:
        """The state for the next iteration, outside of what is compiled. Default: as it is."""
        del z, seen
        return state

    @abc.abstractmethod
    def has_converged(self, state: Any, seen: Evaluation) -> bool:
        """Whether the search is at a minimum."""

    def distance(self, state: Any, seen: Evaluation) -> float:
        """How far the search is from converged, as a multiple of where it ends; NaN if that is not known, which is the
        default. The time left is estimated from how fast it falls."""
        del state, seen
        return float("nan")

    def has_stalled(self, state: Any) -> bool:
        """Whether the search goes no further, and is not known to be at a minimum."""
        del state
        return False


class LBFGS(AbstractOptimiser):
    """The limited-memory BFGS method of optax with its zoom line search, on gradients by reverse mode.

    An iteration is a line search: mostly one simulation with its gradient, whose cost does not grow with the number of
    parameters. The first step is of length one at most. A step at which a simulation or its derivative fails counts as
    infinitely bad, and the search goes on between it and where it was. A line search that finds nothing lower is begun
    again along the negative gradient; where that finds nothing either, the search ends, and has not converged.

    It ends where two line searches in a row bring the cost, ½ Σ r², less than `rtol`² σ² lower, by what they foresaw
    and by what they did, σ² = Σ r²/(m − n) being the mean square of the misfit: some `rtol` standard errors from the
    minimum. Or where what they bring is lost in the rounding of the run's precision.

    Args:
        rtol: distance from the minimum at which it ends, in standard errors.
        max_steps: most iterations.
        memory: number of past steps that the approximation of the Hessian is made of.
        line_search: most simulations of a line search.
    """

    rtol: Scalar = eqx.field(converter=as_floats, default=1e-3)
    max_steps: int = eqx.field(static=True, default=200)
    memory: int = eqx.field(static=True, default=20)
    line_search: int = eqx.field(static=True, default=20)

    def __check_init__(self):
        require_fields(self)
        require_positive("LBFGS's rtol", self.rtol)
        for name in ("max_steps", "memory", "line_search"):
            require_whole(f"LBFGS's {name}", getattr(self, name), 1)

    def begin(self, problem: FitProblem, z: Coordinates, sigmas: Sigmas) -> "LBFGSState":
        del problem, sigmas
        no, zero = jnp.asarray(False), jnp.zeros((), z.dtype)
        past, unknown, small = self._past.init(z), zero + jnp.inf, jnp.zeros((), jnp.int32)
        return LBFGSState(no, zero, jnp.zeros_like(z), past, unknown, zero, small, no)

    def iterate(
        self, problem: FitProblem, z: Coordinates, sigmas: Sigmas, state: "LBFGSState"
    ) -> tuple[Coordinates, "LBFGSState", Evaluation]:
        def start(z: Coordinates, state: LBFGSState) -> tuple[Coordinates, LBFGSState]:
            _, cost, gradient = problem.gradient(z, sigmas)
            return z, state._replace(begun=~state.begun, cost=cost, gradient=gradient)

        search = partial(self._search, problem, sigmas)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers
            z, state = jax.lax.cond(state.begun, search, start, z, state)
        return z, state, Evaluation(state.cost, state.gradient)

    def has_converged(self, state: "LBFGSState", seen: Evaluation) -> bool:
        del seen
        return bool((state.small > 1) | (state.stalled & (state.predicted_decrease <= state.decrease_tolerance)))

    def has_stalled(self, state: "LBFGSState") -> bool:
        return bool(state.stalled)

    def _search(
        self, problem: FitProblem, sigmas: Sigmas, z: Coordinates, state: "LBFGSState"
    ) -> tuple[Coordinates, "LBFGSState"]:
        """A line search along the quasi-Newton direction, or where nothing is known yet along the negative gradient."""
        cost, gradient, fresh = state.cost, state.gradient, self._past.init(z)
        newton, steepest = (self._past.update(gradient, past, z) for past in (state.past, fresh))
        steep = (state.past.count == 0) | (gradient @ newton[0] <= 0)
        along, past = _where(steep, steepest, newton)
        predicted_decrease = jnp.where(steep, jnp.minimum(state.predicted_decrease, gradient @ along), gradient @ along)
        slack = problem.rounding(cost, sigmas)

        def evaluate(z: Coordinates) -> tuple[Array, Coordinates]:
            """The cost and its derivative; infinite where either fails."""
            _, cost, gradient = problem.gradient(z, sigmas)
            usable = jnp.isfinite(cost) & jnp.isfinite(gradient).all()
            return jnp.where(usable, cost, jnp.inf), jnp.where(usable, gradient, 0)

        line: Any = optax.scale_by_zoom_linesearch(self.line_search, approx_dec_rtol=slack / jnp.maximum(cost, slack))
        value_fn = evaluated_once(evaluate)
        step, at_end = line.update(-along, line.init(z), z, value=cost, grad=gradient, value_fn=value_fn)
        moved = (at_end.learning_rate > 0) & (at_end.value <= cost + slack)
        decrease_tolerance = jnp.maximum(jnp.asarray(self.rtol, z.dtype) ** 2 * problem.mean_square(cost), slack)
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

    @property
    def _past(self) -> Any:
        return optax.scale_by_lbfgs(self.memory)


class LBFGSState(NamedTuple):
    """State of L-BFGS."""

    begun: Bool[Array, ""]  # whether the cost is known where it is
    cost: Float[Array, ""]
    gradient: Coordinates
    past: optax.ScaleByLBFGSState  # past steps and the changes of the gradient in them
    predicted_decrease: Float[Array, ""]
    """Decrease of the cost that the gradient predicted for the last line search that lowered nothing."""
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

    An iteration is one simulation with its gradient. Each coordinate changes by about the learning rate: 0.05 is five
    per cent of a `Positive` parameter. The search keeps the best place that it has seen. Where a simulation or its
    derivative fails, or `patience` iterations in a row find nothing lower, it goes back there and begins anew, its
    steps half as long.

    It ends where its steps are shorter than `atol` coordinates.

    Args:
        learning_rate: length of a step in each coordinate [-], or a schedule of it, a function of the number of the
            iteration such as those of optax.
        atol: length of the steps at which it ends [-].
        max_steps: most iterations.
        patience: iterations in a row without a lower cost, after which steps are halved.
    """

    learning_rate: Scalar | Callable[[Any], Any] = eqx.field(converter=as_floats, default=0.05)
    atol: Scalar = eqx.field(converter=as_floats, default=1e-4)
    max_steps: int = eqx.field(static=True, default=500)
    patience: int = eqx.field(static=True, default=10)

    def __check_init__(self):
        require_fields(self)
        require_positive("Adam's atol", self.atol)
        for name in ("max_steps", "patience"):
            require_whole(f"Adam's {name}", getattr(self, name), 1)
        require_positive("Adam's learning_rate", self.rate(0))

    def rate(self, number: Any) -> Any:
        """The learning rate of an iteration, before any halving."""
        return self.learning_rate(number) if callable(self.learning_rate) else self.learning_rate

    def begin(self, problem: FitProblem, z: Coordinates, sigmas: Sigmas) -> "AdamState":
        del problem, sigmas
        one, zero = jnp.ones((), z.dtype), jnp.zeros((), jnp.int32)
        none = jnp.zeros_like(z)
        return AdamState(zero, z, _MOMENTS.init(z), one * jnp.inf, none, one, jnp.asarray(self.rate(0), z.dtype), zero)

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

        fresh = _MOMENTS.init(z)
        start, from_here, moments = _where(back, (z, slope, fresh), (state.trial, gradient, state.moments))
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
        del seen
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
