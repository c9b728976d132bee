"""What derivatives of whole rollouts are verified on: small scenes as functions of all their floats at once, and three
measures of how far J and Jᵀ are from the truth. One compiled program a case serves all three."""

import functools
import operator
from typing import Any, NamedTuple
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from helpers import DESCRIPTIONS, ELASTIC, FLUIDS, PLASTIC, RUBBER, VISCOUS, block

import mpmjax as mpm
from mpmjax.boundary._contact import ConstrainedNodes
from mpmjax.state import state_of, with_state
from mpmjax.stepping import _step

TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-14)  # that is, down to rounding: central differences see every digit
UPDATES = {
    "explicit": mpm.Explicit(),
    "semi_implicit": mpm.SemiImplicit(beta=0.8, solver=TIGHT, adjoint_solver=TIGHT),
    "backward_euler": mpm.BackwardEuler(mpm.implicit.Newton(TIGHT, 1e-14), adjoint_solver=TIGHT),
    "implicit_midpoint": mpm.ImplicitMidpoint(mpm.implicit.Newton(TIGHT, rtol=1e-14), adjoint_solver=TIGHT),
    "trbdf2": mpm.TRBDF2(0.2, mpm.implicit.Linearised(TIGHT), adjoint_solver=TIGHT),
    "trbdf2_newton": mpm.TRBDF2(0.2, mpm.implicit.Newton(TIGHT, rtol=1e-14), adjoint_solver=TIGHT),
}
DX, DT, STEPS = 0.1, 1e-2, 20
ALL_LAWS = ELASTIC | RUBBER | PLASTIC | FLUIDS | VISCOUS
KINKED = (*PLASTIC, "fluid")
"""Laws whose return map does something."""


class Case(NamedTuple):
    """What a rollout's derivative may depend on: the names of an update, a law and a description, the dimension."""

    update: str
    law: str
    description: str
    d: int
    contact: bool = False
    """Whether the block slides on a floor that it may leave, instead of being held."""

    def __str__(self) -> str:
        return "-".join((self.update, self.law, self.description, f"{self.d}d")) + "-contact" * self.contact


def parameters(case: Case) -> dict[str, Any]:
    """All floats that a rollout of a small block, from rest in F, is differentiated in: the law's (the first of them
    one value a particle), places, velocities, gravity, the motion of the grip or the friction of the floor, β or ρ∞."""
    d = case.d
    rng = np.random.default_rng(1)
    box, grid = mpm.Box((0.0,) * d, (0.2,) * d), mpm.Grid((8,) * d, DX)
    x = mpm.fill(box, grid, particles_per_cell=2**d, density=1e3).x
    first, *others = jax.tree.leaves(ALL_LAWS[case.law])
    law = [first * rng.uniform(0.8, 1.2, len(x)), *others]
    q = {
        "law": [jnp.asarray(a) for a in law],
        "x": x + 0.004,
        "v": jnp.asarray(0.3 * rng.normal(size=x.shape)),
        "gravity": jnp.asarray([1.0, -4.0, 3.0][:d]),
    }
    if case.contact:
        q["v"] = q["v"] + jnp.asarray([1.0, -0.8, 0.3][:d])
        q["friction"] = jnp.asarray(0.2)
    else:
        q["displacement"] = jnp.asarray([[0.0] * d, [0.4, 0.3, 0.2][:d]])
    if case.update == "semi_implicit":
        q["beta"] = jnp.asarray(0.8)
    if case.update.startswith("trbdf2"):
        q["rho"] = jnp.asarray(0.2)
    return q


UNIT = {"x": 0.03, "v": 0.3, "gravity": 3.0, "displacement": 0.4, "friction": 0.2, "beta": 0.5, "rho": 0.2}


def direction(q: dict[str, Any], seed: int = 5, only: str | None = None) -> dict[str, Any]:
    """A random direction, in the size of each parameter; with `only`, zero but in one of them."""
    rng = np.random.default_rng(seed)

    def random(name: str, a: Any) -> Any:
        size = UNIT.get(name, 0.0) or jnp.abs(a).max()
        return jnp.asarray(size * rng.normal(size=a.shape) if only in (None, name) else np.zeros(a.shape))

    return {name: jax.tree.map(functools.partial(random, name), a) for name, a in q.items()}


