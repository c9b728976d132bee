"""The outcome of a simulation, the statistics of its steps, and its faults."""

import enum
from dataclasses import fields, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Float, Int, Scalar
from mpmjax.boundary import Impulses
from mpmjax.checks import require
from mpmjax.state import Particles, Scene, State, with_state
from mpmjax.stepping import AbstractIntegrator, StepInfo


class Fault(enum.IntEnum):
    """A fault of a state or a step. A member may be compared with a traced whole number."""

    NONE = 0
    NOT_FINITE = 1  # a number of a particle is infinite or NaN
    OUTSIDE = 2  # a particle's stencil has left the grid's window
    INADMISSIBLE = 3  # a law does not allow a particle's deformation gradient
    PASSED = 4  # a particle has passed a boundary that keeps it out
    BAD_PARAMETERS = 5
    """Scene, particles or method have a value that their module does not allow, which a jax transformation hid."""
    COLLAPSED = 6  # a particle has collapsed: a stretch of it is below a hundredth


class RunStatistics(eqx.Module):
    """Sums over the steps of a run."""

    steps: Int[Array, "*f"]  # steps taken
    iterations: Int[Array, "*f"]  # iterations of the linear solver
    most_iterations: Int[Array, "*f"]  # largest number of iterations in one step
    newton: Int[Array, "*f"]  # Newton steps
    line_search: Int[Array, "*f"]  # halvings by the line search
    worst_residual: Float[Array, "*f"]  # largest relative residual at the end of a solve
    force_error: Float[Array, "*f"]  # largest error of a step's elastic force [N] (see `StepInfo.force_error`)
    force_scale: Float[Array, "*f"]  # largest scale of these forces [N]
    unconverged: Int[Array, "*f"]
    """Steps whose solve met neither ten times its tolerance nor the precision's limit: the run is not a solution."""
    nearly_converged: Int[Array, "*f"]
    """Steps whose solve missed its tolerance, by less than ten times: the run is less accurate than was asked for."""
    indefinite: Int[Array, "*f"]
    """Steps whose solve met negative curvature: compression has made M + χH indefinite, and near a singular one the
    motion is wrong however small the residual. `AnalyticHessian(projected=True)` or a smaller step avoids it."""
    sweeps: Int[Array, "*f"]  # solves for contact beyond one a step
    violations: Int[Array, "*f"]  # contact conditions left violated, summed over steps
    fault: Int[Array, "*f"]  # the first `Fault`
    fault_step: Int[Array, "*f"]  # number of steps that led to it
    unmet: Int[Array, "*f"]
    """With BAD_PARAMETERS the number, from one, of the first of the `requirements` that is not met; else zero."""

    @property
    @eqx.filter_jit
    def linearisation_error(self) -> Float[Array, "*f"]:
        """Error of the elastic force by the linearisation of implicit steps and by the return maps after them [-]: the
        largest of any step over the largest scale of any, so that quiet steps do not count."""
        return self.force_error / jnp.where(self.force_scale == 0, 1, self.force_scale)

    @property
    def healthy(self) -> Bool[Array, "*f"]:
        """Whether no state was at fault and no solve ended far from its tolerance."""
        return (self.fault == Fault.NONE) & (self.unconverged == 0)

    def merged(self, later: "RunStatistics", *, solved: bool = True) -> "RunStatistics":
        """These statistics and those of the steps that followed. Of steps that solve nothing the largest numbers of
        solves stay as they are, which XLA does not see of a maximum with zero."""
        first, both = self.fault == Fault.NONE, {}
        for name in (field.name for field in fields(self)):
            a, b = getattr(self, name), getattr(later, name)
            both[name] = a + b if name not in _LARGEST else jnp.maximum(a, b) if solved else a
        meets = first & (later.fault != Fault.NONE)
        both["fault"] = jnp.where(first, later.fault, self.fault)
        both["fault_step"] = jnp.where(meets, self.steps + later.fault_step, self.fault_step)
        both["unmet"] = jnp.where(first, later.unmet, self.unmet)
        return RunStatistics(**both)


_LARGEST = ("most_iterations", "worst_residual", "force_error", "force_scale")
"""Numbers of which a run has the largest; it has the sum of the others."""


def no_steps(dtype: Any) -> RunStatistics:
    """The statistics before the first step."""
    zero, real = jnp.asarray(0, jnp.int32), ("worst_residual", "force_error", "force_scale")
    return RunStatistics(**{f.name: jnp.asarray(0, dtype) if f.name in real else zero for f in fields(RunStatistics)})


def one_step(info: StepInfo, fault: Int[Array, ""]) -> RunStatistics:
    """The statistics of one step, from what it reports and the fault of the state after it."""
    solve, one = info.solve, jnp.asarray(1, jnp.int32)
    return replace(
        no_steps(info.force_error.dtype),
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
        sweeps=info.contact.sweeps,
        violations=info.contact.violations,
        fault=fault,
        fault_step=one,
    )


class SimulationError(RuntimeError):
    """A run that went wrong on the way. `run` holds what was reached, its `final` the last good state."""

    def __init__(self, message: str, run: "Run"):
        super().__init__(message)
        self.run = run


