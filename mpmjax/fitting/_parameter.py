"""Parameters that are fitted, numbers and fields, the coordinates in which they are searched, and priors."""

import abc
from collections.abc import Callable
from functools import partial
from operator import attrgetter
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, ParticleScalar, ParticleVector, Scalar
from mpmjax.checks import (
    as_floats,
    as_plain,
    canonical,
    checked,
    finite,
    positive,
    require,
    require_fields,
    require_finite,
    require_positive,
)
from mpmjax.discretisation import BSpline, Grid, SplineGradient, gather, in_window, make_stencil
from mpmjax.fitting._experiment import Experiment, drawn_nearer
from mpmjax.state import Particles

Value = Float[Array, "..."]
Start = Scalar | Value | Float[np.ndarray, "..."] | tuple | list


class AbstractPrior(eqx.Module):
    """Prior knowledge of a parameter, as residuals beside those of the data."""

    __check_init__ = require_fields

    @abc.abstractmethod
    def residuals(self, value: Value, free: Value) -> Float[Array, "k"]:
        """The residuals [-], shape (k,), of the value in its unit and, in its shape, `AbstractParameter.free` of it."""

    @abc.abstractmethod
    def check(self, name: str, shape: tuple[int, ...]) -> None:
        """Raise a `ValueError` if it does not fit a parameter of this shape."""

    @abc.abstractmethod
    def fixes(self, shape: tuple[int, ...]) -> int:
        """How many numbers of a parameter of this shape it fixes by itself."""

    def distribution(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Mean and standard deviation of each number, in the parameter's unit. Default: None, nothing is known."""

    def drawn(self, rng: np.random.Generator) -> "AbstractPrior":
        """The prior as another measurement would have given it. Default: itself."""
        return self


class Gaussian(AbstractPrior):
    """Prior knowledge of a parameter: a normal distribution. It acts like one more measured point a number.

    Args:
        mean, sigma: expected value and standard deviation, in the parameter's unit, one number or one for each entry.
    """

    mean: Annotated[Float[np.ndarray, "..."], finite] = eqx.field(converter=as_floats)
    sigma: Annotated[Float[np.ndarray, "..."], positive] = eqx.field(converter=as_floats)

    def residuals(self, value: Value, free: Value) -> Float[Array, "k"]:
        """(value − mean)/σ."""
        return ((value - jnp.asarray(self.mean, value.dtype)) / jnp.asarray(self.sigma, value.dtype)).reshape(-1)

    def distribution(self) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(self.mean), np.asarray(self.sigma)

    def drawn(self, rng: np.random.Generator) -> "Gaussian":
        return Gaussian(self.mean + self.sigma * rng.normal(size=np.shape(self.mean)), self.sigma)

    def check(self, name: str, shape: tuple[int, ...]) -> None:
        shapes, fits = {np.shape(self.mean), np.shape(self.sigma)}, {(), shape}
        require(shapes <= fits, f"The prior of {name!r} must have one number or shape {shape}, got {sorted(shapes)}.")

    def fixes(self, shape: tuple[int, ...]) -> int:
        return int(np.prod(shape))


class Smooth(AbstractPrior):
    """Prior knowledge of a field: neighbours along its axes, nodes of a `Field` or times of a history, differ little by
    a normal distribution of mean zero: logarithms of a `Positive` parameter, logits of a `Bounded` one, values of an
    `Unbounded` one. The mean level is left free.

    Args:
        sigma: standard deviation of the difference of two neighbours, 0.1 of a `Positive` parameter for about 10 %. On
            a lattice of half the spacing, the same roughness is about 1/√2 of it.
        robust: the difference, in standard deviations, beyond which squares grow but linearly (pseudo-Huber), so that a
            jump stays one, for bodies made of regions. Default: none.
    """

    sigma: Annotated[Scalar, positive] = eqx.field(converter=as_floats)
    robust: Annotated[Scalar, positive] | None = eqx.field(converter=as_floats, default=None)

    def residuals(self, value: Value, free: Value) -> Float[Array, "k"]:
        """(f_{i+1} − f_i)/σ along each axis."""
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


class AbstractParameter(eqx.Module):
    """A number, or an array of them, that is fitted.

    It is searched in a coordinate z, of the value's shape, that takes every real number and is zero at the first guess:
    no bound is ever crossed, and a step of one is a large but not an absurd change.
    """

    where: eqx.AbstractVar[Callable[[Experiment], Any] | None]  # the leaf, or a tuple that share the value
    update: eqx.AbstractVar[Callable[[Experiment, Value], Experiment] | None]  # in its place: puts the value in
    start: eqx.AbstractVar[Start | None]  # the first guess; None for the value of the first experiment
    prior: eqx.AbstractVar[AbstractPrior | None]  # prior knowledge of it
    unit: eqx.AbstractVar[str]  # the unit that tables show
    only: eqx.AbstractVar[tuple[int, ...] | None]  # numbers, from 0, of the experiments it belongs to; None for all

    def __check_init__(self):
        require_fields(self)
        name = type(self).__name__
        require(
            (self.where is None) != (self.update is None),
            f"{name} takes either where (the leaf of an experiment) or update (a function that puts the value in), got "
            f"{'neither' if self.where is None else 'both'}.",
        )
        require(self.update is None or self.start is not None, f"{name} with update needs a start: the first guess.")
        if self.start is not None:
            require_finite(f"{name}'s start", self.start)
        if self.prior is not None and (distribution := self.prior.distribution()) is not None:
            (lower, upper), mean = self.domain, distribution[0]
            fault = (
                f"{name}'s values lie between {lower:g} and {upper:g}, so the mean of its prior must too, got {mean}."
            )
            require((mean >= lower) & (mean <= upper), fault)

    @property
    def logarithmic(self) -> bool:
        """Whether z is the logarithm of the value but for a constant."""
        return False

    @property
    def domain(self) -> tuple[float, float]:
        """The open interval in which values lie."""
        return -np.inf, np.inf

    @abc.abstractmethod
    def value(self, start: Value, z: Value) -> Value:
        """The value at a coordinate z [-]; `start` at zero."""

    @abc.abstractmethod
    def free(self, value: Value) -> Value:
        """The value in a measure without bounds, whatever the first guess: z but for a constant and a factor."""

    def coordinate(self, start: Value, value: Value) -> Value:
        """z [-] at a value, with zero at `start`. Default: the difference of free values."""
        return self.free(value) - self.free(start)

    def check(self, name: str, start: np.ndarray) -> None:
        """Raise a `ValueError` if the first guess does not lie within the bounds."""
        lower, upper = self.domain
        within = f"between its bounds {lower} and {upper}" if np.isfinite(upper) else "from positive numbers"
        require((start > lower) & (start < upper), f"The parameter {name!r} must start {within}, got {start}.")

    def check_experiment(self, name: str, experiment: Experiment) -> None:
        """Raise a `ValueError` if it cannot be put into an experiment."""

    def room(self, start: Value, z: Value) -> tuple[Value, Value]:
        """How far the value can fall and rise until its bounds, each over its derivative by z [-], in its shape."""
        return jnp.full_like(z, jnp.inf), jnp.full_like(z, jnp.inf)

    def prior_residuals(self, value: Value) -> Array:
        """The residuals of its prior [-], shape (k,); none without."""
        return jnp.zeros(0, value.dtype) if self.prior is None else self.prior.residuals(value, self.free(value))

    def first_guess(self, experiment: Experiment) -> Array:
        """The value that the search starts from."""
        start = leaves_of(self.where, experiment)[0] if self.start is None else self.start
        return jnp.asarray(start, experiment.dtype)

    def put(self, experiment: Experiment, value: Value) -> Experiment:
        """The experiment with this value."""
        if self.update is not None:
            return self.update(experiment, value)
        shapes = [jnp.shape(leaf) for leaf in leaves_of(self.where, experiment)]
        require({*shapes} == {value.shape}, f"it has shape {sorted({*shapes})}, and its start {value.shape}.")
        return eqx.tree_at(partial(leaves_of, self.where), experiment, (value,) * len(shapes))


def leaves_of(where: Callable[[Experiment], Any] | None, experiment: Experiment) -> tuple[Any, ...]:
    """The leaf, or the several leaves, that `where` names."""
    assert where is not None
    leaves = where(experiment)
    return leaves if isinstance(leaves, tuple) else (leaves,)


def changes(parameter: AbstractParameter, experiment: Experiment, start: Any) -> list[str]:
    """The dotted paths of the numbers of an experiment that a parameter changes, by a value that is not its start."""
    other = parameter.put(experiment, jnp.asarray(1 + start + np.abs(start), start.dtype))
    numbers = (eqx.filter(tree, eqx.is_array_like) for tree in (experiment, other))
    before, after = (dict(jax.tree_util.tree_leaves_with_path(tree)) for tree in numbers)
    unlike = (path for path, a in after.items() if path not in before or not np.array_equal(a, before[path]))
    return [jax.tree_util.keystr(path).lstrip(".") for path in unlike]


class _PlainParameter(AbstractParameter):
    """A parameter whose values are put in as they are."""

    where: Callable[[Experiment], Any] | None = None
    update: Callable[[Experiment, Value], Experiment] | None = eqx.field(default=None, kw_only=True)
    start: Start | None = eqx.field(default=None, kw_only=True)
    prior: AbstractPrior | None = eqx.field(default=None, kw_only=True)
    unit: str = eqx.field(static=True, default="", kw_only=True)
    only: tuple[int, ...] | None = eqx.field(static=True, default=None, converter=as_plain, kw_only=True)


class Unbounded(_PlainParameter):
    """A parameter that may have any value, such as a velocity or an angle. For all but the scale see `Positive`.

    Args:
        scale: a change that is large but not absurd. Default: the size of the first guess, or one if that is zero.
    """

    scale: Annotated[Scalar, positive] | None = eqx.field(default=None, kw_only=True)

    def value(self, start: Value, z: Value) -> Value:
        return start + self._scale(start) * z

    def coordinate(self, start: Value, value: Value) -> Value:
        return (value - start) / self._scale(start)

    def free(self, value: Value) -> Value:
        return value

    def _scale(self, start: Value) -> Value | Scalar:
        size = jnp.abs(start).max()
        return jnp.where(size == 0, 1, size) if self.scale is None else self.scale


class Positive(_PlainParameter):
    """A positive parameter, such as a modulus, a viscosity or a density: start·e^z.

    Args:
        where: the leaf, `lambda e: e.scene.material.youngs_modulus`, or a tuple of leaves that share the value.
        update: in its place, the experiment with the value put in, `lambda e, value: ...`.
        start: first guess. Default: the value of the first experiment.
        prior: what is known beforehand.
        unit: the unit that tables show.
        only: numbers of the experiments that it belongs to. Default: all.
    """

    @property
    def logarithmic(self) -> bool:
        return True

    @property
    def domain(self) -> tuple[float, float]:
        return 0.0, np.inf

    def value(self, start: Value, z: Value) -> Value:
        return start * jnp.exp(z)

    def free(self, value: Value) -> Value:
        return jnp.log(value)

    def room(self, start: Value, z: Value) -> tuple[Value, Value]:
        return jnp.ones_like(z), jnp.full_like(z, jnp.inf)


class Bounded(_PlainParameter):
    """A parameter between two bounds, such as Poisson's ratio: lower + (upper − lower)/(1 + e^{−(z0 + z)}).

    Args:
        lower, upper: the bounds; all else see `Positive`.
    """

    lower: float | int = eqx.field(static=True, default=0.0, converter=as_plain)  # the lower bound
    upper: float | int = eqx.field(static=True, default=1.0, converter=as_plain)  # the upper bound

    def __check_init__(self):
        require_fields(self)
        require(self.lower < self.upper, f"Bounded's bounds must grow, got {self.lower} and {self.upper}.")

    @property
    def domain(self) -> tuple[float, float]:
        return self.lower, self.upper

    def value(self, start: Value, z: Value) -> Value:
        return self.lower + (self.upper - self.lower) * jax.nn.sigmoid(self.free(start) + z)

    def free(self, value: Value) -> Value:
        """The logit of where it lies between the bounds."""
        share = (value - self.lower) / (self.upper - self.lower)
        return jnp.log(share) - jnp.log1p(-share)

    def room(self, start: Value, z: Value) -> tuple[Value, Value]:
        """1 + e^{z0 + z} and 1 + e^{−(z0 + z)}."""
        logit = self.free(start) + z
        return 1 + jnp.exp(logit), 1 + jnp.exp(-logit)


class Field(AbstractParameter):
    """A parameter that changes from place to place: values on a lattice, interpolated to the particles as they start.

        stiffness = mpm.Positive(lambda e: e.scene.material.youngs_modulus, prior=mpm.fitting.Smooth(0.5), unit="Pa")
        result = mpm.fit(pull, {"E": mpm.fitting.Field(stiffness, mpm.fitting.Field.lattice_around(particles, 0.1))})

    `result.values["E"]` has the values on the nodes, the fitted scene one for each particle. Nodes that the data do not
    see need a prior, such as `Smooth`. A parameter of a law among several is a field over that law's particles.

    Args:
        of: what each value is: a `Positive`, `Bounded` or `Unbounded` parameter, its leaf one number, or one a
            particle. With `update` it is given one value a particle, shape (p,).
        lattice: the nodes; a window that holds all particles as they start, and neither follows nor is periodic.
        kernel: B-spline of the interpolation: linear, by which values on nodes are those that the field takes there.
        start: first guess, one number or one a node. Default: that of the parameter, or the mean of the leaf.
    """

    of: AbstractParameter
    lattice: Grid
    kernel: BSpline
    start: Start | None

    # All else is of the parameter that it spreads.
    where, update, prior, unit, only, domain = (  # pyright: ignore
        property(attrgetter(f"of.{name}")) for name in ("where", "update", "prior", "unit", "only", "domain")
    )
    value, coordinate, free, check, room, logarithmic = (  # pyright: ignore
        property(attrgetter(f"of.{name}")) for name in ("value", "coordinate", "free", "check", "room", "logarithmic")
    )

    @checked
    def __init__(
        self, of: AbstractParameter, lattice: Grid, *, kernel: BSpline = BSpline(1), start: Start | None = None
    ):
        self.of, self.lattice, self.kernel = of, lattice, kernel
        self.start = of.start if start is None else start

    def __check_init__(self):
        require(not isinstance(self.of, Field), "A Field is of a plain parameter, not of another Field.")
        stays = not self.lattice.follow and not any(self.lattice.periodic)
        require(stays, "The lattice of a Field must stay where it is: drop follow and periodic.")

    @staticmethod
    @checked
    def lattice_around(particles: Particles, spacing: Scalar, *, kernel: BSpline = BSpline(1)) -> Grid:
        """The smallest lattice of a spacing [m] that holds particles where they are."""
        require_positive("The spacing of a Field's lattice [m]", spacing)
        place = np.asarray(particles.x, float) / float(spacing)
        require_finite("The particles' positions [m]", place)
        ends = jnp.asarray([place.min(axis=0), place.max(axis=0)])
        first, last = np.floor(np.asarray(kernel.base(ends))).astype(int).tolist()
        shape = (max(b - a + kernel.order + 1, 4) for a, b in zip(first, last, strict=True))
        return Grid(tuple(shape), spacing, origin=tuple(first))

    def check_experiment(self, name: str, experiment: Experiment) -> None:
        x = experiment.particles.x
        what, lattice = f"The lattice of the field {name!r}", canonical(self.lattice, x.dtype)
        require(lattice.dim == x.shape[1], f"{what} is {lattice.dim}-dimensional, the particles {x.shape[1]}.")
        outside = ~np.asarray(in_window(self.kernel, lattice, lattice.window(x), x))
        require(
            ~outside,
            f"{what} must hold all particles as they start, but {int(outside.sum())} lie outside, the first at "
            f"{np.asarray(x)[outside][:1].tolist()}: take Field.lattice_around(particles, spacing).",
        )

    def first_guess(self, experiment: Experiment) -> Array:
        start, shape = super().first_guess(experiment), self.lattice.shape
        fits = self.start is None or start.shape in ((), shape)
        require(fits, f"its start must have shape {shape}, or be one number")
        return jnp.broadcast_to(start if start.shape == shape else start.mean(), shape)

    def put(self, experiment: Experiment, value: Value) -> Experiment:
        particles = experiment.particles
        values = self.on_particles(particles.x, value)
        if self.update is not None:
            return self.update(experiment, values)
        where, parts = partial(leaves_of, self.where), []
        for number in range(len(where(experiment))):
            mark = object()
            marked = eqx.tree_at(lambda e, k=number: where(e)[k], experiment, mark)
            each = zip(marked.scene.laws, particles.groups, strict=True)
            of_laws = [group.rows for law, group in each if any(leaf is mark for leaf in jax.tree.leaves(law))]
            # The particles to which the leaf belongs: those of its law, or all.
            parts.append(values[of_laws[-1] if of_laws else slice(None)])
        return eqx.tree_at(where, experiment, tuple(parts))

    def on_particles(self, x: ParticleVector, value: Value) -> ParticleScalar:
        """The field at positions x [m], shape (p, d), from its values on the nodes."""
        lattice = canonical(self.lattice, x.dtype)
        stencil = make_stencil(self.kernel, SplineGradient(), lattice, lattice.window(x), x)
        return gather(stencil, value.reshape(-1, 1))[0][0]
