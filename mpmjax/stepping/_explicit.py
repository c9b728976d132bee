"""The explicit integrator."""

from typing import ClassVar

import jax.numpy as jnp

from mpmjax._types import NodeVector, Scalar
from mpmjax.implicit import SolveInfo, no_solve
from mpmjax.stepping._integrator import AbstractIntegrator, NodeMotion
from mpmjax.stepping._nodes import Nodes


class Explicit(AbstractIntegrator):
    """Symplectic Euler: v^{n+1} = v* = v^n + Δt (g + f/m) (derivation, eq. 4). Positions move with v^{n+1}.

    First order in time, and second if velocities start half a step before positions; second order in space with APIC
    and FLIP. It conserves linear momentum, and with APIC angular momentum too.

    *When it breaks*: above a Δt of about 0.4 to 1 times dx/c, depending on dimension, kernel and transfer. c is the
    pressure-wave speed of the *current* tangent, which stretching and compression raise. `stable_dt` gives the limit.
    """

    is_explicit: ClassVar[bool] = True
    needs_separate_force: ClassVar[bool] = False

    def advance(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        del guess
        v = nodes.admitted(nodes.explicit_velocity())
        return NodeMotion(v), no_solve(v.dtype)

    def elastic_impulse(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """Δt f(0) [kg m/s], on nodes that have mass."""
        del motion
        return jnp.where(nodes.occupied, nodes.dt * nodes.force, 0)

    def stability_factor(self) -> Scalar:
        return 1.0

    def limit_name(self) -> str:
        return "explicit limit"
