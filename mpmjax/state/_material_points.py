"""The particles of one material in a step: their law, their deformation, and how the grid's motion changes it."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Deformation, Float, Matrix
from mpmjax.material import AbstractDifferential, AbstractMaterial, Viscosity
from mpmjax.native import materialised
from mpmjax.potential import AbstractStiffness
from mpmjax.state._averaged_volume import AveragedDifferential, VolumeAverage, averaged_deformation


class MaterialPoints(eqx.Module):
    """The particles of one material, which pay for their own law only."""

    law: AbstractMaterial
    """The elastic law in force, frozen in the step."""
    volume: Float[Array, "q"]
    """V0 [m^d], shape (q,)."""
    deformation: Deformation
    """F or its elastic part [-], shape (d, d, q); for a law that depends on J only, J, shape (q,)."""
    total: bool = eqx.field(static=True)
    """Whether gradients are with respect to the reference positions."""
    rows: tuple[int, int] = eqx.field(static=True)
    """First particle and the one after the last."""
    viscosity: Viscosity | None
    """The viscosity beside the law; None without."""
    average: VolumeAverage | None = None
    """The average by which the energy knows volumes; None if each particle has its own."""

    def strained(self, F: Deformation) -> Deformation:
        """The deformation at which the law is taken: F, or F̄ where volumes are averaged (see `AveragedVolume`)."""
        return F if self.average is None else averaged_deformation(self.average, F).averaged

    def energy_density(self, F: Deformation) -> Float[Array, "q"]:
        """Ψ [J/m^d of undeformed volume] at deformations F [-], shape (q,)."""
        return self.law.energy(self.strained(F))

    def stress(self, F: Deformation) -> Deformation:
        """The derivative of Σ V0 Ψ by F, over V0 [Pa], of its shape."""
        if self.average is None:
            return _stress(self.law, F)
        at = averaged_deformation(self.average, F)
        return at.stress(_stress(self.law, at.averaged))

    def stress_differential(
        self,
        F: Deformation,
        of_law: Callable[[AbstractMaterial, Deformation], Callable[[Deformation], Deformation]],
        *,
        definite: bool = False,
    ) -> Callable[[Deformation], Deformation]:
        """The derivative of `stress`, δF ↦ δP; symmetric if weighted with V0.

        Args:
            F: the deformation [-].
            of_law: the stress differential of a law at a deformation.
            definite: whether that is positive semi-definite, and the result is to be.
        """
        if self.average is None:
            return of_law(self.law, F)
        at = averaged_deformation(self.average, F)
        return at.stress_differential(_stress(self.law, at.averaged), of_law(self.law, at.averaged), definite=definite)

    def is_admissible(self, F: Deformation) -> Bool[Array, "q"]:
        """Whether the law is defined at deformations F, shape (q,)."""
        if self.average is None:
            return self.law.is_admissible(F)
        return averaged_deformation(self.average, F).admitted(self.law)

    def rows_of(self, field: Array) -> Array:
        """The part of an array over all particles (particle axis last) that belongs to this material."""
        return field if self.rows == (0, field.shape[-1]) else field[..., slice(*self.rows)]

    def change(self, gradient: Matrix) -> Deformation:
        """δF [-] by the gradient ∇u of a displacement, shape (d, d, q): ∇u F, in the total description ∇u; δJ is
        tr(∇u) J."""
        return gradient if self.total else self.law.measure.change(gradient, self.deformation)

    def weighted_stress(self, P: Deformation, dim: int) -> Matrix:
        """V0 P Fᵀ [J], a stress P weighted with the volume, shape (d, d, q), whose sum is the force,
        f_i = −Σ_p (V0 P Fᵀ) g_ip: the transpose of `change`. In the total description V0 P; by P = dΨ/dJ it is
        V0 P J I."""
        P = materialised(self.volume * P)
        return P if self.total else self.law.measure.kirchhoff_stress(P, self.deformation, dim)

    def stiffness(
        self, tangent: Callable[[Deformation], Deformation], dim: int
    ) -> tuple[Float[Array, "t q"], tuple[AbstractStiffness, ...]]:
        """The upper triangle of the symmetric matrix of ∇u ↦ `weighted_stress` of the stress differential [J], row by
        row, shape (d²(d² + 1)/2, q), and what couples the particles besides. Rows and columns are the components of ∇u,
        the derivative's direction first.

        Args:
            tangent: the stress differential δF ↦ δP.
            dim: d.
        """
        coupled: tuple[AbstractStiffness, ...] = ()
        if isinstance(tangent, AveragedDifferential):
            coupled = (tangent.stiffness(self.rows, lambda P: la.transpose(self.weighted_stress(P, dim))),)
            tangent = tangent.at_fixed_means
        like = jnp.zeros((dim, dim, *self.volume.shape), self.volume.dtype)
        if isinstance(tangent, AbstractDifferential) and self.deformation.ndim == like.ndim:
            A = la.identity_like(like) if self.total else self.deformation
            if (closed := tangent.pushed_forward(A, self.volume)) is not None:
                return closed, coupled

        def flux_of(slopes: Matrix) -> Matrix:
            return la.transpose(self.weighted_stress(tangent(self.change(la.transpose(slopes))), dim))

        return la.upper_triangle(la.matrix_of(flux_of, like)), coupled

    def volume_ratio(self) -> Float[Array, "q"]:
        """J = det F [-], shape (q,)."""
        return self.law.measure.determinant(self.deformation)

    def stiffest(self, dim: int) -> Float[Array, "q"]:
        """Λ of each particle [Pa], shape (q,) (see `stable_dt`). Where volumes are averaged, the larger of Λ and its
        average: the average A, of weights V0 A symmetric, has Σ V0 Λ (A J)² ≤ Σ V0 (A Λ) J²."""
        F = self.strained(self.deformation)
        elastic = self.law.stiffness_eigenvalues(F, dim, total=self.total).max(axis=0)
        return elastic if self.average is None else jnp.maximum(elastic, self.average(elastic))

    def weighted_viscous_stress(self, gradient: Matrix) -> Matrix:
        """|J| V0 σ_v [J], whose sum over g_ip is D v (derivation, eq. 28), at a velocity gradient ∇v [1/s], both of
        shape (d, d, q). In the total description σ_v is of L = ∇v F⁻¹, and |J| V0 σ_v F⁻ᵀ is returned. The map is
        symmetric and positive semi-definite."""
        if self.viscosity is None:
            return jnp.zeros_like(gradient)
        J = self.volume_ratio()
        if not self.total:
            return self.volume * jnp.abs(J) * self.viscosity.stress(gradient)
        inverse = la.transpose(la.cofactor(self.deformation)) / J
        stress = self.viscosity.stress(la.matmul(gradient, inverse))
        return self.volume * jnp.abs(J) * la.matmul(stress, la.transpose(inverse))


@eqx.filter_jit  # a law may hold functions
def _stress(law: AbstractMaterial, F: Deformation) -> Deformation:
    """The stress of a law, compiled as one function so that it is traced once."""
    return law.stress(F)
