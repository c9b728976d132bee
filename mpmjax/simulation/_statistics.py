"""Statistics of a run's steps."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Int
from mpmjax.stepping import StepInfo

HEALTHY, NOT_FINITE, OUTSIDE, INADMISSIBLE, BEYOND = 0, 1, 2, 3, 4
"""The faults of a state."""


BAD_PARAMETERS = 100
"""From here on: a value of scene, particles or method that its module does not allow, by its number among their
`requirements`."""


class RunStatistics(eqx.Module):
    """Sums over the steps of a run."""

    steps: Int[Array, "*f"]
    """Steps taken."""
    iterations: Int[Array, "*f"]
    """Conjugate-residual iterations."""
    most_iterations: Int[Array, "*f"]
    """Largest number of iterations in one step."""
    newton: Int[Array, "*f"]
    """Newton steps."""
    line_search: Int[Array, "*f"]
    """Halvings by the line search."""
    worst_residual: Float[Array, "*f"]
    """Largest relative residual at the end of a solve."""
    unconverged: Int[Array, "*f"]
    """Steps whose solve met neither ten times its tolerance nor the precision's limit: the run is not a solution."""
    nearly_converged: Int[Array, "*f"]
    """Steps whose solve missed its tolerance, by less than ten times: the run is less accurate than was asked for."""
    indefinite: Int[Array, "*f"]
    """Steps whose solve met negative curvature: compression has made M + cH indefinite, and near a singular one the
    motion is wrong however small the residual. `AnalyticHessian(projected=True)` or a smaller step avoids it."""
    sweeps: Int[Array, "*f"]
    """Solves for contact beyond one a step."""
    violations: Int[Array, "*f"]
    """Contact conditions left violated, summed over steps."""
    fault: Int[Array, "*f"]
    """The first fault of a state: HEALTHY, NOT_FINITE, OUTSIDE, INADMISSIBLE or BEYOND; or BAD_PARAMETERS and what
    follows."""
    fault_step: Int[Array, "*f"]
    """Number of steps that led to it."""

    @property
    def healthy(self) -> Bool[Array, "*f"]:
        """Whether no state was at fault and no solve ended far from its tolerance."""
        return (self.fault == HEALTHY) & (self.unconverged == 0)

    def plus(self, info: StepInfo, fault: Int[Array, ""]) -> "RunStatistics":
        """The statistics after one more step."""
        s, c = info.solve, info.contact
        steps = self.steps + 1
        first = (self.fault == HEALTHY) & (fault != HEALTHY)
        return RunStatistics(
            steps=steps,
            iterations=self.iterations + s.iterations,
            most_iterations=jnp.maximum(self.most_iterations, s.iterations),
            newton=self.newton + s.newton,
            line_search=self.line_search + s.line_search,
            worst_residual=jnp.maximum(self.worst_residual, jax.lax.stop_gradient(s.residual)),
            unconverged=self.unconverged + jnp.where(s.converged | s.nearly_converged, 0, 1).astype(jnp.int32),
            nearly_converged=self.nearly_converged + s.nearly_converged.astype(jnp.int32),
            indefinite=self.indefinite + s.indefinite.astype(jnp.int32),
            sweeps=self.sweeps + c.sweeps,
            violations=self.violations + c.violations,
            fault=jnp.where(first, fault, self.fault),
            fault_step=jnp.where(first, steps, self.fault_step),
        )

    def merged(self, later: "RunStatistics") -> "RunStatistics":
        """These statistics and those of the steps that followed."""
        healthy = self.fault == HEALTHY
        return RunStatistics(
            steps=self.steps + later.steps,
            iterations=self.iterations + later.iterations,
            most_iterations=jnp.maximum(self.most_iterations, later.most_iterations),
            newton=self.newton + later.newton,
            line_search=self.line_search + later.line_search,
            worst_residual=jnp.maximum(self.worst_residual, later.worst_residual),
            unconverged=self.unconverged + later.unconverged,
            nearly_converged=self.nearly_converged + later.nearly_converged,
            indefinite=self.indefinite + later.indefinite,
            sweeps=self.sweeps + later.sweeps,
            violations=self.violations + later.violations,
            fault=jnp.where(healthy, later.fault, self.fault),
            fault_step=jnp.where(healthy & (later.fault != HEALTHY), self.steps + later.fault_step, self.fault_step),
        )


def no_steps(dtype: Any) -> RunStatistics:
    """The statistics before the first step."""
    zero = jnp.asarray(0, dtype=jnp.int32)
    residual = jnp.asarray(0, dtype=dtype)
    return RunStatistics(zero, zero, zero, zero, zero, residual, zero, zero, zero, zero, zero, zero, zero)
