"""Hessians of the elastic energy."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax

from mpmjax._types import Deformation, NodeVector
from mpmjax.checks import require_fields
from mpmjax.implicit._hessian_action import AbstractHessianAction, ParticleStiffness, TangentAction, particle_stiffness
from mpmjax.implicit._potential import Deformations, ElasticPotential
from mpmjax.material import AbstractElastic, AbstractTangent


class AbstractHessian(eqx.Module):
    """The Hessian of the elastic energy in an implicit update.

    With one linear solve the Hessian is part of the equation. With Newton's method it only sets the steps towards the
    solution of an equation without it. Subclass it for a Hessian of your own: `at` can return a `TangentAction`, which
    is made from stress differentials at a deformation.
    """

    @abc.abstractmethod
    def at(self, potential: ElasticPotential, u: NodeVector) -> AbstractHessianAction:
        """The Hessian of the potential at a nodal displacement u [m], shape (n, d)."""

    def at_step_start(self, potential: ElasticPotential) -> AbstractHessianAction:
        """The Hessian where no node has moved, u = 0."""
        return self.at(potential, potential.no_displacement())

    @abc.abstractmethod
    def exact(self) -> "AbstractHessian":
        """The Hessian that this one approximates, or this one. Derivatives of a solution by Newton's method use it."""


class AnalyticHessian(AbstractHessian):
    """The Hessian by the stress differential of the law (derivation, eqs. 7 to 12). Faster than `JvpHessian`.

    With `projected`, the stress differential of each particle is made positive semi-definite first (see the law's
    `projected_tangent`). M + χH is then positive definite at every compression and step. Particles whose differential
    is positive semi-definite already are not changed. One linear solve then solves another equation, with more damping;
    Newton's method takes other steps to the same solution. First derivatives stay exact; second derivatives raise.

    Args:
        projected: whether the stress differentials are projected.
    """

    projected: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        require_fields(self)

    def at(self, potential: ElasticPotential, u: NodeVector) -> AbstractHessianAction:
        return self._action(potential, potential.deformation(u))

    def at_step_start(self, potential: ElasticPotential) -> AbstractHessianAction:
        return self._action(potential, potential.current_deformation())  # without the gather

    def exact(self) -> "AnalyticHessian":
        return AnalyticHessian()

    def _action(self, potential: ElasticPotential, F: Deformations) -> TangentAction:
        def tangent(law: AbstractElastic, F: Deformation) -> AbstractTangent:
            return law.projected_tangent(F) if self.projected else law.tangent(F)

        pairs = zip(potential.material_points, F, strict=True)
        tangents = tuple(points.tangent(own, tangent, definite=self.projected) for points, own in pairs)
        return TangentAction(potential, tangents, self.projected)


class JvpHessian(AbstractHessian):
    """The Hessian by `jax.jvp` of the energy's gradient. It needs only the energy of a law, and is the reference of
    the tests for `AnalyticHessian`."""

    def at(self, potential: ElasticPotential, u: NodeVector) -> AbstractHessianAction:
        return _JvpAction(potential, u)

    def exact(self) -> "JvpHessian":
        return self


class _JvpAction(AbstractHessianAction):
    potential: ElasticPotential
    u: NodeVector

    def is_positive_semidefinite(self) -> bool:
        return False

    def __call__(self, du: NodeVector) -> NodeVector:
        """The derivative of ∂Φ/∂u in the direction δu."""
        return _jvp_action(self.potential, self.u, du)

    def precomputed(self) -> ParticleStiffness:
        pairs = zip(self.potential.material_points, self.potential.deformation(self.u), strict=True)
        tangents = tuple(points.tangent(own, _jvp_tangent) for points, own in pairs)
        return particle_stiffness(self.potential, tangents, positive_semidefinite=False)


def _jvp_tangent(law: AbstractElastic, F: Deformation) -> Callable[[Deformation], Deformation]:
    stress = jax.grad(lambda F: law.energy(F).sum())
    return lambda dF: jax.jvp(stress, (F,), (dF,))[1]


@eqx.filter_jit
def _jvp_action(potential: ElasticPotential, u: NodeVector, du: NodeVector) -> NodeVector:
    return jax.jvp(jax.grad(potential.energy), (u,), (du,))[1]
