"""Priors: what is known of a parameter before anything is measured."""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Scalar
from mpmjax.checks import as_floats, require, require_fields, require_finite, require_positive

Value = Float[Array, "..."]


class AbstractPrior(eqx.Module):
    """Prior knowledge of a parameter, as residuals that stand beside those of the data."""

    @abc.abstractmethod
    def residuals(self, value: Value, free: Value) -> Float[Array, "k"]:
        """The residuals [-], shape (k,).

        Args:
            value: the parameter's value, in its unit.
            free: the same in a measure without bounds (see `AbstractParameter.free`), of the same shape.
        """

    @abc.abstractmethod
    def check(self, name: str, shape: tuple[int, ...]) -> None:
        """Check that it fits a parameter of this shape.

        Raises:
            ValueError: it does not.
        """

    @abc.abstractmethod
    def fixes(self, shape: tuple[int, ...]) -> int:
        """How many numbers of a parameter of this shape it fixes by itself."""

    def distribution(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Mean and standard deviation of each number by itself, in the parameter's unit; None where it says nothing of
        single numbers, which is the default."""
        return None

    def drawn(self, rng: np.random.Generator) -> "AbstractPrior":
        """The prior as another measurement would have given it. Default: itself."""
        del rng
        return self


class Gaussian(AbstractPrior):
    """Prior knowledge of a parameter: a normal distribution. It acts like one more measured point a number.

    Args:
        mean: expected value, in the parameter's unit, one number or one for each entry.
        sigma: its standard deviation, likewise.
    """

    mean: Float[np.ndarray, "..."] = eqx.field(converter=as_floats)
    sigma: Float[np.ndarray, "..."] = eqx.field(converter=as_floats)

    def __check_init__(self):
        require_fields(self)
        require_finite("Gaussian's mean", self.mean)
        require_positive("Gaussian's sigma", self.sigma)

    def residuals(self, value: Value, free: Value) -> Float[Array, "k"]:
        """(value − mean)/σ."""
        del free
        mean, sigma = (jnp.broadcast_to(jnp.asarray(a, value.dtype), value.shape) for a in (self.mean, self.sigma))
        return ((value - mean) / sigma).reshape(-1)

    def distribution(self) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(self.mean), np.asarray(self.sigma)

    def drawn(self, rng: np.random.Generator) -> "Gaussian":
        mean, sigma = self.distribution()
        return Gaussian(mean + sigma * rng.normal(size=np.shape(mean)), sigma)

    def check(self, name: str, shape: tuple[int, ...]) -> None:
        shapes = {np.shape(self.mean), np.shape(self.sigma)}
        fits = shapes <= {(), shape}
        require(fits, f"The prior of {name!r} must have one number or shape {shape}, got {sorted(shapes)}.")

    def fixes(self, shape: tuple[int, ...]) -> int:
        return int(np.prod(shape))


class Smooth(AbstractPrior):
    """Prior knowledge of a field: neighbours differ little, by a normal distribution of mean zero.

    Neighbours are entries next to each other along an axis of the parameter, which is an array: the nodes of a `Field`,
    or a history in time. The difference is that of logarithms of a `Positive` parameter (σ = 0.1: about 10 % from one
    node to the next), of logits of a `Bounded` one, of values of an `Unbounded` one. The mean level is left free.

    Squares draw a jump out over several nodes. With `robust` δ differences beyond δ standard deviations count but
    linearly (pseudo-Huber, as of observations), and a jump stays one: for bodies made of regions.

    Args:
        sigma: standard deviation of the difference of two neighbours. On a lattice of half the spacing, the same
            roughness is about 1/√2 of it.
        robust: the difference, in standard deviations, beyond which squares grow but linearly. Default: none.
    """

    sigma: Scalar = eqx.field(converter=as_floats)
    robust: Scalar | None = eqx.field(converter=as_floats, default=None)

    def __check_init__(self):
        require_fields(self)
        require_positive("Smooth's sigma", self.sigma)
        if self.robust is not None:
            require_positive("Smooth's robust limit", self.robust)

    def residuals(self, value: Value, free: Value) -> Float[Array, "k"]:
        """(f_{i+1} − f_i)/σ along each axis."""
        del value
        parts = [jnp.diff(free, axis=axis).reshape(-1) for axis in range(free.ndim)]
        r = jnp.concatenate(parts) / jnp.asarray(self.sigma, free.dtype)
        return r if self.robust is None else drawn_nearer(r, jnp.asarray(self.robust, free.dtype))

    def check(self, name: str, shape: tuple[int, ...]) -> None:
        require(
            int(np.prod(shape)) > 1,
            f"The prior of {name!r} is Smooth, of neighbours, but {name!r} is one number: make it a Field, or take "
            "Gaussian.",
        )

    def fixes(self, shape: tuple[int, ...]) -> int:
        return int(np.prod(shape)) - 1


def drawn_nearer(r: Array, limit: Scalar | Array) -> Array:
    """Residuals whose squares grow but linearly beyond a limit δ: r √(2/(1 + √(1 + r²/δ²))), half the square of which
    is the pseudo-Huber loss δ² (√(1 + r²/δ²) − 1)."""
    return r * jnp.sqrt(2 / (1 + jnp.sqrt(1 + (r / limit) ** 2)))
