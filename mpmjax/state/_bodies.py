"""Bodies that touch each other."""

import equinox as eqx

from mpmjax._types import Scalar
from mpmjax.checks import as_plain, require, require_between, require_fields


class Bodies(eqx.Module):
    """Which materials are bodies of their own, that may touch, slide on each other and part.

        particles = mpm.join(block, slab)
        scene = mpm.Scene(grid, (rubber, steel), bodies=mpm.Bodies(friction=0.3))

    Each body has a layer of nodes of its own, and moves as if it were alone but for push and friction (see
    `BodyContact`). Without it all materials of a scene share the nodes and stick to each other. Bodies of one law are
    several materials with this law.

    *When it breaks*: not in the total description, nor with the linear kernel. Bodies that come nearer to each other by
    more than half a spacing in a step pass through each other.

    Args:
        friction: Coulomb coefficient between any two bodies [-], at least 0. With a large one, such as 1e3, they stick
            while they are pressed together.
        of_materials: the number of each material's body, from 0. Default: each material is a body.
    """

    friction: Scalar = 0.0
    of_materials: tuple[int, ...] | None = eqx.field(static=True, default=None, converter=as_plain)

    def __check_init__(self):
        require_fields(self)
        require_between("The friction of Bodies", self.friction, 0, 1e6)
        require(
            self.of_materials is None or len(self.of_materials) > 0,
            "The of_materials of Bodies must be one number for each material, got none: leave it out to make each "
            "material a body.",
        )

    def numbers(self, count: int) -> tuple[int, ...]:
        """The number of the body of each of so many materials.

        Raises:
            ValueError: not one number a material, a number left out, fewer than two bodies.
        """
        numbers = tuple(range(count)) if self.of_materials is None else self.of_materials
        require(
            len(numbers) == count and set(numbers) == set(range(max(numbers) + 1)),
            f"The of_materials of Bodies must be one number for each of the scene's {count} materials, from 0 and none "
            f"left out, got {numbers}.",
        )
        require(
            max(numbers) > 0,
            f"Bodies must be two or more to touch, got one of {count} material(s): give each body a law of its own in "
            "material, or drop bodies.",
        )
        return numbers
