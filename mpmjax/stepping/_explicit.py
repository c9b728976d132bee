"""The explicit step."""

from typing import ClassVar

import jax.numpy as jnp

from mpmjax._types import NodeVector, Scalar
from mpmjax.implicit import SolveInfo, no_solve
from mpmjax.stepping._integrator import AbstractIntegrator, NodeMotion
from mpmjax.stepping._nodes import Nodes


class Explicit(AbstractIntegrator):
    """Symplectic Euler: v^{n+1} = v* (derivation, eq. 4); positions then move with v^{n+1}.

    Second order in space with APIC and FLIP, first order in time. Conserves linear and, with APIC, angular momentum.

    *When it breaks*: above Δt of about 0.4 to 1 times dx/c, depending on dimension, kernel and transfer
    (c the pressure-wave speed of the *current* tangent, which stretching and compression raise): see `stable_dt`.
    """

    is_explicit: ClassVar[bool] = True
    needs_separate_force: ClassVar[bool] = False

    def advance(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        del guess
        v = nodes.projection.combine(nodes.explicit_velocity(), nodes.prescribed)
        return NodeMotion(v), no_solve(v.dtype)

    def elastic_impulse(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """Δt f(0) [kg m/s], on nodes that have mass."""
        del motion
        return jnp.where(nodes.occupied, nodes.dt * nodes.force, 0)

    def stability_factor(self) -> Scalar:
        return 1.0

    def limit_name(self) -> str:
        return "explicit limit"
