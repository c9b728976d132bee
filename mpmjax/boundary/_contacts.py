"""The contacts of a scene."""

from mpmjax._types import Array, Int
from mpmjax.boundary._collider_contact import collider_contacts
from mpmjax.boundary._conditions import AbstractBoundary, Conditions
from mpmjax.boundary._contact import AbstractContact
from mpmjax.boundary._plane_contact import plane_contacts
from mpmjax.boundary._wall_contact import wall_contacts
from mpmjax.discretisation import Grid


def contacts_of(
    boundaries: tuple[AbstractBoundary, ...], conditions: Conditions, grid: Grid, window: Int[Array, "d"]
) -> tuple[AbstractContact, ...]:
    """The contacts of a scene in the order of their friction: walls and planes, axis by axis, then colliders.

    Args:
        boundaries: the scene's boundaries.
        conditions: what they ask of the nodes.
        grid: the grid.
        window: lattice index of the window's first node, shape (d,).
    """
    across = (*wall_contacts(conditions), *plane_contacts(boundaries, grid, window))
    axis_of = [contact.axis for contact in across]
    ordered = [contact for a in range(grid.dim) for contact, axis in zip(across, axis_of, strict=True) if axis == a]
    return (*ordered, *collider_contacts(conditions))
