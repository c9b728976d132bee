"""What a rigid body may do."""

from typing import NamedTuple


class Freedom(NamedTuple):
    """What a rigid body may do."""

    directions: tuple[bool, ...] | None
    """In which directions it may move, one bool each; None for all of them."""
    turns: bool
    """Whether it may turn."""

    @property
    def guided(self) -> bool:
        """Whether there is anything that it may not do."""
        return not self.turns or not all(self.directions or ())
