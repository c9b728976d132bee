"""How far a minimum moves on twice the spacing and step: the part of its error that the discretisation makes."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Float
from mpmjax.fitting._evaluation import residuals_at
from mpmjax.fitting._problem import Coordinates, FitProblem
from mpmjax.fitting._uncertainty import uncertainty


class CoarseGrid(NamedTuple):
    """The look at twice the spacing, and at twice the step there."""

    moved: Float[
        np.ndarray, "2 n"
    ]  # how far the minimum moves on twice the spacing, and from there with twice the step
    residuals: Float[np.ndarray, "m"]  # those of the minimum on twice the spacing


def look_at_coarse_grid(problem: FitProblem, z: Coordinates, jacobian: Float[np.ndarray, "m n"]) -> CoarseGrid | str:
    """The look at twice the spacing from the minimum z, or why there is none: by Gauss-Newton steps −(JᵀJ)⁻¹ Jᵀ r with
    r of the coarse grid and J of the fine one, zero of what a bound holds, at most three of each, while Σ r² falls."""
    inverse = uncertainty(jacobian, float(jnp.finfo(problem.dtype).eps), ()).inverse
    places, first = [np.asarray(z, float)], None
    for longer in (1, 2):
        try:  # steps so many times longer, or the next of which t1 is a whole number
            scenes = [eqx.tree_at(lambda s: s.grid, e.scene, e.scene.grid.coarsened()) for e in problem.experiments]
            each = [
                (e, scene, e.t1 / -(-e.steps // longer)) for e, scene in zip(problem.experiments, scenes, strict=True)
            ]
            experiments = tuple(replace(e, scene=scene, dt=dt) for e, scene, dt in each)
        except ValueError as error:  # of a wall that must lie on nodes, or a period
            return str(error)
        coarse, least, tried = eqx.tree_at(lambda p: p.experiments, problem, experiments), np.inf, places[-1:]
        for _ in range(_STEPS):
            try:
                r = np.asarray(residuals_at(coarse, np.array(tried[-1:])), float)[0]
            except KeyboardInterrupt:
                return "interrupted."
            first = r if first is None else first
            if not (r**2).sum() < least:
                # The first step stays even so: it is what a linear model says.
                tried = tried[: max(len(tried) - 1, 2)]
                break
            least = (r**2).sum()
            tried.append(tried[-1] - inverse @ (jacobian.T @ r))
        if not np.isfinite(least):
            return "the simulation fails there."
        places.append(tried[-1])
    return CoarseGrid(np.diff(places, axis=0), np.asarray(first))


def unexplained(
    r: Float[np.ndarray, "m"], J: Float[np.ndarray, "m n"], coarse: CoarseGrid | str | None
) -> Float[np.ndarray, "m"]:
    """The part of residuals r that is not like their change on twice the spacing, as far as parameters, with the
    Jacobian J, do not make up for that. An error of the order two is a third of that change."""
    if not isinstance(coarse, CoarseGrid):
        return r
    change = coarse.residuals - r
    change = change - J @ np.linalg.lstsq(J, change)[0]
    share = (r @ change) / max(change @ change, np.finfo(float).tiny)
    return r - np.clip(share, 0, 1) * change


_STEPS = 3
