"""Statistics of a run's steps."""

import enum
from dataclasses import fields, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Int
from mpmjax.stepping import StepInfo


class Fault(enum.IntEnum):
    """A fault of a state or a step. A member may be compared with a traced whole number."""

    NONE = 0
    NOT_FINITE = 1
    """A number of a particle is infinite or NaN."""
    OUTSIDE = 2
    """A particle's stencil has left the grid's window."""
    INADMISSIBLE = 3
    """A law does not allow a particle's deformation gradient."""
    PASSED = 4
    """A particle has passed a boundary that keeps it out."""
    BAD_PARAMETERS = 5
    """Scene, particles or method have a value that their module does not allow, which a jax transformation hid."""
    COLLAPSED = 6
    """A particle has collapsed: a stretch of it is below a hundredth."""


class RunStatistics(eqx.Module):
    """Sums over the steps of a run."""

    steps: Int[Array, "*f"]
    """Steps taken."""
    iterations: Int[Array, "*f"]
    """Iterations of the linear solver."""
    most_iterations: Int[Array, "*f"]
    """Largest number of iterations in one step."""
    newton: Int[Array, "*f"]
    """Newton steps."""
    line_search: Int[Array, "*f"]
    """Halvings by the line search."""
    worst_residual: Float[Array, "*f"]
    """Largest relative residual at the end of a solve."""
    force_error: Float[Array, "*f"]
    """Largest error of a step's elastic force [N] (see `StepInfo.force_error`)."""
    force_scale: Float[Array, "*f"]
    """Largest scale of these forces [N]."""
    unconverged: Int[Array, "*f"]
    """Steps whose solve met neither ten times its tolerance nor the precision's limit: the run is not a solution."""
    nearly_converged: Int[Array, "*f"]
    """Steps whose solve missed its tolerance, by less than ten times: the run is less accurate than was asked for."""
    indefinite: Int[Array, "*f"]
    """Steps whose solve met negative curvature: compression has made M + χH indefinite, and near a singular one the
    motion is wrong however small the residual. `AnalyticHessian(projected=True)` or a smaller step avoids it."""
    sweeps: Int[Array, "*f"]
    """Solves for contact beyond one a step."""
    violations: Int[Array, "*f"]
    """Contact conditions left violated, summed over steps."""
    fault: Int[Array, "*f"]
    """The first `Fault`."""
    fault_step: Int[Array, "*f"]
    """Number of steps that led to it."""
    unmet: Int[Array, "*f"]
    """With BAD_PARAMETERS the number, from one, of the first of the `requirements` on scene, particles and method that
    is not met; else zero."""

    @property
    def linearisation_error(self) -> Float[Array, "*f"]:
        """Error of the elastic force by the linearisation of implicit steps and by the return maps after them [-]: the
        largest of any step over the largest scale of any, so that quiet steps do not count."""
        return self.force_error / jnp.where(self.force_scale == 0, 1, self.force_scale)

    @property
    def healthy(self) -> Bool[Array, "*f"]:
        """Whether no state was at fault and no solve ended far from its tolerance."""
        return (self.fault == Fault.NONE) & (self.unconverged == 0)

    def merged(self, later: "RunStatistics") -> "RunStatistics":
        """These statistics and those of the steps that followed."""
        first = self.fault == Fault.NONE
        return RunStatistics(
            steps=self.steps + later.steps,
            iterations=self.iterations + later.iterations,
            most_iterations=jnp.maximum(self.most_iterations, later.most_iterations),
            newton=self.newton + later.newton,
            line_search=self.line_search + later.line_search,
            worst_residual=jnp.maximum(self.worst_residual, later.worst_residual),
            force_error=jnp.maximum(self.force_error, later.force_error),
            force_scale=jnp.maximum(self.force_scale, later.force_scale),
            unconverged=self.unconverged + later.unconverged,
            nearly_converged=self.nearly_converged + later.nearly_converged,
            indefinite=self.indefinite + later.indefinite,
            sweeps=self.sweeps + later.sweeps,
            violations=self.violations + later.violations,
            fault=jnp.where(first, later.fault, self.fault),
            fault_step=jnp.where(first & (later.fault != Fault.NONE), self.steps + later.fault_step, self.fault_step),
            unmet=jnp.where(first, later.unmet, self.unmet),
        )

    def after_step(self, step: "RunStatistics", *, solved: bool) -> "RunStatistics":
        """These statistics and those of one more step. Of a step that solves nothing the largest numbers of solves stay
        as they are, which XLA does not see of a maximum with zero."""
        new = self.merged(step)
        if solved:
            return new
        of_solves = ("most_iterations", "worst_residual", "force_error", "force_scale")
        return replace(new, **{name: getattr(self, name) for name in of_solves})


def no_steps(dtype: Any) -> RunStatistics:
    """The statistics before the first step."""
    zero = jnp.asarray(0, jnp.int32)
    zeros = {field.name: zero for field in fields(RunStatistics)}
    nothing = dict.fromkeys(("worst_residual", "force_error", "force_scale"), jnp.asarray(0, dtype))
    return RunStatistics(**zeros | nothing)


def one_step(info: StepInfo, fault: Int[Array, ""]) -> RunStatistics:
    """The statistics of one step, from what it reports and the fault of the state after it."""
    solve, contact = info.solve, info.contact
    zero, one = jnp.asarray(0, jnp.int32), jnp.asarray(1, jnp.int32)
    return RunStatistics(
        steps=one,
        iterations=solve.iterations,
        most_iterations=solve.iterations,
        newton=solve.newton,
        line_search=solve.line_search,
        worst_residual=jax.lax.stop_gradient(solve.residual),
        force_error=info.force_error,
        force_scale=info.force_scale,
        unconverged=(~(solve.converged | solve.nearly_converged)).astype(jnp.int32),
        nearly_converged=solve.nearly_converged.astype(jnp.int32),
        indefinite=solve.indefinite.astype(jnp.int32),
        sweeps=contact.sweeps,
        violations=contact.violations,
        fault=fault,
        fault_step=one,
        unmet=zero,
    )
