"""Bodies that touch each other."""

import equinox as eqx

from mpmjax._types import Scalar
from mpmjax.checks import require, require_between, require_fields


class Bodies(eqx.Module):
    """Which materials are bodies of their own, that may touch, slide on each other and part.

        two = mpm.join(block, slab)
        scene = mpm.Scene(grid, (rubber, steel), bodies=mpm.Bodies(friction=0.3))

    Each body has a layer of nodes of its own, and moves as if it were alone but for the push and the friction of
    `BodyContact`. Bodies of one law are two materials with this law. Without it all materials of a scene share the nodes
    and stick to each other.

    *When it breaks*: not in the total description, nor with the linear kernel. Two bodies pass through each other that
    approach by more than half a spacing in a step.

    Args:
        friction: Coulomb coefficient between any two bodies [-], at least 0. A large one, such as 1e3, makes them stick
            while they are pressed together.
        groups: the numbers of the materials of each body. Default: each material is a body.
    """

    friction: Scalar = 0.0
    groups: tuple[tuple[int, ...], ...] | None = eqx.field(
        static=True, default=None, converter=lambda g: tuple(map(tuple, g)) if isinstance(g, list | tuple) else g
    )

    def __check_init__(self):
        require_fields(self)
        require_between("The friction of Bodies", self.friction, 0, 1e6)

    def of_materials(self, count: int) -> tuple[int, ...]:
        """The number of each material's body.

        Raises:
            ValueError: groups that do not have each material once; fewer than two bodies.
        """
        groups = tuple((k,) for k in range(count)) if self.groups is None else self.groups
        every = sorted(number for group in groups for number in group)
        require(
            every == list(range(count)) and all(groups),
            f"The groups of Bodies must have each of the scene's {count} materials once, got {groups}.",
        )
        require(
            len(groups) > 1,
            f"Bodies must be two or more to touch, got {len(groups)}: give each a law of its own in material, or drop "
            "bodies.",
        )
        body = {material: number for number, group in enumerate(groups) for material in group}
        return tuple(body[material] for material in range(count))