class Forces(NamedTuple):
    """Mean forces and torques on k colliders or boundaries between one saved frame and the next, of f frames."""

    times: Float[Array, "g"]
    """The mean of the times of the steps' forces [s], shape (f − 1,): t_n + θΔt, with θ the method's `force_at`. It is
    half way between frames with θ = ½ (`ImplicitMidpoint`, `TRBDF2`, `SemiImplicit` with β = ½), ½Δt later with θ = 1
    (`BackwardEuler`, `SemiImplicit` with β = 1), and ½Δt earlier with θ = 0 (`Explicit`)."""
    force: Float[Array, "g k d"]  # friction included [N], shape (f − 1, k, d)
    torque: Float[Array, "g k r"]
    """About the centre of the collider's rotation, or where it has none about its shape's middle, as it moves [N m],
    shape (f − 1, k, r): r = 1 in 2-D, 3 in 3-D, 0 in 1-D. Of a grip about its region's middle, of other boundaries
    about the origin of the coordinates."""


class Run(eqx.Module):
    """A simulation's outcome. A pytree: it can be returned from `jax.jit`, `jax.vmap` and differentiated.

    Attributes:
        scene: the scene, with numbers as arrays of the particles' precision.
        method: the integrator, likewise.
        dt: Δt [s].
        steps: step number of each saved frame, shape (f,).
        frames: the saved states, with a leading axis f; None where nothing or only observations were saved.
        observed: the result of `observe` for each frame, with a leading axis f.
        final: the particles at the end.
        final_step: step number at the end.
        statistics: solver and contact statistics, and the first fault.
        report: zero. Its tangent in forward mode is the relative residual of the first tangent solve that did not
            converge, zero if all did. None of a run from a file.
        collider_impulse: linear and angular impulse on the scene's colliders from the run's start to each saved frame,
            with a leading axis f; None without colliders, or where nothing was saved. The difference between two
            frames, over the time between them, is the mean force and torque of these steps (see `forces`, which says
            at what time).
        final_collider_impulse: that on the colliders to the end; None without colliders.
        boundary_impulse: as `collider_impulse`, on each of the scene's boundaries (see `boundary_forces`); None unless
            the scene has `boundary_forces`, or where nothing was saved.
        final_boundary_impulse: that on the boundaries to the end; None unless the scene has `boundary_forces`.
        memory: the memory of the run's control at each saved frame, with a leading axis f; of a run from a file its
            arrays.
        final_memory: the memory of the control at the end, with which another run goes on.
    """

    scene: Scene
    method: AbstractIntegrator
    dt: Scalar
    steps: Float[Array, "*f"]
    frames: State | None
    observed: Any
    final: Particles
    final_step: Float[Array, ""]
    statistics: RunStatistics
    report: Float[Array, "..."] | None = None
    collider_impulse: Impulses | None = None
    final_collider_impulse: Impulses | None = None
    boundary_impulse: Impulses | None = None
    final_boundary_impulse: Impulses | None = None
    memory: Any = None
    final_memory: Any = None

    @property
    def times(self) -> Float[Array, "*f"]:
        """Time of each saved frame [s], shape (f,)."""
        return self.steps * self.dt

    def frame(self, i: int) -> Particles:
        """The particles at the i-th saved frame, negative from the end.

        Raises:
            ValueError: no frames were saved.
            IndexError: there is no such frame.
        """
        if self.frames is None:
            raise ValueError("This run saved no frames: pass save_every to simulate.")
        if not -len(self) <= i < len(self):
            raise IndexError(f"The run has {len(self)} frames, there is no frame {i}.")
        return with_state(self.final, _row(self.frames, i % len(self)))

    def forces(self) -> Forces:
        """The mean force and torque on each collider over the steps between one saved frame and the next; a ValueError
        if nothing was saved on the way, or the scene has no collider."""
        need = "Forces need saved frames and colliders: pass save_every to simulate, a collider to Scene."
        require(self.collider_impulse is not None, need)
        return self._mean_forces(self.collider_impulse)

    def boundary_forces(self) -> Forces:
        """The mean force and torque of the material on each of the scene's boundaries (walls, planes, grips and
        colliders, in their order) and then on the guides of each `Rigid` body that has some, over the steps between one
        saved frame and the next; a ValueError if nothing was saved, or the scene does not have `boundary_forces`."""
        require(
            self.boundary_impulse is not None,
            "Forces on boundaries need saved frames and a scene that computes them: pass save_every to simulate, "
            "boundary_forces=True to Scene.",
        )
        return self._mean_forces(self.boundary_impulse)

    @eqx.filter_jit
    def _mean_forces(self, impulses: Impulses | None) -> Forces:
        times, at = self.times, self.method.force_at()
        between = (times[1:] - times[:-1])[:, None, None]
        mean = jax.tree.map(lambda a: (a[1:] - a[:-1]) / between, impulses)
        late = (0.0 if at is None else at) - 0.5
        return Forces((times[1:] + times[:-1]) / 2 + late * self.dt, mean.impulse, mean.angular)

    def __len__(self) -> int:
        return 0 if self.frames is None else int(np.shape(self.steps)[0])


@jax.jit
def _row(frames: State, i: Int[Array, ""]) -> State:
    return jax.tree.map(lambda a: a[i], frames)
