"""Walls, grips, mirrored planes and colliders, and what colliders receive."""

from mpmjax.boundary._collider import AbstractCollider, SeparatingCollider, SlipCollider, StickyCollider
from mpmjax.boundary._exchange import Exchange, nothing_received, received
from mpmjax.boundary._mirror import Contact, ContactPlane, Mirror, Plane, SymmetryPlane, contacts, fits, mirror
from mpmjax.boundary._walls import (
    ON_THE_WALL,
    AbstractBoundary,
    Conditions,
    Grip,
    SeparatingBox,
    SlipBox,
    StickyBox,
    combine,
)

__all__ = [
    "ON_THE_WALL",
    "AbstractBoundary",
    "AbstractCollider",
    "Conditions",
    "Contact",
    "ContactPlane",
    "Exchange",
    "Grip",
    "Mirror",
    "Plane",
    "SeparatingBox",
    "SeparatingCollider",
    "SlipBox",
    "SlipCollider",
    "StickyBox",
    "StickyCollider",
    "SymmetryPlane",
    "combine",
    "contacts",
    "fits",
    "mirror",
    "nothing_received",
    "received",
]