def model(q: dict[str, Any], case: Case) -> tuple[mpm.Scene, mpm.Particles, Any]:
    """Scene, particles and method of the parameters.

    Held: the right of the block by a grip that moves, its left by a plane of symmetry. In contact: thrown along a floor
    that it may leave.
    """
    d = case.d
    law = jax.tree.unflatten(jax.tree.structure(ALL_LAWS[case.law]), q["law"])
    if case.contact:
        lower = (-np.inf,) * (d - 1) + (0.0,)
        boundary = (mpm.SeparatingBox(lower, (np.inf,) * d, friction=q["friction"]),)
    else:
        # its left edge passes no node in the time, nor would it in a direction's: the nodes it holds are a branch too
        right = mpm.Box((0.11, *(-1.0,) * (d - 1)), (1.0,) * d)
        boundary = (mpm.SymmetryPlane(0, 0.0), mpm.Grip(right, mpm.Motion((0.0, 1.0), q["displacement"])))
    scene = mpm.Scene(
        mpm.Grid((9,) * d, DX, origin=(-3,) * d),
        law,
        gravity=q["gravity"],
        boundary=boundary,
        description=DESCRIPTIONS[case.description],
    )
    one = jnp.ones(len(q["x"]))
    particles = mpm.Particles(q["x"], q["v"], 1e3 * (DX / 2) ** d * one, (DX / 2) ** d * one)
    method = UPDATES[case.update]
    for name in ("beta", "rho"):
        if name in q:
            method = eqx.tree_at(operator.attrgetter(name), method, q[name])
    return scene, particles, method


def outcome(particles: mpm.Particles) -> jax.Array:
    """The final state as one vector, every part of it of order one."""
    scaled = particles.x / 0.1, particles.v, particles.F, particles.C / 10, particles.history
    return jnp.concatenate([a.reshape(-1) for a in jax.tree.leaves(scaled)])


def rolled(q: dict[str, Any], case: Case, steps: int = STEPS) -> tuple[jax.Array, Any]:
    """The outcome by the plain rollout, and the branches taken: of each step, the wall's components that hold, those
    that friction stops, and the particles that yield."""
    scene, particles, method = model(q, case)
    if not case.contact and case.law not in KINKED:
        return outcome(mpm.rollout(scene, particles, steps=steps, dt=DT, method=method)), ()
    particles = mpm.prepare(scene, particles)
    seen = []

    def spy(held: Any, v: Any, momentum_residual: Any) -> Any:
        after = friction(held, v, momentum_residual)
        seen.append((jnp.concatenate([part.ravel() for part in held.active]), (v != 0) & (after[0] == 0)))
        return after

    def body(state: Any, n: Any) -> Any:
        new, _ = _step.step_unchecked(scene, with_state(particles, state), n * DT, jnp.asarray(DT), method)
        # what a return map changes is seen in the history, beyond the rounding of what a grip carries on its yield
        # condition, or where there is none in J = 1
        grown = jax.tree.map(lambda a, b: jnp.abs(a - b) > 1e-12, new.history, state.history)
        yielded = grown if case.law in PLASTIC else [new.F == 1] * (case.law in KINKED)
        return state_of(new), jax.tree.leaves((seen.pop() if seen else (), yielded))

    friction = ConstrainedNodes.friction
    with mock.patch.object(ConstrainedNodes, "friction", spy):
        final, branches = jax.lax.scan(body, state_of(particles), jnp.arange(float(steps)))
    return outcome(with_state(particles, final)), branches


def quickly_compiled(f: Any) -> Any:
    """`jax.jit` that spends a third less on optimising: that is most of these tests' time and changes no derivative."""
    return jax.jit(f, compiler_options={"xla_backend_optimization_level": 0})


class Derivatives(NamedTuple):
    """A rollout and its derivative at some parameters."""

    y: jax.Array
    """The outcome."""
    pushed: jax.Array
    """J t, in forward mode."""
    pulled: dict[str, Any]
    """Jᵀ u, in reverse mode."""
    branches: Any
    """See `rolled`."""


@functools.cache
def linearised(case: Case) -> Any:
    """The compiled function (q, t, u) → `Derivatives`."""

    def evaluate(q: Any, t: Any, u: Any) -> Derivatives:
        f = functools.partial(rolled, case=case)
        y, pushed, branches = jax.jvp(f, (q,), (t,), has_aux=True)
        pulled = jax.vjp(f, q, has_aux=True)[1](u)[0]
        return Derivatives(y, pushed, pulled, branches)

    return quickly_compiled(evaluate)


@functools.cache
def cotangent(case: Case) -> np.ndarray:
    """A random u."""
    size = jax.eval_shape(lambda q: rolled(q, case, 1)[0], parameters(case)).shape
    return np.random.default_rng(2).normal(size=size)


def along(q: Any, h: float, t: Any) -> Any:
    """q + h t."""
    return jax.tree.map(lambda a, b: a + h * b, q, t)


