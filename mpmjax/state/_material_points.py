"""The particles of one material in a step: their law, their deformation, and how the grid's motion changes it; and
averaged volumes, where the volume ratio of a particle is that of its surroundings."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Deformation, Float, Matrix
from mpmjax.autodiff import materialised
from mpmjax.checks import as_plain, require, require_fields
from mpmjax.discretisation import BSpline, Grid, SplineGradient, Stencil, gather, make_stencil, scatter
from mpmjax.material import AbstractDifferential, AbstractLaw, AbstractMaterial, Viscosity
from mpmjax.potential import AbstractStiffness, Displacement, Forces, Mirror


class AveragedVolume(eqx.Module):
    """The energy of a particle is taken at F̄_p = (J̄_p/J_p)^{1/d} F_p, with the mean volume ratio of its surroundings,

        J̄_p = Σ_i N_i(x_p) θ_i,    θ_i = Σ_q N_i(x_q) V0_q J_q / Σ_q N_i(x_q) V0_q,

    by the linear hat functions N_i of the grid's nodes. Nearly incompressible bodies then neither lock nor have a
    pressure that oscillates from particle to particle (the projection on a space of one order less of T. Elguedj,
    Y. Bazilevs, V. M. Calo, T. J. R. Hughes, Comput. Methods Appl. Mech. Eng. 197 (2008) 2732, doi
    10.1016/j.cma.2008.01.012, with a lumped matrix).

    Forces are the exact derivatives of Σ V0 Ψ(F̄), so that momentum, the symmetry of the Hessian and the balance of work
    are kept. The F that particles store stays that of their motion. The mean volume is kept: Σ V0 J̄ = Σ V0 J.

    *When it breaks*: it needs det F > 0, with fixed corotated elasticity too. What the average does not see, a change
    of volume that alternates within a cell, is resisted by the shear modulus alone. Where volumes truly change from
    cell to cell, as where ν is 0.3, the average smooths them over a cell and is the less accurate one at edges. Linear
    solves take more iterations the nearer ν is to ½, as √K, with averages and without; `VolumePreconditioner` bounds
    them.
    *Good values*: for ν from 0.45 on, or a bulk modulus of ten times μ and more; three particles along a cell's edge.

    Args:
        materials: numbers of the scene's materials, from 0, whose particles' volumes are averaged, each material by
            itself. Default: all of them. Laws that yield, and fluids, are refused.
    """

    materials: tuple[int, ...] | None = eqx.field(static=True, default=None, converter=as_plain)

    def __check_init__(self):
        require_fields(self)
        fits = self.materials is None or (len(self.materials) > 0 and all(number >= 0 for number in self.materials))
        require(fits, f"AveragedVolume's materials must be numbers from 0, at least one of them, got {self.materials}.")

    def covers(self, number: int) -> bool:
        """Whether it averages the material of a number."""
        return self.materials is None or number in self.materials

    def check(self, laws: tuple[AbstractLaw, ...]) -> None:
        """Raise a `ValueError` if it cannot stand in a scene with these laws."""
        require(
            all(number < len(laws) for number in self.materials or ()),
            f"AveragedVolume's materials must be numbers below {len(laws)}, of the scene's laws, got {self.materials}.",
        )
        covered = (law for number, law in enumerate(laws) if self.covers(number))
        refused = [law.title() for law in covered if not law.allows_averaged_volume]
        require(
            not refused,
            "AveragedVolume is for elastic laws of F: what yields returns to a volume of its own, and a fluid has "
            "nothing else that resists. Name the other materials, AveragedVolume(materials=(0,)), without "
            f"{', '.join(refused)}.",
        )


class VolumeAverage(eqx.Module):
    """The average of a field over the particles of one material, J̄ = S V0 J, with the symmetric matrix
    S_pq = Σ_i N_i(x_p) N_i(x_q) / Σ_r N_i(x_r) V0_r [1/m^d]."""

    hats: Stencil  # the stencil of linear hat functions
    volume: Float[Array, "q"]  # V0 [m^d], shape (q,)
    inverse: Float[Array, "n"]  # 1/Σ_q N_i V0 [1/m^d] of each node, shape (n,); zero where there is no particle
    mirror: Mirror  # the mirror images of the scene's symmetry planes
    shape: tuple[int, ...] = eqx.field(static=True)  # number of nodes along each axis
    periodic: tuple[bool, ...] = eqx.field(static=True)  # whether the last node of an axis neighbours its first

    def __call__(self, field: Array) -> Array:
        """S V0 f, shape (q,)."""
        return self.spread(self.volume * field)

    def spread(self, amounts: Array) -> Array:
        """S a, shape (q,)."""
        return self.at_particles(self.inverse * self.at_nodes(amounts))

    def at_nodes(self, amounts: Array) -> Float[Array, "n"]:
        """Σ_p N_i(x_p) a_p, with those of mirror images, shape (n,)."""
        return self.mirror.fold_scalar(scatter(self.hats, amounts[None], None, len(self.inverse))[:, 0])

    def at_particles(self, nodes: Float[Array, "n"]) -> Array:
        """Σ_i N_i(x_p) θ_i, shape (q,)."""
        return gather(self.hats, self.mirror.unfold_scalar(nodes)[:, None])[0][0]


def volume_average(grid: Grid, window: Any, x: Array, volume: Array, mirror: Mirror) -> VolumeAverage:
    """The average over particles of volumes V0 [m^d], shape (q,), that stand on the grid at x [m], shape (q, d)."""
    hats = make_stencil(BSpline(1), SplineGradient(), grid, window, x)
    average = VolumeAverage(hats, volume, jnp.zeros(grid.size, volume.dtype), mirror, grid.shape, grid.periodic)
    total = average.at_nodes(volume)
    return replace(average, inverse=jnp.where(total > 0, 1 / jnp.where(total > 0, total, 1), 0))


class AveragedDeformation(eqx.Module):
    """F̄ of the particles of one material, and what follows from it."""

    average: VolumeAverage
    F: Matrix  # F [-], shape (d, d, q)
    ratio: Float[Array, "q"]  # J = det F [-], shape (q,)
    mean: Float[Array, "q"]  # J̄ [-], shape (q,)
    scale: Float[Array, "q"]  # s = (J̄/J)^{1/d} [-], shape (q,)

    @property
    def averaged(self) -> Matrix:
        """F̄ = s F [-], shape (d, d, q)."""
        return self.scale * self.F

    def stress(self, P: Matrix) -> Matrix:
        """The derivative of Σ V0 Ψ(F̄) by F_p, over V0_p [Pa]: s P̄ + (S π/J̄ − τ/(d J)) cof F with τ = P̄ : F̄ and
        π = V0 τ/d, from the law's stress P̄ at F̄ [Pa], shape (d, d, q)."""
        return self.scale * P + self.pull(la.double_dot(P, self.averaged)) * la.cofactor(self.F)

    def pull(self, tau: Array) -> Array:
        """S π/J̄ − τ/(d J) [Pa], shape (q,)."""
        share = tau / len(self.F)
        return self.average(share / self.mean) - share / self.ratio

    def stress_differential(
        self, P: Matrix, tangent: Callable[[Matrix], Matrix], *, definite: bool
    ) -> "AveragedDifferential":
        """The derivative of `stress`, from P̄ and the law's stress differential at F̄. If `definite`, without the
        terms of P̄: the map is then positive semi-definite if the law's differential is."""
        # without stress the second variation is that of δF̄ alone, by a positive semi-definite map
        P = jnp.zeros_like(P) if definite else P
        tau = la.double_dot(P, self.averaged)
        return AveragedDifferential(self, P, tau, self.pull(tau), la.cofactor(self.F), tangent)


