"""Hessians of the elastic energy: where they are evaluated, and from what."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Deformation, NodeVector
from mpmjax.checks import require_fields
from mpmjax.implicit._hessian_action import AbstractHessianAction, ParticleStiffness, TangentAction, particle_stiffness
from mpmjax.implicit._potential import Deformations, ElasticPotential
from mpmjax.material import AbstractElastic, AbstractTangent


class AbstractHessian(eqx.Module):
    """How the elastic energy's Hessian acts in an implicit update.

    One linear solve solves the equation that the Hessian makes; Newton's method takes steps with it to the solution of
    an equation in which it has no part. A Hessian of your own derives from this class; from stress differentials at a
    deformation `TangentAction` makes the map that `at` returns.
    """

    @abc.abstractmethod
    def at(self, potential: ElasticPotential, u: NodeVector) -> AbstractHessianAction:
        """The Hessian of the potential at a nodal displacement u [m], shape (n, d)."""

    def at_current(self, potential: ElasticPotential, like: NodeVector) -> AbstractHessianAction:
        """The Hessian at u = 0; `like` is any node vector."""
        return self.at(potential, jnp.zeros_like(like))

    @abc.abstractmethod
    def exact(self) -> "AbstractHessian":
        """The Hessian of which this may be an approximation. The derivatives of Newton's solution are taken with it."""


class AnalyticHessian(AbstractHessian):
    """Hessian by the law's stress differential (derivation, eqs. 7 to 12). Faster than `JvpHessian`.

    With `projected`, each particle's stress differential is made positive semi-definite first (see the law's
    `projected_tangent`), so that M + cH is positive definite whatever the compression and the step. A particle whose
    differential is so already is not changed by it. One linear solve then solves another, more strongly damped
    equation where it matters; Newton's method only takes another way to the same solution. First derivatives stay
    exact; second ones are refused.

    Args:
        projected: whether to project.
    """

    projected: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        require_fields(self)

    def at(self, potential: ElasticPotential, u: NodeVector) -> AbstractHessianAction:
        return self._action(potential, potential.deformation(u))

    def at_current(self, potential: ElasticPotential, like: NodeVector) -> AbstractHessianAction:
        del like
        return self._action(potential, potential.current_deformation())  # without the gather

    def exact(self) -> "AnalyticHessian":
        return AnalyticHessian()

    def _action(self, potential: ElasticPotential, F: Deformations) -> TangentAction:
        def tangent(law: AbstractElastic, F: Deformation) -> AbstractTangent:
            return law.projected_tangent(F) if self.projected else law.tangent(F)

        laws = (c.law for c in potential.material_points)
        tangents = tuple(tangent(law, own) for law, own in zip(laws, F, strict=True))
        return TangentAction(potential, tangents, self.projected)


class JvpHessian(AbstractHessian):
    """Hessian by `jax.jvp` of the energy's gradient. It needs nothing of a law but its energy, and the tests hold
    `AnalyticHessian` to it."""

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
        laws = (c.law for c in self.potential.material_points)
        F = self.potential.deformation(self.u)
        tangents = tuple(_jvp_tangent(law, own) for law, own in zip(laws, F, strict=True))
        return particle_stiffness(self.potential, tangents, positive_semidefinite=False)


def _jvp_tangent(law: AbstractElastic, F: Deformation) -> Callable[[Deformation], Deformation]:
    stress = jax.grad(lambda F: law.energy(F).sum())
    return lambda dF: jax.jvp(stress, (F,), (dF,))[1]


@jax.jit
def _jvp_action(potential: ElasticPotential, u: NodeVector, du: NodeVector) -> NodeVector:
    return jax.jvp(jax.grad(potential.energy), (u,), (du,))[1]
