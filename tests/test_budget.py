"""Where energy and momentum go: every term on its own, and their sum closes to rounding."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    DESCRIPTIONS,
    FLUIDS,
    GRADIENTS,
    KERNELS,
    LAWS,
    METHODS,
    PLASTIC,
    SECOND_ORDER,
    TRANSFERS,
    VISCOUS,
    block,
    explicit_limit,
    ids,
    thorough,
)
from test_body_force import Wind

import mpmjax as mpm

STEPS = 4
MOVED = mpm.Motion((0.0, 1.0), ((0.0, 0.0), (0.3, 0.1)))
BOUNDARIES = {
    "free": (),
    "walls": (mpm.SlipBox((-np.inf, 0.0), (np.inf, np.inf)), mpm.StickyBox((-np.inf, -np.inf), (0.3, np.inf))),
    "contact": (mpm.SeparatingBox((-0.2, 0.0), (0.6, 0.6), friction=0.3),),
    "contact planes": (mpm.ContactPlane(1, 0.0, friction=0.3), mpm.ContactPlane(0, 0.0)),
    "planes": (mpm.SymmetryPlane(1, 0.0), mpm.SymmetryPlane(0, 0.0)),
    "grip": (mpm.Grip(mpm.Box((-1.0, -1.0), (1.0, 0.0)), MOVED),),
    "colliders": (
        mpm.SeparatingBox((-0.2, 0.0), (0.6, 0.6), friction=0.3),
        mpm.SeparatingCollider(mpm.Ball((0.1, -0.1), 0.24), MOVED, friction=0.3),
        mpm.SlipCollider(mpm.HalfSpace((0.25, 0.2), (-2.0, -1.0))),
        mpm.StickyCollider(mpm.geometry.Capsule((0.0, 0.3), (0.1, 0.3), 0.06), MOVED),
    ),
    "askew": (
        mpm.SeparatingCollider(mpm.HalfSpace((0.05, 0.0), (2.0, 1.0)), MOVED, friction=0.3),
        mpm.SeparatingCollider(mpm.Ball((0.1, -0.1), 0.24), friction=0.1),
    ),
    "collider and contact plane": (
        mpm.ContactPlane(1, 0.0, friction=0.3),
        mpm.SeparatingCollider(mpm.HalfSpace((0.05, 0.0), (2.0, 1.0)), friction=0.3),
    ),
}


def budget_of(*, number=0.3, method=METHODS["explicit"], steps=STEPS, speed=1.0, **scene):
    """The budget of a shaken block, and the particles before and after."""
    gravity = scene.pop("gravity", (1.0, -9.81))
    scene, particles = block(2, gravity=gravity, **scene)
    shaken = speed * jnp.asarray(np.random.default_rng(3).normal(size=particles.v.shape))
    particles = mpm.prepare(scene, eqx.tree_at(lambda q: q.v, particles, shaken))
    after, result = mpm.budget(scene, particles, steps=steps, dt=number * explicit_limit(scene), method=method)
    return result, scene, particles, after


def assert_closes(result):
    """Energy and momentum: what is explained is the change, to rounding of the largest term."""
    for part in (result.energy, result.momentum):
        largest = max(float(jnp.abs(term).max()) for term in jax.tree.leaves(part))
        assert float(jnp.abs(part.change - part.explained).max()) < 2e-13 * largest


CASES = {
    **{f"{t}-{d}": {"transfer": TRANSFERS[t], "description": DESCRIPTIONS[d]} for t in TRANSFERS for d in DESCRIPTIONS},
    "linear": {"kernel": KERNELS["linear"]},
    "cubic-spline": {"kernel": KERNELS["cubic"], "gradient": GRADIENTS["spline"]},
    **{f"explicit-{b}": {"boundary": boundary} for b, boundary in BOUNDARIES.items() if b != "free"},
    "semi_implicit-contact": {"method": METHODS["semi_implicit"], "boundary": BOUNDARIES["contact"]},
    "semi_implicit-colliders": {"method": METHODS["semi_implicit"], "boundary": BOUNDARIES["colliders"]},
    "semi_implicit-contact planes": {
        "method": METHODS["semi_implicit"],
        "boundary": BOUNDARIES["contact planes"],
        "transfer": TRANSFERS["flip"],
    },
    "semi_implicit-planes": {
        "method": METHODS["semi_implicit"],
        "boundary": BOUNDARIES["planes"],
        "material": LAWS["neo_hookean"],
    },
    "averaged volumes": {"volume": mpm.AveragedVolume(), "boundary": BOUNDARIES["planes"]},
    "midpoint-averaged volumes": {"volume": mpm.AveragedVolume(), "method": SECOND_ORDER["implicit_midpoint"]},
    "fluid": {"material": FLUIDS["fluid"], "boundary": BOUNDARIES["walls"]},
    "fluid-askew": {"material": FLUIDS["fluid"], "boundary": BOUNDARIES["askew"]},
    "fluid-colliders": {"material": FLUIDS["fluid"], "boundary": BOUNDARIES["colliders"]},
    "semi_implicit-fluid": {"material": FLUIDS["fluid"], "method": METHODS["semi_implicit"], "transfer": mpm.PIC()},
    **{
        f"{m}-viscous": {"material": VISCOUS["viscous_solid"], "method": method, "boundary": BOUNDARIES["walls"]}
        for m, method in (METHODS | SECOND_ORDER).items()
    },
    "flip-total-viscous": {
        "material": VISCOUS["viscous_solid"],
        "transfer": TRANSFERS["flip"],
        "description": DESCRIPTIONS["total"],
    },
    "viscous fluid-contact": {"material": VISCOUS["viscous_fluid"], "boundary": BOUNDARIES["contact planes"]},
    "semi_implicit-viscous fluid-contact": {
        "material": VISCOUS["viscous_fluid"],
        "method": mpm.SemiImplicit(0.6),
        "boundary": BOUNDARIES["contact"],
    },
    "backward_euler-grip": {"method": METHODS["backward_euler"], "boundary": BOUNDARIES["grip"]},
    "implicit_midpoint-contact planes": {
        "method": SECOND_ORDER["implicit_midpoint"],
        "boundary": BOUNDARIES["contact planes"],
    },
    "trbdf2-grip": {"method": SECOND_ORDER["trbdf2"], "boundary": BOUNDARIES["grip"], "transfer": TRANSFERS["flip"]},
    "trbdf2-contact": {"method": mpm.TRBDF2(0.5, mpm.implicit.Newton()), "boundary": BOUNDARIES["contact"]},
    "body force, half a step on": {
        "body_force": Wind(jnp.asarray([0.5, 2.0]), 0.1, 3.0),
        "method": SECOND_ORDER["implicit_midpoint"],
    },
    **{law: {"material": PLASTIC[law]} for law in PLASTIC},
    **{f"semi_implicit-{law}": {"method": METHODS["semi_implicit"], "material": PLASTIC[law]} for law in PLASTIC},
    "body force": {"body_force": Wind(jnp.asarray([0.5, 2.0]), 0.1, 3.0), "boundary": BOUNDARIES["planes"]},
}


SLOW = {
    "fluid-askew",
    "fluid-colliders",
    "explicit-askew",
    "semi_implicit-contact planes",
    "explicit-collider and contact plane",
    "explicit-colliders",
    "flip-updated",
    "pic-updated",
    "explicit-grip",
    "trbdf2-viscous",
    "viscous fluid-contact",
    "backward_euler-grip",
    "body force",
    *(law for law in PLASTIC if law != "snow"),
    *(f"semi_implicit-{law}" for law in PLASTIC),
    "semi_implicit-fluid",
    "semi_implicit-contact",
    "semi_implicit-planes",
    "explicit-contact planes",
    "trbdf2-contact",
    "pic-total",
    "backward_euler-viscous",
    "implicit_midpoint-viscous",
    "semi_implicit-viscous fluid-contact",
}
DEFAULT = {"snow"}


@pytest.mark.parametrize("case", **ids(CASES, DEFAULT, CASES.keys() - SLOW))
def test_the_budget_closes(case):
    """For every transfer, description, kernel, gradient operator, update and boundary."""
    assert_closes(budget_of(**case)[0])


@pytest.mark.thorough
def test_the_budget_is_of_the_run_itself():
    """Its particles are those of `rollout`, and its sums the change of `energy` and `momentum` from end to end."""
    result, scene, before, after = budget_of(method=METHODS["semi_implicit"], boundary=BOUNDARIES["walls"])
    run = mpm.rollout(scene, before, steps=STEPS, dt=0.3 * explicit_limit(scene), method=METHODS["semi_implicit"])
    np.testing.assert_allclose(after.x, run.x, rtol=1e-13)
    np.testing.assert_allclose(after.v, run.v, rtol=0, atol=1e-12)
    change = float(mpm.energy(scene, after).total - mpm.energy(scene, before).total)
    assert float(result.energy.change.sum()) == pytest.approx(change, rel=1e-10)
    np.testing.assert_allclose(
        result.momentum.change.sum(axis=0), mpm.momentum(after) - mpm.momentum(before), atol=1e-10
    )


@pytest.mark.thorough
def test_viscosity_seen_apart_is_that_of_the_run():
    """Which joins it to the elastic force; at a symmetry plane both are folded."""
    case = {"material": VISCOUS["viscous_solid"], "boundary": BOUNDARIES["planes"]}
    _, scene, before, after = budget_of(**case)
    run = mpm.rollout(scene, before, steps=STEPS, dt=0.3 * explicit_limit(block(2)[0]))
    np.testing.assert_allclose(after.x, run.x, rtol=1e-13)
    np.testing.assert_allclose(after.v, run.v, rtol=0, atol=1e-12)


@pytest.mark.thorough
def test_what_the_transfers_lose_is_never_negative():
    """Both are sums of squares with PIC and APIC."""
    for transfer in (mpm.PIC(), mpm.APIC()):
        energy = budget_of(transfer=transfer)[0].energy
        assert (np.asarray(energy.p2g) > 0).all()
        assert (np.asarray(energy.g2p) > 0).all()


@pytest.mark.thorough
def test_flip_without_blending_loses_nothing_over_a_step():
    """FLIP(1): what P2G leaves on the particles comes back: p2g + g2p is what the grid's change alone would lose."""
    energy = budget_of(transfer=mpm.FLIP(1.0), number=1e-4)[0].energy
    assert float(jnp.abs(energy.p2g + energy.g2p).max()) < 1e-3 * float(energy.p2g.max())
    pic = budget_of(transfer=mpm.PIC(), number=1e-4)[0].energy
    assert float((pic.p2g + pic.g2p)[0]) > 0.5 * float(pic.p2g[0])


