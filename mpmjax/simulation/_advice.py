"""Advice on a fault of a run: whether its step was too long, and what helps with the law."""

import math
from typing import Any

from mpmjax.material import AbstractLaw
from mpmjax.state import Particles, Scene
from mpmjax.stepping import SAFETY, AbstractIntegrator, UnknownBoundError, longest_step


def advise(scene: Scene, method: AbstractIntegrator, dt: Any, began: Particles, last: Particles, otherwise: str) -> str:
    """Advice on a fault: to shorten the step if it was too long, else what the fault itself suggests.

    A step above the limit explains any fault, but not every run with such a step fails by it. So both are said then.

    Args:
        scene: the scene.
        method: update of the grid velocity.
        dt: Δt [s].
        began: the particles at the start.
        last: the last good ones.
        otherwise: what the fault suggests where the step is within the limit.
    """
    try:
        first, then = (float(longest_step(scene, particles, method)) for particles in (began, last))
    except UnknownBoundError:
        return otherwise
    if scene.kernel.order == 1 and not scene.total:
        then = first  # it changes with every move of the particles, and is zero at each cell's face
    if math.isnan(then):
        then = first  # too deformed to tell
    known = math.isfinite(first) and first > 0 and then > 0
    if not known or float(dt) <= SAFETY * min(first, then):
        return otherwise
    times = float(dt) / first
    said = f"dt = {float(dt):.4g} s is {times:.3g} times the {method.limit_name()} at the start ({first:.4g} s)"
    if not math.isclose(first, then, rel_tol=1e-2):
        said += f" and {float(dt) / then:.3g} times that of the last good state ({then:.4g} s)"
    if float(dt) <= min(first, then):
        said += f"; from {SAFETY:g} times on, large vibrations can grow"
    shortly = otherwise[0].lower() + otherwise[1:]
    shorter = f"at most {SAFETY * first:.4g} s (stable_dt, safety {SAFETY:g})" if float(dt) > SAFETY * first else "less"
    return f"{said}. Take a dt of {shorter}, or an implicit method that has no limit. If the fault stays, {shortly}"


def averaging_advice(scene: Scene) -> str:
    """A sentence on averaged volumes where a law that hardly changes its volume has own ones; else empty."""
    own = scene.laws if scene.volume is None else ()
    if not any(law.allows_averaged_volume and law.hardly_changes_volume() for law in own):
        return ""
    return (
        " With own volumes nearly incompressible material locks, and its pressures differ from particle to particle: "
        "give the scene volume=AveragedVolume()."
    )


def disallowed(law: AbstractLaw, method: AbstractIntegrator) -> tuple[str, str]:
    """What is wrong with a deformation that the law does not allow, and what helps."""
    newton = (
        ""
        if method.is_explicit or method.keeps_admissible
        else ", or take BackwardEuler(), whose line search forbids it"
    )
    return law.inadmissible(newton)
