"""Features of a scene two at a time: they work together, or are refused in one line."""

import traceback
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers import LAWS

import mpmjax as mpm
from mpmjax.checks import canonical
from mpmjax.stepping import step_unchecked

DX = 0.1
LOW, HIGH = (-np.inf, 0.0), (np.inf, np.inf)
STAY = mpm.Motion((0.0, 1.0), ((0.0, 0.0), (0.0, 0.0)))
UNDER, FOOT = mpm.HalfSpace((0.0, 0.0), (0.0, 1.0)), mpm.Box((-0.1, -0.1), (0.5, 0.05))
TOP = mpm.Patch(mpm.Box((0.0, 0.0), (0.2, 0.2)), mpm.HalfSpace((0.0, 0.15), (0.0, -1.0)))
FEATURES = {
    "bodies": {"bodies": mpm.Bodies(0.3)},
    "grip": {"boundary": mpm.Grip(FOOT, STAY)},
    "sticky box": {"boundary": mpm.StickyBox(LOW, HIGH)},
    "moving slip box": {"boundary": mpm.SlipBox(LOW, HIGH, STAY)},
    "separating box": {"boundary": mpm.SeparatingBox(LOW, HIGH, friction=0.1)},
    "symmetry plane": {"boundary": mpm.SymmetryPlane(1, 0.0)},
    "moving plane": {"boundary": mpm.SymmetryPlane(1, 0.0, motion=STAY)},
    "clamp plane": {"boundary": mpm.ClampPlane(1, 0.0)},
    "contact plane": {"boundary": mpm.ContactPlane(1, 0.0, friction=0.1)},
    "sticky collider": {"boundary": mpm.StickyCollider(FOOT)},
    "slip collider": {"boundary": mpm.SlipCollider(UNDER, STAY)},
    "separating collider": {"boundary": mpm.SeparatingCollider(UNDER, friction=0.1)},
    "rigid part": {"boundary": mpm.RigidPart(FOOT), "description": mpm.TotalLagrangian()},
    "boundary forces": {"boundary": mpm.SlipBox((0.0, -np.inf), HIGH), "boundary_forces": True},
    "total": {"description": mpm.TotalLagrangian()},
    "linear kernel": {"kernel": mpm.BSpline(1)},
    "cubic kernel": {"kernel": mpm.BSpline(3)},
    "spline gradient": {"gradient": mpm.SplineGradient()},
    "flip": {"transfer": mpm.FLIP()},
    "averaged volume": {"volume": mpm.AveragedVolume()},
    "pressure": {"loads": mpm.Pressure(TOP, 1e2)},
    "spring": {"loads": mpm.Spring(mpm.PointsAt(((0.1, 0.1),)), 1e2, 1.0)},
    "couple": {"loads": mpm.Couple(TOP, 1.0)},
    "fluid": {"material": mpm.Fluid(1e5)},
    "corrected": {"material": mpm.Fluid(1e5), "correction": mpm.extensions.DensityCorrection()},
    "metal": {"material": mpm.VonMises(1e5, 0.3, 1e3)},
    "viscous": {"material": mpm.Viscous(LAWS["neo_hookean"], 1.0)},
    "rigid body": {"material": mpm.Rigid(1e5)},
    "periodic": {"grid": {"periodic": (True, False)}},
    "following": {"grid": {"follow": True}},
    "semi-implicit": {"method": mpm.SemiImplicit()},
    "newton": {"method": mpm.BackwardEuler()},
    "midpoint": {"method": mpm.ImplicitMidpoint()},
    "trbdf2": {"method": mpm.TRBDF2()},
}


def stepped(features: dict) -> None:
    """Prepare a block for a scene with these features, two blocks with `bodies`, and trace a step."""
    grid = mpm.Grid((9, 9), DX, origin=(-3, -3), **features.pop("grid", {}))
    method, material = features.pop("method", mpm.Explicit()), features.pop("material", LAWS["neo_hookean"])
    particles = mpm.fill(mpm.Box((0.0, 0.0), (0.2, 0.2)), grid, density=1e3)
    if "bodies" in features:
        material = (material, LAWS["neo_hookean"])
        particles = mpm.join(particles, mpm.fill(mpm.Box((0.0, 0.2), (0.2, 0.4)), grid, density=1e3))
    scene = mpm.Scene(grid, material, gravity=(0.0, -9.81), **features)
    scene = mpm.attach(scene, particles)
    particles = mpm.prepare(scene, particles)
    jax.eval_shape(step_unchecked, *canonical((scene, particles, 0.0, 1e-3, method), particles.x.dtype))


def refused(features: dict) -> str | None:
    """What a scene with these features is refused with; None if it works. Errors from inside are raised."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            stepped(features)
        except ValueError as error:
            if Path(traceback.extract_tb(error.__traceback__)[-1].filename).parent.name == "checks":
                return str(error)
            raise
    return None


@pytest.mark.thorough
@pytest.mark.parametrize("first", FEATURES)
def test_two_features_work_together_or_are_refused_in_one_line(first):
    names = list(FEATURES)
    for second in names[names.index(first) + 1 :]:
        one, other = FEATURES[first], FEATURES[second]
        both = {**one, **other}
        for shared in one.keys() & other.keys():
            if shared not in ("boundary", "loads"):
                break
            both[shared] = (one[shared], other[shared])
        else:
            if (refusal := refused(both)) is not None:
                assert "\n" not in refusal, (first, second, refusal)
                assert len(refusal) < 400, (first, second, refusal)