@pytest.mark.thorough
def test_each_boundary_appears_where_it_acts():
    """A wall and friction only take energy; a grip that moves gives it; a plane does no work."""
    contact = budget_of(boundary=BOUNDARIES["contact"])[0]
    taken = -np.asarray(contact.energy.friction)
    assert taken.max() > 0
    assert taken.min() > -1e-12 * taken.max()
    assert float(contact.momentum.boundary[:, 1].sum()) > 0
    grip = budget_of(boundary=BOUNDARIES["grip"], speed=0.0, gravity=(0.0, 0.0))[0]
    assert float(grip.energy.boundary.sum()) > 0
    planes = budget_of(boundary=BOUNDARIES["planes"])[0]
    assert not np.asarray(planes.energy.friction).any()
    assert float(jnp.abs(planes.momentum.transfer).max()) > 0
    free = budget_of()[0].momentum
    for name in ("transfer", "elastic", "boundary"):
        assert float(jnp.abs(getattr(free, name)).max()) < 1e-12 * float(jnp.abs(free.gravity).max())


@pytest.mark.thorough
def test_an_explicit_step_dissipates_nothing_implicitly_and_beta_does():
    """β Δt² v̄·H v^{n+1}."""
    energy = budget_of()[0].energy
    assert float(jnp.abs(energy.implicit).max()) < 1e-14 * float(energy.p2g.max())
    half, whole = (float(budget_of(method=mpm.SemiImplicit(beta=b))[0].energy.implicit[0]) for b in (0.5, 1.0))
    assert 0 < half < whole


