"""docs/parity.md says what works with what: each cell of it is asked for here."""

import warnings
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DESCRIPTIONS, ELASTIC, PLASTIC, RUBBER, VISCOUS, assert_close
from test_learned_law import perceptron

import mpmjax as mpm
from mpmjax.checks import canonical

PAGE = (Path(__file__).parents[1] / "docs/parity.md").read_text(encoding="utf-8")
ROWS = [[cell.strip() for cell in line.split("|")[1:-1]] for line in PAGE.splitlines() if line.startswith("| ")]
PARITY = {row[0]: dict(zip(DESCRIPTIONS, row[1:], strict=True)) for row in ROWS[1:]}

WINDOW = {"shape": (12, 12), "spacing": 0.1, "origin": (-3, -3)}
GRID, LAW = mpm.Grid(**WINDOW), mpm.NeoHookean(1e4, 0.3)
LIFT = 2e-3  # of the body above floors, which it reaches in the run: the derivative at a gap of zero has two sides
BODY, ON_TOP = mpm.Box((0.0, LIFT), (0.3, 0.2 + LIFT)), mpm.Box((0.0, 0.195), (0.3, 0.395))
LOW, HIGH = (-np.inf, 0.0), (np.inf, np.inf)
FLOOR, ASKEW = mpm.HalfSpace((0.0, 0.0), (0.0, 1.0)), mpm.HalfSpace((0.0, 0.0), (0.1, 1.0))
FOOT = mpm.Box((-1.0, -1.0), (1.0, 0.05))
MOVED = mpm.Motion((0.0, 1.0), ((0.0, 0.0), (0.3, -0.4)))
TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-13)
NEWTON = mpm.implicit.Newton(TIGHT, 1e-13)


def swung(scene, particles, t, dt, memory):
    """A control: gravity by how far the body has come."""
    gravity = jnp.stack([memory, -9 + particles.x[:, 1].mean()])
    return eqx.tree_at(lambda s: s.gravity, scene, gravity), particles, memory + dt * particles.v.sum()


def pulled(scene, particles, t, dt, memory):
    """A control: a muscle that contracts."""
    activation = 30 * (t + dt) * jnp.ones_like(particles.mass)
    return scene, eqx.tree_at(lambda q: q.history.activation, particles, activation), memory


def stream() -> dict[str, Any]:
    """The body enters through a gate, and leaves."""
    inlet = mpm.extensions.Inlet(
        mpm.fill(BODY, GRID, density=1e3), (7.0, 0.0), gate=mpm.HalfSpace((0.201, 0.0), (1.0, 0.0)), length=0.1
    )
    drain = mpm.extensions.Outlet(mpm.HalfSpace((0.26, 0.0), (-1.0, 0.0)))
    return {"control": mpm.extensions.Controls((inlet, drain)), "particles": inlet.particles()}


SCENES: dict[str, dict[str, dict[str, Any]]] = {
    "`Explicit`": {
        "explicit": {},
        "semi-implicit": {"method": mpm.SemiImplicit(0.8, TIGHT, adjoint_solver=TIGHT)},
        "backward Euler": {"method": mpm.BackwardEuler(NEWTON, adjoint_solver=TIGHT)},
        "midpoint": {"method": mpm.ImplicitMidpoint(NEWTON, adjoint_solver=TIGHT)},
        "TRBDF2": {"method": mpm.TRBDF2(0.2, mpm.implicit.Linearised(TIGHT), adjoint_solver=TIGHT)},
    },
    "kernels": {
        "linear": {"kernel": mpm.BSpline(1)},
        "cubic, spline's gradient": {"kernel": mpm.BSpline(3), "gradient": mpm.SplineGradient()},
        "FLIP": {"transfer": mpm.FLIP()},
        "PIC, moving least squares": {"transfer": mpm.PIC(), "gradient": mpm.MLSGradient()},
    },
    "`Hencky`": {name: {"material": law} for name, law in ELASTIC.items()},
    "rubber": {name: {"material": law} for name, law in RUBBER.items()},
    "`Snow`": {name: {"material": law} for name, law in PLASTIC.items()},
    "`Fluid`": {"fluid": {"material": mpm.Fluid(1e4, tension=True)}},
    "`Viscous`": {
        "viscous": {"material": VISCOUS["viscous_solid"]},
        "active": {"material": mpm.extensions.Active(LAW, 2e3, 0.3), "control": pulled},
        "network": {"material": perceptron()},
    },
    "`AveragedVolume`": {"averaged": {"volume": mpm.AveragedVolume()}},
    "axisymmetric": {"axisymmetric": {"grid": mpm.Grid(**WINDOW, axisymmetric=True)}},
    "`StickyBox`": {
        "slip box": {"boundary": mpm.SlipBox(LOW, HIGH)},
        "moving box": {"boundary": mpm.StickyBox(LOW, HIGH, MOVED)},
    },
    "`Grip`": {
        "symmetry plane": {"boundary": mpm.SymmetryPlane(1, 0.0)},
        "clamp": {"boundary": mpm.ClampPlane(1, 0.0)},
        "grip": {"boundary": mpm.Grip(FOOT, MOVED)},
    },
    "`ContactPlane`": {
        "contact plane": {"boundary": mpm.ContactPlane(1, 0.0, friction=0.2)},
        "separating box": {"boundary": mpm.SeparatingBox(LOW, HIGH, friction=0.2)},
    },
    "`StickyCollider`": {
        "sticky collider": {"boundary": mpm.StickyCollider(FLOOR)},
        "slip collider": {"boundary": mpm.SlipCollider(ASKEW, MOVED)},
    },
    "`SeparatingCollider`": {"separating collider": {"boundary": mpm.SeparatingCollider(ASKEW, friction=0.2)}},
    "`Bodies`": {
        "bodies": {"material": (LAW, LAW), "bodies": mpm.Bodies(0.2)},
        "rigid": {"material": mpm.Rigid(1e4), "boundary": mpm.SeparatingBox(LOW, HIGH)},
    },
    "`RigidPart`": {"rigid part": {"boundary": mpm.RigidPart(FOOT)}},
    "loads": {
        "loads": {
            "loads": (mpm.Traction(mpm.Patch(BODY), (1.0, 50.0)), mpm.Spring(mpm.PointsAt(((0.3, 0.2),)), 1e2, 1.0))
        }
    },
    "controls": {"control": {"control": swung, "memory": 0.1}},
    "enter": {"stream": stream()},
    "stress": {"stress": {"seen": lambda scene, particles: 1e-4 * mpm.stress(scene, particles)}},
}
"""Parts of scenes, by words of the rows of the page that they stand for."""


