"""Adam by optax, one simulation at a time."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax

from mpmjax._types import Array, Float, Int, Scalar
from mpmjax.checks import as_floats, require_fields, require_positive, require_whole
from mpmjax.fitting._optimiser import AbstractOptimiser, Evaluation, where
from mpmjax.fitting._problem import Coordinates, FitProblem


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

    def begin(self, problem: FitProblem, z: Coordinates, sigmas: tuple[Array, ...]) -> "AdamState":
        del problem, sigmas
        one, zero = jnp.ones((), z.dtype), jnp.zeros((), jnp.int32)
        none = jnp.zeros_like(z)
        return AdamState(zero, z, _MOMENTS.init(z), one * jnp.inf, none, one, jnp.asarray(self.rate(0), z.dtype), zero)

    def iterate(
        self, problem: FitProblem, z: Coordinates, sigmas: tuple[Array, ...], state: "AdamState"
    ) -> tuple[Coordinates, "AdamState", Evaluation]:
        _, cost, gradient = problem.gradient(state.trial, sigmas)
        first = state.number == 0
        known = jnp.isfinite(cost) & jnp.isfinite(gradient).all()
        lower = known & (cost < state.cost)
        fruitless = jnp.where(lower, 0, state.fruitless + 1)
        back = ~known | (fruitless >= self.patience)
        z, best, slope = where(lower | first, (state.trial, cost, gradient), (z, state.cost, state.gradient))

        fresh = _MOMENTS.init(z)
        start, from_here, moments = where(back, (z, slope, fresh), (state.trial, gradient, state.moments))
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
    """What Adam remembers."""

    number: Int[Array, ""]
    """How many simulations there were."""
    trial: Coordinates
    """Where the next one is."""
    moments: optax.ScaleByAdamState
    """Means of gradients and of their squares."""
    cost: Float[Array, ""]
    """The lowest cost, that where it is."""
    gradient: Coordinates
    factor: Float[Array, ""]
    """By what the learning rate is multiplied."""
    step: Float[Array, ""]
    """Length of the next step [-]."""
    fruitless: Int[Array, ""]
    """How many simulations in a row found nothing lower."""


_MOMENTS: Any = optax.scale_by_adam()
