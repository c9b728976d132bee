"""Terms of the potential: energies of the nodes' displacement in a step, their forces and their stiffness."""

import abc
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, reduce
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, NodeVector, Scalar
from mpmjax.discretisation import Stencil, gather, in_section, in_space, scatter


class Displacement:
    """A displacement [m] or velocity [m/s] of all nodes. Terms that need it at the particles share one gather."""

    def __init__(self, stencil: Stencil, size: int, nodes: NodeVector | None = None):
        """A field of n = `size` nodes, (n, d); None for zero, which spares the gather."""
        self.stencil, self.size, self.at_rest = stencil, size, nodes is None
        if nodes is not None:
            self.nodes = nodes

    @cached_property
    def nodes(self) -> NodeVector:
        """u_i, shape (n, d)."""
        return jnp.zeros((self.size, self.stencil.dim), self.stencil.xi.dtype)

    @cached_property
    def at_particles(self) -> tuple[Float[Array, "d p"], Float[Array, "k k p"]]:
        """Σ_i w_ip u_i and Σ_i g_ip u_i, the derivative's direction first, in bodies of revolution (3, 3, p)."""
        value, slopes = gather(self.stencil, self.nodes)
        radius = self.stencil.radius
        return value, slopes if radius is None else in_space(radius, value, slopes)


class Forces(NamedTuple):
    """Forces on the nodes, f_i + Σ_p (w_ip a_p + Σ_b g_ip,b a_p,b). Those of several terms share one scatter."""

    nodes: NodeVector | None = None  # f_i [N], shape (n, d)
    value: Float[Array, "d p"] | None = None  # a_p [N], shape (d, p)
    slopes: Float[Array, "k k p"] | None = None
    """a_p,b [J], shape (d, d, p), the derivative's direction b first; in bodies of revolution (3, 3, p)."""

    def in_section(self, radius: Float[Array, "p"]) -> "Forces":
        """The forces with matrices in space taken to what a ring gives to the nodes of its section."""
        if self.slopes is None or len(self.slopes) == 2:
            return self
        around, slopes = in_section(radius, self.slopes)
        return Forces(self.nodes, around if self.value is None else self.value + around, slopes)

    def product(self, moved: Displacement) -> Float[Array, ""]:
        """Their work at a displacement [J], or power at a velocity [W]."""
        total = jnp.zeros((), moved.stencil.xi.dtype) if self.nodes is None else (self.nodes * moved.nodes).sum()
        for part, at in () if self[1:] == (None, None) else zip(self[1:], moved.at_particles, strict=True):
            total = total if part is None else total + (part * at).sum()
        return total


def scattered(forces: Sequence[Forces], stencil: Stencil, size: int) -> NodeVector:
    """The sum of forces, one or more, on all nodes [N], shape (n, d)."""
    if stencil.radius is not None:
        forces = [force.in_section(stencil.radius) for force in forces]
    parts = ([a for a in field if a is not None] for field in zip(*forces, strict=True))
    nodes, value, slopes = (reduce(jnp.add, part) if part else None for part in parts)
    if value is None and slopes is None:
        return jnp.zeros((size, stencil.dim), stencil.xi.dtype) if nodes is None else nodes
    total = scatter(stencil, value, slopes, size)
    return total if nodes is None else total + nodes


class AbstractStiffness(eqx.Module):
    """The Hessian H of a term [N/m], a symmetric linear map of displacements."""

    @abc.abstractmethod
    def __call__(self, moved: Displacement) -> Forces:
        """H u."""

    def is_positive_semidefinite(self) -> bool:
        """Whether H is known to be positive semi-definite. Default: False."""
        return False

    def diagonal(self, stencil: Stencil, size: int) -> Forces:
        """An approximation of the diagonal of H [N/m], for preconditioners: on n = `size` nodes, as factors of w_ip²
        and of g_ip,b². Default: zero."""
        return Forces()

    def damped(self, rate: Scalar) -> "AbstractStiffness":
        """H + r D, with r [1/s] and the D of `AbstractTerm.resistance`. Default: H, for terms without resistance."""
        return self


