"""The interface of linear solvers, and the report of a solve."""

from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import Array, Bool, Float, Int
from mpmjax.checks import Mark, require_that

_COUNT = partial(jnp.zeros, (), jnp.int32)


class SolveInfo(eqx.Module):
    """Cost and quality of the solution of one step's equations. The defaults are those of an update without a solve."""

    iterations: Int[Array, "*f"] = eqx.field(default_factory=_COUNT)
    """Iterations of the linear solver, summed over Newton steps; 0 if the solver states none."""
    newton: Int[Array, "*f"] = eqx.field(default_factory=_COUNT)  # Newton steps
    line_search: Int[Array, "*f"] = eqx.field(default_factory=_COUNT)  # halvings of a Newton step by the line search
    residual: Float[Array, "*f"] = eqx.field(kw_only=True)
    """True relative residual at the end. For one linear solve it is in the norm of the inverse preconditioner; for
    Newton's method in that of the inverse mass, and relative to the momentum of the balanced forces if their sum
    vanishes."""
    converged: Bool[Array, "*f"] = eqx.field(default_factory=partial(jnp.ones, (), bool))
    """Whether the residual is within the solver's tolerance, or at the limit of the precision."""
    nearly_converged: Bool[Array, "*f"] = eqx.field(default_factory=partial(jnp.zeros, (), bool))
    """Whether it is not, but within ten times the tolerance."""
    indefinite: Bool[Array, "*f"] = eqx.field(default_factory=partial(jnp.zeros, (), bool))
    """Whether the solver met a direction of negative curvature. M + χH is then indefinite, and may be near singular."""
    report: Float[Array, "*f"] = eqx.field(kw_only=True)
    """Zero. Its tangent is the relative residual of the tangent solves that did not converge (see `Reporting`)."""

    def followed_by(self, later: "SolveInfo") -> "SolveInfo":
        """The summed cost of two solves of one equation, and the quality of the later one."""
        return replace(
            later,
            iterations=self.iterations + later.iterations,
            newton=self.newton + later.newton,
            line_search=self.line_search + later.line_search,
            indefinite=self.indefinite | later.indefinite,
            report=self.report + later.report,
        )

    def together_with(self, other: "SolveInfo") -> "SolveInfo":
        """The summed cost of two solves that are both needed, and the quality of the worse one."""
        both = self.followed_by(other)
        converged = self.converged & other.converged
        usable = (self.converged | self.nearly_converged) & (other.converged | other.nearly_converged)
        worst = jnp.maximum(self.residual, other.residual)
        return replace(both, residual=worst, converged=converged, nearly_converged=usable & ~converged)


def no_solve(dtype: Any) -> SolveInfo:
    """The report of an update without a solve."""
    return SolveInfo(residual=jnp.zeros((), dtype), report=jnp.zeros((), dtype))


class AbstractInnerProductSolver(lx.AbstractLinearSolver[Any]):
    """A symmetric solver that takes an inner product itself.

    `init` is given an `ImplicitOperator`, `compute` the option `inner_product`, an `AbstractInnerProduct`. Its result
    is successful if it converged. Its statistics are `num_steps`, `residual`, `nearly_converged` and `indefinite` (see
    `SolveInfo`), and `spectral_radius`, a lower estimate of ‖W⁻¹A‖.
    """


@partial(Mark, "with an atol above zero")
def require_solver(name: str, solver: lx.AbstractLinearSolver) -> None:
    """Check a linear solver: a ValueError if it has an absolute tolerance that is not above zero."""
    if (atol := getattr(solver, "atol", None)) is not None:
        require_that(
            f"{name} must have an atol above zero, as it compares residuals component by component and those of empty "
            "nodes are zero (right-hand sides are scaled to norm one, so that it may be as large as rtol)",
            lambda a: a > 0,
            atol,
        )
