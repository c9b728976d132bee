"""L-BFGS by optax, one line search at a time."""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax

from mpmjax._types import Array, Bool, Float, Int, Scalar
from mpmjax.checks import as_floats, require_fields, require_positive, require_whole
from mpmjax.fitting._optimiser import AbstractOptimiser, Evaluation, where
from mpmjax.fitting._problem import Coordinates, FitProblem


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

    def begin(self, problem: FitProblem, z: Coordinates, sigmas: tuple[Array, ...]) -> "LBFGSState":
        del problem, sigmas
        no, zero = jnp.asarray(False), jnp.zeros((), z.dtype)
        return LBFGSState(
            begun=no,
            cost=zero,
            gradient=jnp.zeros_like(z),
            past=self._past.init(z),
            foreseen=zero + jnp.inf,
            negligible=zero,
            small=jnp.zeros((), jnp.int32),
            stalled=no,
        )

    def iterate(
        self, problem: FitProblem, z: Coordinates, sigmas: tuple[Array, ...], state: "LBFGSState"
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
        return bool((state.small > 1) | (state.stalled & (state.foreseen <= state.negligible)))

    def has_stalled(self, state: "LBFGSState") -> bool:
        return bool(state.stalled)

    def _search(
        self, problem: FitProblem, sigmas: tuple[Array, ...], z: Coordinates, state: "LBFGSState"
    ) -> tuple[Coordinates, "LBFGSState"]:
        """A line search along the quasi-Newton direction, or where nothing is known yet along the negative gradient."""
        cost, gradient, fresh = state.cost, state.gradient, self._past.init(z)
        newton, steepest = (self._past.update(gradient, past, z) for past in (state.past, fresh))
        steep = (state.past.count == 0) | (gradient @ newton[0] <= 0)
        along, past = where(steep, steepest, newton)
        foreseen = jnp.where(steep, jnp.minimum(state.foreseen, gradient @ along), gradient @ along)
        slack = problem.rounding(cost, sigmas)
        line: Any = optax.scale_by_zoom_linesearch(self.line_search, approx_dec_rtol=slack / jnp.maximum(cost, slack))
        step, found = line.update(
            -along, line.init(z), z, value=cost, grad=gradient, value_fn=partial(_cost, problem, sigmas)
        )
        moved = (found.learning_rate > 0) & (found.value <= cost + slack)
        negligible = jnp.maximum(jnp.asarray(self.rtol, z.dtype) ** 2 * problem.mean_square(cost), slack)
        small = moved & (foreseen <= negligible) & (cost - found.value <= negligible)
        after = LBFGSState(
            begun=state.begun,
            cost=found.value,
            gradient=found.grad,
            past=past,
            foreseen=jnp.where(moved & ~small, jnp.inf, foreseen),
            negligible=negligible,
            small=jnp.where(small, state.small + 1, 0),
            stalled=~moved & steep,
        )
        stayed = after._replace(cost=cost, gradient=gradient, past=fresh)
        return where(moved, (z + step, after), (z, stayed))

    @property
    def _past(self) -> Any:
        return optax.scale_by_lbfgs(self.memory)


class LBFGSState(NamedTuple):
    """What L-BFGS remembers."""

    begun: Bool[Array, ""]
    """Whether the cost is known where it is."""
    cost: Float[Array, ""]
    gradient: Coordinates
    past: optax.ScaleByLBFGSState
    """Past steps and the changes of the gradient in them."""
    foreseen: Float[Array, ""]
    """What the last line search that brought nothing was to bring, by the gradient along its direction."""
    negligible: Float[Array, ""]
    """What counts as nothing."""
    small: Int[Array, ""]
    """How many line searches in a row brought next to nothing."""
    stalled: Bool[Array, ""]
    """Whether nothing lower was found along the negative gradient."""


def _cost(problem: FitProblem, sigmas: tuple[Array, ...], z: Coordinates) -> Array:
    """½ Σ r² with its derivative by reverse mode, both evaluated once; infinite where it or its derivative fails."""

    def evaluate(z: Coordinates) -> tuple[Array, Coordinates]:
        _, cost, gradient = problem.gradient(z, sigmas)
        known = jnp.isfinite(cost) & jnp.isfinite(gradient).all()
        return jnp.where(known, cost, jnp.inf), jnp.where(known, gradient, 0)

    @jax.custom_jvp
    def value(z: Coordinates) -> Array:
        return evaluate(z)[0]

    @value.defjvp
    def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
        cost, gradient = evaluate(primals[0])
        return cost, gradient @ tangents[0]

    return value(z)