def rolled(parts: dict[str, Any], description: Any, dtype: Any) -> Any:
    """Four numbers, that change law, velocities, gravity and places, to places and velocities after some steps."""
    parts = {"grid": GRID, "material": LAW, "description": description} | parts
    method, control = parts.pop("method", mpm.Explicit()), (parts.pop("control", None), parts.pop("memory", None))
    particles = parts.pop("particles", None) or mpm.fill(BODY, parts["grid"], density=1e3)
    seen = parts.pop("seen", lambda _, particles: jnp.stack([10 * particles.x, particles.v]))
    if "bodies" in parts:
        particles = mpm.join(particles, mpm.fill(ON_TOP, parts["grid"], density=1e3))
    scene = mpm.Scene(gravity=(0.0, -9.81), **parts)
    wave = 0.8 * jnp.sin(9 * particles.x[:, ::-1]) - jnp.asarray([0.0, 0.5])
    moving = eqx.tree_at(lambda q: q.v, particles, wave + particles.v)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of bodies that overlap
        scene = mpm.attach(scene, moving)
        moving = mpm.prepare(scene, moving)
    singles = jax.tree.map(lambda a: a.astype(dtype) if eqx.is_inexact_array(a) else a, moving)
    scene, moving, method, control = canonical((scene, singles, method, control), dtype)

    def after(q):
        law, speed, gravity, place = q
        laws = jax.tree.map(lambda a: a * (1 + law) if eqx.is_inexact_array(a) else a, scene.material)
        pull = jax.tree.map(lambda a: a * (1 + gravity), scene.gravity)
        changed = eqx.tree_at(lambda s: (s.material, s.gravity), scene, (laws, pull))
        start = moving.v * (1 + speed), moving.x + 0.01 * place * moving.v
        start = eqx.tree_at(lambda p: (p.v, p.x), moving, start)
        end = mpm.rollout(changed, start, steps=4, dt=4e-3, method=method, control=control[0], memory=control[1])
        return seen(changed, end)

    return after


def cases() -> list:
    """Scenes and descriptions; what is refused, and explicit steps, by default."""
    rows = {words: cells for words in SCENES for row, cells in PARITY.items() if words in row}
    return [
        pytest.param(
            rows[words][name],
            parts,
            description,
            id=f"{scene}-{name}",
            marks=() if refused or scene == "explicit" else pytest.mark.thorough,
        )
        for words, scenes in SCENES.items()
        for scene, parts in scenes.items()
        for name, description in DESCRIPTIONS.items()
        for refused in [rows[words][name] == "–"]
    ]


def test_scenes_stand_for_every_row():
    assert all(sum(words in row for words in SCENES) == 1 for row in PARITY)


@pytest.mark.parametrize(("cell", "parts", "description"), cases())
def test_what_the_page_says(cell, parts, description):
    """Reverse mode, forward mode and differences agree, and single with double precision; or it is refused."""
    if cell == "–":
        with pytest.raises(ValueError, match=r"total description|updated (one|description)"):
            rolled(parts, description, float)(jnp.zeros(4))
        return
    after = rolled(parts, description, jnp.float64)

    def weighed(q):
        end = after(q)
        return (end * jnp.sin(jnp.arange(1.0, end.size + 1)).reshape(end.shape)).sum(), end

    along, zero, h = jnp.asarray([1.0, 0.7, -0.5, 0.3]), jnp.zeros(4), 1e-5

    @jax.jit
    def slopes(q):
        (value, end), grad = jax.value_and_grad(weighed, has_aux=True)(q)
        return value, end, grad @ along, jax.jvp(lambda q: weighed(q)[0], (q,), (along,))[1]

    _, end, reverse, forward = slopes(zero)
    difference = (slopes(h * along)[0] - slopes(-h * along)[0]) / (2 * h)
    assert_close(reverse, forward, 1e-11)
    assert_close(reverse, difference, 1e-6)
    single = jax.jit(rolled(parts, description, jnp.float32))(zero.astype(jnp.float32))
    assert single.dtype == jnp.float32
    assert_close(np.asarray(single, float), end, 1e-5)  # a hundred times its rounding: stresses are of small strains
