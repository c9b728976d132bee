"""Walls, grips, mirrored planes and colliders, and the impulses that they receive."""

from mpmjax.boundary._body_contact import (
    STIFFNESS as STIFFNESS,
    Body as Body,
    BodyContact as BodyContact,
    body_contact as body_contact,
    series_stiffness as series_stiffness,
)
from mpmjax.boundary._boundary import (
    ON_THE_WALL as ON_THE_WALL,
    AbstractBoundary as AbstractBoundary,
    Wall as Wall,
    combined_conditions as combined_conditions,
    mirror as mirror,
)
from mpmjax.boundary._collider import (
    AbstractCollider as AbstractCollider,
    SeparatingCollider as SeparatingCollider,
    SlipCollider as SlipCollider,
    StickyCollider as StickyCollider,
)
from mpmjax.boundary._conditions import (
    Conditions as Conditions,
    FreeNormal as FreeNormal,
    Impulses as Impulses,
    OwnedCouple as OwnedCouple,
    OwnedImpulse as OwnedImpulse,
    no_impulses as no_impulses,
    received_impulses as received_impulses,
    taken_by_mirrors as taken_by_mirrors,
)
from mpmjax.boundary._contact import (
    AbstractContact as AbstractContact,
    AbstractSpringContact as AbstractSpringContact,
    ActiveSet as ActiveSet,
    ConstrainedNodes as ConstrainedNodes,
    ContactInfo as ContactInfo,
    constrain as constrain,
    count_places as count_places,
    friction_change as friction_change,
    friction_share as friction_share,
)
from mpmjax.boundary._plane_contact import with_tied_columns as with_tied_columns
from mpmjax.boundary._planes import (
    ClampPlane as ClampPlane,
    ContactPlane as ContactPlane,
    SymmetryPlane as SymmetryPlane,
)
from mpmjax.boundary._regions import Grip as Grip, RigidPart as RigidPart
from mpmjax.boundary._surface_contact import (
    EXPLICIT_STIFFNESS as EXPLICIT_STIFFNESS,
    IMPLICIT_STIFFNESS as IMPLICIT_STIFFNESS,
    Faces as Faces,
    FaceShape as FaceShape,
    Surface as Surface,
    SurfaceContact as SurfaceContact,
    refuse_contact as refuse_contact,
)
from mpmjax.boundary._walls import SeparatingBox as SeparatingBox, SlipBox as SlipBox, StickyBox as StickyBox