def averaged_deformation(average: VolumeAverage, F: Matrix) -> AveragedDeformation:
    """F̄ of the particles at deformation gradients F [-], shape (d, d, q)."""
    ratio = la.determinant(F)
    mean = average(ratio)
    return AveragedDeformation(average, F, ratio, mean, (mean / ratio) ** (1 / F.shape[0]))


class AveragedDifferential(eqx.Module):
    """The symmetric map V0 δF ↦ V0 δP of all particles of a material together, by the part of each particle, a
    symmetric map of (δF_p, δJ̄_p), and the average δJ̄ = S V0 (cof F : δF)."""

    at: AveragedDeformation
    P: Matrix  # P̄ [Pa]
    tau: Array  # P̄ : F̄ [Pa]
    pull: Array  # see `AveragedDeformation.pull`
    cofactor: Matrix  # cof F [-]
    tangent: Callable[[Matrix], Matrix]  # the law's stress differential at F̄

    def __call__(self, dF: Matrix) -> Matrix:
        """δP [Pa] of δF [-], both of shape (d, d, q)."""
        average = self.at.average
        stress, mean = self.local(dF, average(la.double_dot(self.cofactor, dF)))
        return stress + average(mean) * self.cofactor

    def local(self, dF: Matrix, d_mean: Array) -> tuple[Matrix, Array]:
        """The derivatives by δF_p and by δJ̄_p of half the second variation of a particle's energy over V0.

        With j = cof F : δF and δy = (δJ̄/J̄ − j/J)/d, the change of ln s, that is δF̄ = s δF + F̄ δy and

            δ²Ψ = δP̄ : δF̄ + 2 s (P̄ : δF) δy + τ δy² − τ/d (δJ̄²/J̄² − j²/J²) + pull δ(cof F) : δF.
        """
        at, d = self.at, len(self.at.F)
        j = la.double_dot(self.cofactor, dF)
        dy = (d_mean / at.mean - j / at.ratio) / d
        dP = self.tangent(at.scale * dF + dy * at.averaged)
        along = la.double_dot(dP, at.averaged) + at.scale * la.double_dot(self.P, dF) + self.tau * dy
        inward = (self.tau * j / at.ratio - along) / (d * at.ratio)
        stress = at.scale * (dP + dy * self.P) + inward * self.cofactor
        stress = stress + self.pull * la.cofactor_differential(at.F, dF)
        return stress, (along - self.tau * d_mean / at.mean) / (d * at.mean)

    def at_fixed_means(self, dF: Matrix) -> Matrix:
        """δP where no mean changes, δJ̄ = 0."""
        return self.local(dF, jnp.zeros_like(self.tau))[0]

    def stiffness(self, rows: tuple[int, int], flux: Callable[[Matrix], Matrix]) -> "AveragedStiffness":
        """The rest of the map, beside `at_fixed_means`, on the nodes; `flux` takes a stress [Pa] to the flux of its
        particles [J], the derivative's direction first."""
        volume = self.at.average.volume
        local, mean = self.local(jnp.zeros_like(self.cofactor), jnp.ones_like(volume))
        return AveragedStiffness(rows, self.at.average, flux(self.cofactor), flux(local), volume * mean)