@pytest.mark.thorough
@pytest.mark.parametrize("law", **ids(PLASTIC))
def test_yielding_only_takes_energy(law):
    """And nothing else has a plastic part."""
    yielding, elastic = (budget_of(material=m)[0].energy.plastic for m in (law, LAWS["neo_hookean"]))
    assert (np.asarray(yielding) >= 0).all()
    assert float(yielding.sum()) > 0
    assert not np.asarray(elastic).any()


@pytest.mark.thorough
def test_the_midpoint_rule_gives_back_what_it_takes_implicitly():
    """time_integration − implicit is of second order over a given time, and less than a hundredth of either."""
    sums = []
    for halvings in (2, 3, 4):
        settings = {"method": SECOND_ORDER["implicit_midpoint"], "transfer": mpm.FLIP(1.0), "speed": 0.05}
        energy = budget_of(number=0.8 / 2**halvings, steps=64, **settings)[0].energy
        each = np.abs([energy.time_integration - energy.implicit, energy.implicit])[:, : 4 * 2**halvings]
        sums.append(each.sum(axis=1))
    slopes = np.log2(np.array(sums[:-1]) / sums[1:])
    assert (np.abs(slopes[-1] - [2, 1]) < 0.15).all(), slopes
    assert (sums[-1][0] < 0.01 * sums[-1][1]).all()


@pytest.mark.parametrize(
    "method",
    [*thorough(METHODS["explicit"]), *(pytest.param(METHODS[m], marks=pytest.mark.slow) for m in list(METHODS)[1:])],
)
def test_time_integration_is_of_first_order_over_a_given_time(method):
    """With FLIP(1), whose motion converges as Δt → 0: halving Δt halves its sum, and the sum of its sizes."""
    sums = []
    for halvings in (2, 3, 4):  # the same number of steps in each, so that one compilation serves
        settings = {"method": method, "transfer": mpm.FLIP(1.0), "speed": 0.05}
        energy = budget_of(number=0.8 / 2**halvings, steps=64, **settings)[0].energy
        sums.append(float(jnp.abs(energy.time_integration[: 4 * 2**halvings]).sum()))
    slopes = np.log2(np.array(sums[:-1]) / sums[1:])
    assert (np.abs(slopes - 1) < 0.15).all(), slopes


@pytest.mark.thorough
@pytest.mark.parametrize("method", [METHODS["explicit"], mpm.SemiImplicit(0.6), SECOND_ORDER["trbdf2"]])
@pytest.mark.parametrize("law", ["viscous_solid", "viscous_fluid"])
def test_viscosity_only_takes_energy_and_no_momentum(law, method):
    """Its dissipation is not negative (zero in an explicit step from C = 0), and its impulses add up to nothing without
    walls."""
    result = budget_of(material=VISCOUS[law], method=method)[0]
    assert (np.asarray(result.energy.viscous) >= 0).all()
    assert float(result.energy.viscous.sum()) > 0
    assert float(jnp.abs(result.momentum.viscous).max()) < 1e-12 * float(jnp.abs(result.momentum.gravity).max())
