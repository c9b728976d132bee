"""Walls, grips, mirrored planes and colliders, and what colliders receive."""

from mpmjax.boundary._active_set import find_active_set
from mpmjax.boundary._body_contact import STIFFNESS, Body, BodyContact, body_contact, in_a_row
from mpmjax.boundary._boundary import ON_THE_WALL, AbstractBoundary, Wall
from mpmjax.boundary._boundary_impulse import (
    BoundaryImpulse,
    GivenCouple,
    impulse_on_boundaries,
    no_boundary_impulse,
    owners_of,
    taken_by_mirrors,
)
from mpmjax.boundary._collider import AbstractCollider, SeparatingCollider, SlipCollider, StickyCollider
from mpmjax.boundary._collider_impulse import ColliderImpulse, impulse_on_colliders, no_impulse
from mpmjax.boundary._combined import (
    brought_contacts,
    brought_images,
    combined_conditions,
    mirror,
    mirror_motion,
)
from mpmjax.boundary._conditions import Conditions, FreeNormal, Given
from mpmjax.boundary._contact import (
    AbstractContact,
    AbstractNodes,
    ConstrainedNodes,
    constrain,
)
from mpmjax.boundary._contact_info import ContactInfo
from mpmjax.boundary._faces import EXPLICIT_STIFFNESS, IMPLICIT_STIFFNESS, Faces, FaceShape
from mpmjax.boundary._grip import Grip
from mpmjax.boundary._planes import ContactPlane, SymmetryPlane
from mpmjax.boundary._rigid_part import RigidPart
from mpmjax.boundary._surface_contact import Surface, SurfaceContact, refuse_contact
from mpmjax.boundary._walls import SeparatingBox, SlipBox, StickyBox

__all__ = [
    "EXPLICIT_STIFFNESS",
    "IMPLICIT_STIFFNESS",
    "ON_THE_WALL",
    "STIFFNESS",
    "AbstractBoundary",
    "AbstractCollider",
    "AbstractContact",
    "AbstractNodes",
    "Body",
    "BodyContact",
    "BoundaryImpulse",
    "ColliderImpulse",
    "Conditions",
    "ConstrainedNodes",
    "ContactInfo",
    "ContactPlane",
    "FaceShape",
    "Faces",
    "FreeNormal",
    "Given",
    "GivenCouple",
    "Grip",
    "RigidPart",
    "SeparatingBox",
    "SeparatingCollider",
    "SlipBox",
    "SlipCollider",
    "StickyBox",
    "StickyCollider",
    "Surface",
    "SurfaceContact",
    "SymmetryPlane",
    "Wall",
    "body_contact",
    "brought_contacts",
    "brought_images",
    "combined_conditions",
    "constrain",
    "find_active_set",
    "impulse_on_boundaries",
    "impulse_on_colliders",
    "in_a_row",
    "mirror",
    "mirror_motion",
    "no_boundary_impulse",
    "no_impulse",
    "owners_of",
    "refuse_contact",
    "taken_by_mirrors",
]
