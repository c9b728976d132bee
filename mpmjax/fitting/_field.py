"""Fields: parameters that change from place to place."""

from functools import partial
from operator import attrgetter
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, ParticleScalar, ParticleVector, Scalar
from mpmjax.checks import canonical, checked, require, require_finite, require_positive
from mpmjax.discretisation import BSpline, Grid, SplineGradient, gather, in_window, make_stencil
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._parameter import AbstractParameter, Start, Value, leaves_of
from mpmjax.state import Particles


def _of_plain(name: str) -> Any:
    """An attribute of a field that is one of the parameter that it spreads."""
    return property(attrgetter(f"of.{name}"))


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

    where, update, prior, unit = map(_of_plain, ("where", "update", "prior", "unit"))
    only, value, coordinate, free = map(_of_plain, ("only", "value", "coordinate", "free"))
    check, room, domain = map(_of_plain, ("check", "room", "domain"))  # pyright: ignore[reportIncompatibleMethodOverride]
    logarithmic = _of_plain("logarithmic")  # pyright: ignore[reportIncompatibleMethodOverride]

    @checked
    def __init__(
        self, of: AbstractParameter, lattice: Grid, *, kernel: BSpline = BSpline(1), start: Start | None = None
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
        first, last = (
            np.floor(np.asarray(kernel.base(jnp.asarray(end)))).astype(int) for end in (place.min(0), place.max(0))
        )
        shape = np.maximum(last - first + kernel.order + 1, 4)
        return Grid(tuple(map(int, shape)), spacing, origin=tuple(map(int, first)))

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
        start, shape = super().first_guess(experiment), self.lattice.shape
        fits = self.start is None or start.shape in ((), shape)
        require(fits, f"its start must have shape {shape}, or be one number")
        return jnp.broadcast_to(start if start.shape == shape else start.mean(), shape)

    def put(self, experiment: Experiment, value: Value) -> Experiment:
        values = self.on_particles(experiment.particles.x, value)
        if self.update is not None:
            return self.update(experiment, values)
        where, parts = partial(leaves_of, self.where), []
        for number in range(len(where(experiment))):
            # The particles to which a leaf belongs: those of its law, or all.
            mark, rows = object(), (0, experiment.particles.count)
            marked = eqx.tree_at(lambda e, k=number: where(e)[k], experiment, mark)
            for law, group in zip(marked.scene.laws, experiment.particles.groups, strict=True):
                if any(leaf is mark for leaf in jax.tree.leaves(law)):
                    rows = group.rows
            parts.append(values[slice(*rows)])
        return eqx.tree_at(where, experiment, tuple(parts))

    def on_particles(self, x: ParticleVector, value: Value) -> ParticleScalar:
        """The field at positions x [m], shape (p, d), from its values on the nodes."""
        lattice = canonical(self.lattice, x.dtype)
        stencil = make_stencil(self.kernel, SplineGradient(), lattice, lattice.window(x), x)
        return gather(stencil, value.reshape(-1, 1))[0][0]