def inner(a: Any, b: Any) -> float:
    """⟨a, b⟩ over a pytree."""
    return float(sum(jax.tree.leaves(jax.tree.map(lambda x, y: (x * y).sum(), a, b))))


def norm(a: Any) -> float:
    """√⟨a, a⟩."""
    return inner(a, a) ** 0.5


def same_branches(case: Case, q: Any, t: Any, hs: tuple[float, ...]) -> bool:
    """Whether every step takes the same branches at q and at all q + h t."""
    u = cotangent(case)
    here = linearised(case)(q, t, u).branches
    there = [linearised(case)(along(q, h, t), t, u).branches for h in hs]
    return all(bool((a == b).all()) for other in there for a, b in zip(here, other, strict=True))


TAYLOR = (1e-2, 1e-3, 1e-4, 1e-5)


def taylor_slope(case: Case, q: Any, t: Any, hs: tuple[float, ...] = TAYLOR) -> float:
    """The order in h of ‖y(q + h t) − y(q) − h J t‖, fitted over the given h: 2 if and only if J t is right."""
    evaluate, u = linearised(case), cotangent(case)
    here = evaluate(q, t, u)
    remainders = [norm(evaluate(along(q, h, t), t, u).y - here.y - h * here.pushed) for h in hs]
    return float(np.polyfit(np.log(hs), np.log(remainders), 1)[0])


def transpose_error(case: Case, q: Any, t: Any) -> float:
    """|⟨u, J t⟩ / ⟨Jᵀ u, t⟩ − 1|."""
    u = cotangent(case)
    here = linearised(case)(q, t, u)
    return abs(inner(u, here.pushed) / inner(here.pulled, t) - 1)


def difference_error(case: Case, q: Any, t: Any, h: float = 1e-5) -> float:
    """‖(y(q + h t) − y(q − h t)) / 2h − J t‖ / ‖J t‖."""
    evaluate, u = linearised(case), cotangent(case)
    exact = evaluate(q, t, u).pushed
    difference = (evaluate(along(q, h, t), t, u).y - evaluate(along(q, -h, t), t, u).y) / (2 * h)
    return norm(difference - exact) / norm(exact)


TOLERANCES = tuple(10.0**-k for k in range(1, 13))


@functools.cache
def tolerance_sweep(update: str) -> dict[str, np.ndarray]:
    """Relative error of a gradient at each of `TOLERANCES`, against the same solved down to rounding.

    Under "both", "forward" and "adjoint": with that tolerance in the solver and in the adjoint solver, or in one of
    them alone and the other tight. Five steps of 1.8 dx/c of a block that is pulled and falls; the gradient is that of
    a random function of the final positions by a modulus for each particle and all the initial velocities.
    """
    scene, particles = block(2, gravity=(0.0, -3.0))
    motion = mpm.Motion((0.0, 1.0), ((0.0, 0.0), (-0.4, 0.1)))
    scene = eqx.tree_at(lambda s: s.boundary, scene, (mpm.Grip(mpm.Box((-1.0, -1.0), (0.05, 1.0)), motion),))
    rng = np.random.default_rng(0)
    weights = rng.normal(size=particles.x.shape)
    modulus = jnp.asarray(1e4 * rng.uniform(0.8, 1.2, particles.count))
    v = jnp.asarray(0.3 * rng.normal(size=particles.x.shape))

    @quickly_compiled
    def gradient(forward: Any, adjoint: Any) -> Any:
        def value(modulus: Any, v: Any) -> Any:
            softer = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, modulus)
            thrown = eqx.tree_at(lambda p: p.v, particles, v)
            solver, adjoint_solver = (
                mpm.implicit.ConjugateResidual(rtol=forward),
                mpm.implicit.ConjugateResidual(rtol=adjoint),
            )
            if update == "semi_implicit":
                method = mpm.SemiImplicit(solver=solver, adjoint_solver=adjoint_solver)
            else:
                method = mpm.BackwardEuler(mpm.implicit.Newton(rtol=forward), adjoint_solver=adjoint_solver)
            return (weights * mpm.rollout(softer, thrown, steps=5, dt=5e-2, method=method).x).sum()

        return jax.grad(value, argnums=(0, 1))(modulus, v)

    tight = 1e-14
    exact = gradient(tight, tight)

    def error(forward: float, adjoint: float) -> float:
        parts = zip(gradient(forward, adjoint), exact, strict=True)
        return max(norm(found - true) / norm(true) for found, true in parts)

    return {
        "both": np.array([error(t, t) for t in TOLERANCES]),
        "forward": np.array([error(t, tight) for t in TOLERANCES]),
        "adjoint": np.array([error(tight, t) for t in TOLERANCES]),
    }
