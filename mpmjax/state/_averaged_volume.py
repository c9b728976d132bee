"""Averaged volumes: the volume ratio of a particle is that of its surroundings."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Matrix
from mpmjax.checks import as_plain, require, require_fields
from mpmjax.discretisation import BSpline, Grid, SplineGradient, Stencil, gather, make_stencil, scatter
from mpmjax.material import AbstractLaw, AbstractMaterial
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
        require(
            self.materials is None or (len(self.materials) > 0 and all(number >= 0 for number in self.materials)),
            f"AveragedVolume's materials must be numbers from 0, at least one of them, got {self.materials}.",
        )

    def covers(self, number: int) -> bool:
        """Whether it averages the material of a number."""
        return self.materials is None or number in self.materials

    def check(self, laws: tuple[AbstractLaw, ...]) -> None:
        """Check that it can stand in a scene with these laws.

        Raises:
            ValueError: it cannot.
        """
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

    hats: Stencil
    """The stencil of linear hat functions."""
    volume: Float[Array, "q"]
    """V0 [m^d], shape (q,)."""
    inverse: Float[Array, "n"]
    """1/Σ_q N_i V0 [1/m^d] of each node, shape (n,); zero where there is no particle."""
    mirror: Mirror
    """The mirror images of the scene's symmetry planes."""
    shape: tuple[int, ...] = eqx.field(static=True)
    """Number of nodes along each axis."""
    periodic: tuple[bool, ...] = eqx.field(static=True)
    """Whether the last node of an axis neighbours its first."""

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
    F: Matrix
    """F [-], shape (d, d, q)."""
    ratio: Float[Array, "q"]
    """J = det F [-], shape (q,)."""
    mean: Float[Array, "q"]
    """J̄ [-], shape (q,)."""
    scale: Float[Array, "q"]
    """s = (J̄/J)^{1/d} [-], shape (q,)."""

    @property
    def dim(self) -> int:
        """d."""
        return self.F.shape[0]

    @property
    def averaged(self) -> Matrix:
        """F̄ = s F [-], shape (d, d, q)."""
        return self.scale * self.F

    def admitted(self, law: AbstractMaterial) -> Bool[Array, "q"]:
        """Whether det F is positive and the law admits F̄."""
        return (self.ratio > 0) & (self.mean > 0) & law.is_admissible(self.averaged)

    def stress(self, P: Matrix) -> Matrix:
        """The derivative of Σ V0 Ψ(F̄) by F_p, over V0_p [Pa]: s P̄ + (S π/J̄ − τ/(d J)) cof F with τ = P̄ : F̄ and
        π = V0 τ/d.

        Args:
            P: P̄, the law's stress at F̄ [Pa], shape (d, d, q).
        """
        pull = self.pull(la.double_dot(P, self.averaged))
        return self.scale * P + pull * la.cofactor(self.F)

    def pull(self, tau: Array) -> Array:
        """S π/J̄ − τ/(d J) [Pa], shape (q,)."""
        share = tau / self.dim
        return self.average(share / self.mean) - share / self.ratio

    def stress_differential(
        self, P: Matrix, tangent: Callable[[Matrix], Matrix], *, definite: bool
    ) -> "AveragedDifferential":
        """The derivative of `stress`.

        Args:
            P: P̄ [Pa], shape (d, d, q).
            tangent: the law's stress differential at F̄.
            definite: whether to leave out the terms of P̄, without which the map is positive semi-definite if the law's
                differential is.
        """
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
    P: Matrix
    """P̄ [Pa]."""
    tau: Array
    """P̄ : F̄ [Pa]."""
    pull: Array
    """See `AveragedDeformation.pull`."""
    cofactor: Matrix
    """cof F [-]."""
    tangent: Callable[[Matrix], Matrix]
    """The law's stress differential at F̄."""

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
        at, d = self.at, self.at.dim
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
        """The rest of the map, beside `at_fixed_means`, on the nodes.

        Args:
            rows: first particle of the material and the one after the last.
            flux: from a stress [Pa] to the flux of its particles [J], the derivative's direction first.
        """
        volume = self.at.average.volume
        local, mean = self.local(jnp.zeros_like(self.cofactor), jnp.ones_like(volume))
        return AveragedStiffness(rows, self.at.average, flux(self.cofactor), flux(local), volume * mean)


class AveragedStiffness(AbstractStiffness):
    """The part of H by which averaged volumes couple the particles of one material: with the slopes g of the
    displacement, δJ = c : g, the mean δJ̄ = S V0 δJ, and the matrix K of each particle at fixed means,

        flux = K g + b δJ̄ + V0 c S (b : g + k δJ̄)

    (see `AveragedDifferential`)."""

    rows: tuple[int, int] = eqx.field(static=True)
    """First particle and the one after the last."""
    average: VolumeAverage
    """S."""
    volumetric: Matrix
    """V0 c [m^d], shape (d, d, q), the derivative's direction first."""
    coupling: Matrix
    """b [J], likewise."""
    bulk: Float[Array, "q"]
    """k [J], shape (q,)."""

    def __call__(self, moved: Displacement) -> Forces:
        """b δJ̄ + V0 c S (b : g + k δJ̄)."""
        slopes = moved.at_particles[1]
        g = slopes[..., slice(*self.rows)]
        mean = self.average.spread(la.double_dot(self.volumetric, g))
        back = self.average.spread(la.double_dot(self.coupling, g) + self.bulk * mean)
        return self._of_all(self.coupling * mean + self.volumetric * back, slopes.shape[-1])

    def diagonal(self, stencil: Stencil, size: int) -> Forces:
        """The diagonal of each particle's matrix if volumes were not averaged, without that of K [J]."""
        del size
        c = self.volumetric / self.average.volume
        return self._of_all(2 * self.coupling * c + self.bulk * c**2, len(stencil.inside))

    def _of_all(self, matrix: Matrix, count: int) -> Forces:
        """Slopes of this material's particles, zero for those of others."""
        if self.rows != (0, count):
            matrix = jnp.zeros((*matrix.shape[:-1], count), matrix.dtype).at[..., slice(*self.rows)].set(matrix)
        return Forces(slopes=matrix)
