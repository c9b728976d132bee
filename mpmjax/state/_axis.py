"""The axis of bodies of revolution: the mirror that a scene has there, and what cannot stand in such a scene. A file of
its own, so that the scene does not name what most scenes lack."""

from collections.abc import Iterable

import numpy as np

from mpmjax._types import Point
from mpmjax.boundary import AbstractBoundary, SymmetryPlane
from mpmjax.checks import is_traced, require
from mpmjax.discretisation import Grid
from mpmjax.state._loads import AbstractLoad


def with_axis(boundary: tuple[AbstractBoundary, ...], grid: Grid) -> tuple[AbstractBoundary, ...]:
    """The boundaries, with a mirror at r = 0 as the last one if none is there and the window may reach it."""
    mirrors = [mirror for one in boundary if (mirror := one.mirror()) is not None and mirror.axis == 0]
    at_axis = any(not is_traced(mirror.position) and float(mirror.position) == 0 for mirror in mirrors)
    if at_axis or not (grid.follow or grid.origin[0] <= 0):
        return boundary
    return (*boundary, SymmetryPlane(axis=0, position=0.0))


def check_axis(gravity: Point, loads: Iterable[AbstractLoad], *, bodies: bool) -> None:
    """Check that a scene is one of bodies of revolution.

    Raises:
        ValueError: gravity across the axis, bodies that touch or are rigid, or a Couple.
    """
    require(
        is_traced(gravity) or float(np.asarray(gravity[0])) == 0,
        f"Gravity on bodies of revolution must act along the axis, (0, g_z), got {gravity}: r is the first direction.",
    )
    refused = [type(load).__name__ for load in loads if not load.may_be_revolved]
    refused += ["Bodies or a Rigid body"] if bodies else []
    require(
        not refused,
        f"An axisymmetric scene cannot have {', '.join(refused)}: take walls and colliders, or three dimensions.",
    )
