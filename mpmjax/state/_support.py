"""Springs and dashpots between points of a body and the ground, in a step."""

import equinox as eqx

from mpmjax._types import Array, Float, NodeVector
from mpmjax.boundary import Mirror
from mpmjax.state._loaded_points import LoadedPoints


class Support(eqx.Module):
    """The energy Σ_s ½ k_s (e_s + N_s u)² of springs, and the resistance Σ_s N_sᵀ c_s N_s v of dashpots."""

    points: LoadedPoints
    stiffness: Float[Array, "d s"]
    """k_s in each direction [N/m]."""
    stretch: Float[Array, "d s"]
    """e_s [m], at the start of the step."""
    damping: Float[Array, "d s"] | None
    """c_s [N s/m]; None without dashpots."""

    def energy(self, u: NodeVector) -> Float[Array, ""]:
        """The energy at a displacement u of the nodes [J]."""
        return (self.stiffness * (self.stretch + self.points.displacement(u)) ** 2).sum() / 2

    def force(self, u: NodeVector | None, size: int) -> NodeVector:
        """−Σ_s N_is k_s (e_s + N_s u) [N], shape (n, d); u = 0 for None."""
        stretch = self.stretch if u is None else self.stretch + self.points.displacement(u)
        return -self.points.nodal(self.stiffness * stretch, size)

    def drag(self, size: int) -> NodeVector | None:
        """−Σ_s N_is c_s v_s [N], shape (n, d), at the points' velocity at the start of the step."""
        return None if self.damping is None else -self.points.nodal(self.damping * self.points.v, size)

    def drag_power(self) -> Float[Array, ""] | float:
        """Σ_s v_s c_s v_s [W], at that velocity."""
        return 0.0 if self.damping is None else (self.damping * self.points.v**2).sum()

    def resistance(self, v: NodeVector) -> NodeVector | None:
        """Σ_s N_is c_s N_s v [N], shape (n, d); None without dashpots."""
        if self.damping is None:
            return None
        return self.points.nodal(self.damping * self.points.displacement(v), len(v))

    def power(self, v: NodeVector) -> Float[Array, ""] | float:
        """Σ_s c_s (N_s v)² [W]."""
        return 0.0 if self.damping is None else (self.damping * self.points.displacement(v) ** 2).sum()

    def mirrored(self, mirror: Mirror) -> "Support":
        """The support on nodes that are folded at mirrors."""
        return eqx.tree_at(lambda s: s.points.mirror, self, mirror)


class SupportStiffness(eqx.Module):
    """The map δu ↦ Σ_s N_sᵀ k_s N_s δu [N] of a support."""

    points: LoadedPoints
    stiffness: Float[Array, "d s"]
    """k_s in each direction [N/m]; with dashpots in the solve k_s + r c_s."""

    def __call__(self, du: NodeVector) -> NodeVector:
        """The force that a displacement takes."""
        return self.points.nodal(self.stiffness * self.points.displacement(du), len(du))

    def diagonal(self, like: NodeVector) -> NodeVector:
        """See `LoadedPoints.diagonal`."""
        return self.points.diagonal(self.stiffness, like)


def stiffness_of(supports: tuple[Support, ...], rate: Array | float = 0.0) -> tuple[SupportStiffness, ...]:
    """The stiffness k + r c of each support, with r [1/s] the rate of damping."""
    return tuple(
        SupportStiffness(s.points, s.stiffness if s.damping is None else s.stiffness + rate * s.damping)
        for s in supports
    )
