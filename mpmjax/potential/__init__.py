"""The nodes' potential in a step: its terms, and the mirrors on which nodes are folded."""

from mpmjax.potential._mirror import (
    AbstractImage as AbstractImage,
    Image as Image,
    Mirror as Mirror,
    MirrorPlace as MirrorPlace,
    Tie as Tie,
    carried_by as carried_by,
    mirror_image as mirror_image,
    with_one_mass as with_one_mass,
)
from mpmjax.potential._surface_image import SurfaceImage as SurfaceImage, surface_image as surface_image
from mpmjax.potential._term import (
    AbstractSpring as AbstractSpring,
    AbstractStiffness as AbstractStiffness,
    AbstractTerm as AbstractTerm,
    Displacement as Displacement,
    Forces as Forces,
    scattered as scattered,
)
from mpmjax.potential._wall_image import (
    AbstractWallImage as AbstractWallImage,
    WallImage as WallImage,
    wall_image as wall_image,
)