class AbstractTerm(eqx.Module):
    """A part of the potential Φ(u) of a step, besides the energy of the materials: an energy of the displacement u of
    the nodes, and a resistance to their velocity.

    One of your own needs `energy`; an `AbstractLoad` brings it to a scene. Its force and stiffness are derivatives of
    the energy, unless the term has faster ones. `stable_dt` needs `stability_rates`.
    """

    viscous: ClassVar[bool] = False  # whether it has a `resistance`

    @abc.abstractmethod
    def energy(self, moved: Displacement) -> Float[Array, ""]:
        """The energy [J] at a displacement of the nodes; any constant may be added."""

    def force(self, moved: Displacement) -> Forces:
        """Minus the derivative of the energy by the displacement. Default: by `jax.grad`."""

        def energy(u: NodeVector) -> Float[Array, ""]:
            return self.energy(Displacement(moved.stencil, moved.size, u))

        return Forces(nodes=-jax.grad(energy)(moved.nodes))

    def hessian(self, moved: Displacement) -> AbstractStiffness:
        """The second derivative of the energy at a displacement. Default: by `jax.jvp` of `force`, without a share in
        the preconditioner's diagonal."""
        return _JvpStiffness(self, moved.nodes)

    def is_admissible(self, moved: Displacement) -> Bool[Array, ""] | None:
        """Whether the energy is defined at a displacement; None if it always is, which is the default. The line search
        of Newton's method avoids the others."""
        return None

    def resistance(self, velocity: Displacement) -> Forces | None:
        """D v, the force that takes a velocity of the nodes, D symmetric and positive semi-definite. Default: None."""
        return None

    def drag(self, size: int) -> tuple[Forces, Float[Array, ""]] | None:
        """The viscous force on n = `size` nodes at the velocity at the start of the step, for explicit integrators, and
        the power [W] that it dissipates. Default: None."""
        return None

    def stability_rates(
        self, mass: Float[Array, "p"], steepness: Float[Array, "p"]
    ) -> tuple[Array | float, Array | float] | None:
        """z [1/s²] and y [1/s] of each particle, or numbers, that energy and resistance add to the left side of the
        bound Δt² z + Δt y ≤ 4 of `stable_dt`. Default: None, for which `stable_dt` raises.

        A spring k to the ground at an arm r of a mass m has z = 2 k (1 + A r²)/m, a dashpot c y = 4 c (1 + A r²)/m.

        Args:
            mass: masses of the particles m [kg], shape (p,).
            steepness: A [1/m²] (see `stable_dt`), shape (p,).
        """
        return None


class _JvpStiffness(AbstractStiffness):
    term: AbstractTerm
    at: NodeVector
    rate: Any = None  # r [1/s]; None without resistance

    def __call__(self, moved: Displacement) -> Forces:
        def force(u: NodeVector) -> NodeVector:
            there = Displacement(moved.stencil, moved.size, u)
            return scattered([self.term.force(there)], moved.stencil, moved.size)

        answer = -jax.jvp(force, (self.at,), (moved.nodes,))[1]
        if self.rate is not None and (resisted := self.term.resistance(moved)) is not None:
            answer = answer + self.rate * scattered([resisted], moved.stencil, moved.size)
        return Forces(nodes=answer)

    def damped(self, rate: Scalar) -> "_JvpStiffness":
        return replace(self, rate=rate)


class AbstractSpring(AbstractTerm, AbstractStiffness):
    """Springs ½ Σ_s k_s (e_s + N_s u)² of an elongation linear in the displacement, of constant Hessian Nᵀ k N."""

    stretch: eqx.AbstractVar[Array]  # e_s at u = 0 [m]
    stiffness: eqx.AbstractVar[Array]  # k_s [N/m], in the same shape

    @abc.abstractmethod
    def elongation(self, moved: Displacement) -> Array:
        """N u [m]."""

    @abc.abstractmethod
    def spread(self, amount: Array, size: int) -> Forces:
        """Nᵀ a."""

    def stretched(self, moved: Displacement) -> Array:
        """e + N u [m]."""
        return self.stretch if moved.at_rest else self.stretch + self.elongation(moved)

    def energy(self, moved: Displacement) -> Float[Array, ""]:
        return 0.5 * (self.stiffness * self.stretched(moved) ** 2).sum()

    def force(self, moved: Displacement) -> Forces:
        return self.spread(-self.stiffness * self.stretched(moved), moved.size)

    def hessian(self, moved: Displacement) -> "AbstractSpring":
        return self

    def __call__(self, moved: Displacement) -> Forces:
        return self.spread(self.stiffness * self.elongation(moved), moved.size)

    def is_positive_semidefinite(self) -> bool:
        return True
