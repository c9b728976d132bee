"""Fields: parameters that change from place to place."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, ParticleScalar, ParticleVector, Scalar
from mpmjax.checks import canonical, checked, require, require_finite, require_positive
from mpmjax.discretisation import BSpline, Grid, SplineGradient, gather, in_window, make_stencil
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._parameter import AbstractParameter, AbstractPrior, Start, Value
from mpmjax.state import Particles


class Field(AbstractParameter):
    """A parameter that changes from place to place: its values on the nodes of a lattice, interpolated to the particles
    where they start.

        stiffness = mpm.Positive(lambda e: e.scene.material.youngs_modulus, prior=mpm.fitting.Smooth(0.5), unit="Pa")
        result = mpm.fit(pull, {"E": mpm.fitting.Field(stiffness, mpm.fitting.Field.lattice_around(particles, 0.1))})

    `result.values["E"]` has the values on the nodes, the fitted scene one for each particle. Nodes that the data do not
    see need a prior: `Smooth`, or `Gaussian`. A parameter of a law among several is a field over the particles of that
    law, any other over all particles.

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

    @checked
    def __init__(
        self,
        of: AbstractParameter,
        lattice: Grid,
        *,
        kernel: BSpline = BSpline(1),
        start: Start | None = None,
    ):
        self.of, self.lattice, self.kernel = of, lattice, kernel
        self.start = of.start if start is None else start

    def __check_init__(self):
        require(not isinstance(self.of, Field), "A Field is of a plain parameter, not of another Field.")
        require(
            not self.lattice.follow and not any(self.lattice.periodic),
            "The lattice of a Field must stay where it is: drop follow and periodic.",
        )

    @staticmethod
    @checked
    def lattice_around(particles: Particles, spacing: Scalar, *, kernel: BSpline = BSpline(1)) -> Grid:
        """The smallest lattice of a spacing [m] that holds particles where they are."""
        require_positive("The spacing of a Field's lattice [m]", spacing)
        place = np.asarray(particles.x, float) / float(spacing)
        require_finite("The particles' positions [m]", place)
        first = [
            np.floor(np.asarray(kernel.base(jnp.asarray(end)))).astype(int) for end in (place.min(0), place.max(0))
        ]
        shape = np.maximum(first[1] - first[0] + kernel.order + 1, 4)
        return Grid(tuple(map(int, shape)), spacing, origin=tuple(map(int, first[0])))

    @property
    def where(self) -> Callable[[Experiment], Any] | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The leaf, or the tuple of leaves, that takes the values on particles."""
        return self.of.where

    @property
    def update(self) -> Callable[[Experiment, Value], Experiment] | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """In its place, a function that puts them in."""
        return self.of.update

    @property
    def prior(self) -> AbstractPrior | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Prior knowledge of the values on nodes."""
        return self.of.prior

    @property
    def unit(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Their unit."""
        return self.of.unit

    @property
    def only(self) -> tuple[int, ...] | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The experiments that it belongs to."""
        return self.of.only

    @property
    def logarithmic(self) -> bool:
        return self.of.logarithmic

    @property
    def domain(self) -> tuple[float, float]:
        return self.of.domain

    def value(self, start: Value, z: Value) -> Value:
        return self.of.value(start, z)

    def coordinate(self, start: Value, value: Value) -> Value:
        return self.of.coordinate(start, value)

    def free(self, value: Value) -> Value:
        return self.of.free(value)

    def check(self, name: str, start: np.ndarray) -> None:
        self.of.check(name, start)

    def room(self, start: Value, z: Value) -> tuple[Value, Value]:
        return self.of.room(start, z)

    def check_experiment(self, name: str, experiment: Experiment) -> None:
        x = experiment.particles.x
        require(
            self.lattice.dim == x.shape[1],
            f"The lattice of the field {name!r} is {self.lattice.dim}-dimensional, the particles {x.shape[1]}-"
            "dimensional.",
        )
        lattice = canonical(self.lattice, x.dtype)
        outside = ~np.asarray(in_window(self.kernel, lattice, lattice.window(x), x))
        require(
            ~outside,
            f"The lattice of the field {name!r} must hold all particles as they start, but {int(outside.sum())} lie "
            f"outside, the first at {np.asarray(x)[outside][:1].tolist()}: take Field.lattice_around(particles, "
            "spacing).",
        )

    def first_guess(self, experiment: Experiment) -> Array:
        start = super().first_guess(experiment)
        shape = self.lattice.shape
        require(
            self.start is None or start.shape in ((), shape), f"its start must have shape {shape}, or be one number"
        )
        return jnp.broadcast_to(start if start.shape == shape else start.mean(), shape)

    def put(self, experiment: Experiment, value: Value) -> Experiment:
        values = self.on_particles(experiment.particles.x, value)
        if self.update is not None:
            return self.update(experiment, values)
        where = self.where
        assert where is not None
        leaves = where(experiment)
        several = leaves if isinstance(leaves, tuple) else (leaves,)
        parts = tuple(values[slice(*_rows(where, experiment, number))] for number in range(len(several)))
        return eqx.tree_at(where, experiment, parts if isinstance(leaves, tuple) else parts[0])

    def on_particles(self, x: ParticleVector, value: Value) -> ParticleScalar:
        """The field at positions x [m], shape (p, d), from its values on the nodes."""
        lattice = canonical(self.lattice, x.dtype)
        stencil = make_stencil(self.kernel, SplineGradient(), lattice, lattice.window(x), x, affine=False)
        return gather(stencil, value.reshape(-1, 1))[0][0]


class _Mark:
    """Marks the place of a leaf."""


def _rows(where: Callable[[Experiment], Any], experiment: Experiment, number: int) -> tuple[int, int]:
    """The particles to which leaf `number` of `where` belongs, the first and the one after the last: those of its law,
    or all."""

    def one(experiment: Experiment) -> Any:
        leaves = where(experiment)
        return leaves[number] if isinstance(leaves, tuple) else leaves

    marked = eqx.tree_at(one, experiment, _Mark())
    for law, group in zip(marked.scene.laws, experiment.particles.groups, strict=True):
        if any(isinstance(leaf, _Mark) for leaf in jax.tree.leaves(law)):
            return group.rows
    return 0, experiment.particles.count