class AveragedStiffness(AbstractStiffness):
    """The part of H by which averaged volumes couple the particles of one material: with the slopes g of the
    displacement, δJ = c : g, the mean δJ̄ = S V0 δJ, and the matrix K of each particle at fixed means,

        flux = K g + b δJ̄ + V0 c S (b : g + k δJ̄)

    (see `AveragedDifferential`)."""

    rows: tuple[int, int] = eqx.field(static=True)  # first particle and the one after the last
    average: VolumeAverage  # S
    volumetric: Matrix  # V0 c [m^d], shape (d, d, q), the derivative's direction first
    coupling: Matrix  # b [J], likewise
    bulk: Float[Array, "q"]  # k [J], shape (q,)

    def __call__(self, moved: Displacement) -> Forces:
        """b δJ̄ + V0 c S (b : g + k δJ̄)."""
        slopes = moved.at_particles[1]
        g = slopes[..., slice(*self.rows)]
        mean = self.average.spread(la.double_dot(self.volumetric, g))
        back = self.average.spread(la.double_dot(self.coupling, g) + self.bulk * mean)
        return self._of_all(self.coupling * mean + self.volumetric * back, slopes.shape[-1])

    def diagonal(self, stencil: Stencil, size: int) -> Forces:
        """The diagonal of each particle's matrix if volumes were not averaged, without that of K [J]."""
        c = self.volumetric / self.average.volume
        return self._of_all(2 * self.coupling * c + self.bulk * c**2, len(stencil.inside))

    def _of_all(self, matrix: Matrix, count: int) -> Forces:
        """Slopes of this material's particles, zero for those of others."""
        if self.rows != (0, count):
            matrix = jnp.zeros((*matrix.shape[:-1], count), matrix.dtype).at[..., slice(*self.rows)].set(matrix)
        return Forces(slopes=matrix)


class MaterialPoints(eqx.Module):
    """The particles of one material, which pay for their own law only."""

    law: AbstractMaterial  # the elastic law in force, frozen in the step
    volume: Float[Array, "q"]  # V0 [m^d], shape (q,)
    deformation: Deformation
    """F or its elastic part [-], shape (d, d, q); for a law that depends on J only, J, shape (q,)."""
    total: bool = eqx.field(static=True)  # whether gradients are with respect to the reference positions
    rows: tuple[int, int] = eqx.field(static=True)  # first particle and the one after the last
    viscosity: Viscosity | None  # the viscosity beside the law; None without
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
        """The derivative of `stress`, δF ↦ δP, by the stress differential `of_law` of a law at a deformation;
        symmetric if weighted with V0. If `definite`, that is positive semi-definite, and so is the result."""
        if self.average is None:
            return of_law(self.law, F)
        at = averaged_deformation(self.average, F)
        return at.stress_differential(_stress(self.law, at.averaged), of_law(self.law, at.averaged), definite=definite)

    def is_admissible(self, F: Deformation) -> Bool[Array, "q"]:
        """Whether the law is defined at deformations F, shape (q,)."""
        if self.average is None:
            return self.law.is_admissible(F)
        at = averaged_deformation(self.average, F)
        return (at.ratio > 0) & (at.mean > 0) & self.law.is_admissible(at.averaged)

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
        # stored once: XLA would else evaluate the law again in each component of the product
        P = materialised(self.volume * P)
        return P if self.total else self.law.measure.kirchhoff_stress(P, self.deformation, dim)

    @property
    def strained_by_gradient(self) -> bool:
        """Whether `change` is ∇u F."""
        return not self.total and self.law.measure.axes == 2

    def stiffness(
        self, tangent: Callable[[Deformation], Deformation], dim: int
    ) -> tuple[Float[Array, "t q"], tuple[AbstractStiffness, ...]]:
        """The upper triangle of the symmetric matrix of ∇u ↦ `weighted_stress` of the stress differential `tangent`
        [J], row by row, shape (d²(d² + 1)/2, q), and what couples the particles besides. Rows and columns are the
        components of ∇u, the derivative's direction first."""
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
