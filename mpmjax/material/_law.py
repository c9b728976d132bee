"""The interface of laws, elastic or with a history, and the deformation that their particles store."""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Deformation, Float, Matrix, PerParticle, Scalar, components
from mpmjax.checks import require
from mpmjax.material._tangent import AbstractTangent


class AbstractDeformationMeasure(eqx.Module):
    """The measure of deformation that a law's particles store, component first in a step, and how the grid's motion
    changes it."""

    axes: ClassVar[int]
    """How many axes one particle's deformation has."""
    symbol: ClassVar[str]
    """In messages, what is stored; `name` says what it is."""
    name: ClassVar[str]
    volume: ClassVar[str]
    """In messages, what most laws need to be positive."""
    rate: ClassVar[str]
    """In messages, the rate [1/s] whose product with a step must be below 1."""

    @abc.abstractmethod
    def undeformed(self, dim: int) -> np.ndarray:
        """The deformation of one particle at rest [-], of one particle's shape."""

    @abc.abstractmethod
    def of(self, F: Matrix) -> Deformation:
        """The stored deformation at deformation gradients [-], shape (d, d, p)."""

    @abc.abstractmethod
    def change(self, gradient: Matrix, deformation: Deformation) -> Deformation:
        """The change [-] by the gradient ∇u of a displacement, shape (d, d, p), to first order."""

    @abc.abstractmethod
    def kirchhoff_stress(self, stress: Deformation, deformation: Deformation, dim: int) -> Matrix:
        """τ = J σ [Pa], shape (d, d, p), by the energy's derivative with respect to the deformation: the transpose of
        `change`. The nodal force is f_i = −Σ_p V0_p τ_p g_ip."""

    @abc.abstractmethod
    def determinant(self, deformation: Deformation) -> Array:
        """J = det F [-], shape (p,)."""

    @abc.abstractmethod
    def collapsed(self, deformation: Deformation, least: float) -> Bool[Array, "p"]:
        """Whether the smallest principal stretch is below the least one that is allowed [-], shape (p,)."""


class DeformationGradient(AbstractDeformationMeasure):
    """The deformation gradient F [-], shape (d, d, p), or its elastic part."""

    axes: ClassVar[int] = 2
    symbol: ClassVar[str] = "F"
    name: ClassVar[str] = "deformation gradient"
    volume: ClassVar[str] = "det F"
    rate: ClassVar[str] = "|∇v|"

    def undeformed(self, dim: int) -> np.ndarray:
        return np.eye(dim)

    def of(self, F: Matrix) -> Matrix:
        return F

    def change(self, gradient: Matrix, deformation: Matrix) -> Matrix:
        """∇u F."""
        return la.matmul(gradient, deformation)

    def kirchhoff_stress(self, stress: Matrix, deformation: Matrix, dim: int) -> Matrix:
        """P Fᵀ."""
        del dim
        return la.matmul(stress, la.transpose(deformation))

    def determinant(self, deformation: Matrix) -> Array:
        return la.determinant(deformation)

    def collapsed(self, deformation: Matrix, least: float) -> Bool[Array, "p"]:
        # 1/‖F⁻¹‖ lies between the smallest stretch and 1/√d of it, and needs no eigenvalues
        cofactor = la.cofactor(deformation)
        return la.determinant(deformation) ** 2 <= least**2 * la.double_dot(cofactor, cofactor)


class VolumeRatio(AbstractDeformationMeasure):
    """J = det F [-] alone, shape (p,)."""

    axes: ClassVar[int] = 0
    symbol: ClassVar[str] = "J"
    name: ClassVar[str] = "volume"
    volume: ClassVar[str] = "J"
    rate: ClassVar[str] = "|div v|"

    def undeformed(self, dim: int) -> np.ndarray:
        del dim
        return np.ones(())

    def of(self, F: Matrix) -> Array:
        return la.determinant(F)

    def change(self, gradient: Matrix, deformation: Array) -> Array:
        """tr(∇u) J."""
        return la.trace(gradient) * deformation

    def kirchhoff_stress(self, stress: Array, deformation: Array, dim: int) -> Matrix:
        """dΨ/dJ J I."""
        return stress * deformation * jnp.eye(dim, dtype=deformation.dtype)[..., None]

    def determinant(self, deformation: Array) -> Array:
        return deformation

    def collapsed(self, deformation: Array, least: float) -> Bool[Array, "p"]:
        return jnp.abs(deformation) <= least


class Freedom(NamedTuple):
    """Degrees of freedom of a rigid body."""

    directions: tuple[bool, ...] | None
    """Whether it may move in each direction; None for all of them."""
    turns: bool
    """Whether it may turn."""

    @property
    def guided(self) -> bool:
        """Whether any degree of freedom is fixed."""
        return not self.turns or not all(self.directions or ())


class Viscosity(eqx.Module):
    """A Newtonian viscous stress, linear in the velocity gradient L = ∇_x v."""

    shear: PerParticle
    """η [Pa s]."""
    bulk: PerParticle
    """ζ [Pa s]."""

    def stress(self, L: Matrix) -> Matrix:
        """σ_v = 2η dev D + ζ tr(D) I [Pa], D = ½ (L + Lᵀ), dev D = D − ⅓ tr(D) I in every dimension."""
        twice = L + la.transpose(L)
        spherical = (self.bulk - 2 / 3 * self.shear) * la.trace(L)
        return self.shear * twice + spherical * la.identity_like(L)

    def stiffest(self, dim: int) -> Array:
        """The largest eigenvalue [Pa s] of L ↦ σ_v: 2η for shear, 2η (1 − d/3) + dζ for even expansion."""
        even = 2 * (1 - dim / 3) * self.shear + dim * self.bulk
        return jnp.asarray(even) if dim == 1 else jnp.maximum(2 * self.shear, even)


class AbstractLaw(eqx.Module):
    """The interface of any law. Laws derive from `AbstractMaterial` (elastic) or `AbstractInelastic` (with a
    history), which answer most of it."""

    measure: ClassVar[AbstractDeformationMeasure] = DeformationGradient()
    """The deformation that its particles store."""
    allows_total: ClassVar[bool] = True
    """Whether it may stand in the total description, in which the deformation is that from the start."""
    allows_averaged_volume: ClassVar[bool] = True
    """Whether the volumes of its particles may be averaged (see `AveragedVolume`)."""
    relaxes_stress: ClassVar[bool] = False
    """Whether its return map changes the stress, so that implicit solves resist by another one than the law's."""

    def hardly_changes_volume(self) -> bool:
        """Whether its bulk modulus is over 9.6 times its shear modulus (ν from 0.45 on). Default: by the attributes
        `bulk_modulus` and `shear_modulus`, no without these. It is asked only while numbers are known."""
        bulk, shear = (getattr(self, name, None) for name in ("bulk_modulus", "shear_modulus"))
        return bulk is not None and shear is not None and bool(np.any(np.asarray(bulk) > 9.6 * np.asarray(shear)))

    @abc.abstractmethod
    def initial_history(self, F: Deformation, /) -> Any:
        """The history of particles that have never yielded at a deformation, leaves of shape (p,); None without."""

    @abc.abstractmethod
    def elastic(self, history: Any) -> "AbstractElastic":
        """The elastic law at a history."""

    @abc.abstractmethod
    def return_map(self, F: Deformation, history: Any, dt: Scalar, /) -> tuple[Deformation, Any]:
        """The admissible deformation for a trial one, and the history after it.

        Args:
            F: the trial deformation [-], component first.
            history: the history before the step.
            dt: the step [s], in which what depends on the rate has flowed.
        """

    def contact_modulus(self, F: Deformation, history: Any, /) -> Float[Array, "p"]:
        """The modulus [Pa] by which contact takes its stiffness, shape (p,): the wave modulus, now or before anything
        yielded, whichever is larger. Torn material has lost its stiffness and not its mass, and walls must hold it.
        Of J alone its pressure p is added, so that explicit springs of stiffness 2 (M + p) let no pressure press a face
        by more than half a spacing."""
        now, intact = (self.elastic(a).wave_modulus(F) for a in (history, self.initial_history(F)))
        if F.ndim == 1:
            now = now + jnp.maximum(-self.elastic(history).stress(F), 0)
        return jnp.broadcast_to(jnp.maximum(now, intact), F.shape[self.measure.axes :])

    def compaction(self, history: Any, /) -> Float[Array, "p"] | float:
        """The volume that yielding has left [-], at most 1, shape (p,), where the deformation that is stored is the
        elastic part. Default: 1, of flow that keeps the volume."""
        del history
        return 1.0

    def remembers(self, history: Any, stored: Array, /) -> bool:
        """Whether a history is one of the law's: of the structure and shapes of that of particles that store this F or
        J [-], particle first."""
        initial = jax.eval_shape(lambda stored: self.initial_history(components(stored)), stored)
        if jax.tree.structure(initial) != jax.tree.structure(history):
            return False
        return all(a.shape == b.shape for a, b in zip(jax.tree.leaves(initial), jax.tree.leaves(history), strict=True))

    def viscous_part(self) -> Viscosity | None:
        """The viscosity beside the law; None without."""
        return None

    def freedom(self) -> Freedom | None:
        """Degrees of freedom of a rigid body; None for deformable laws."""
        return None

    def title(self) -> str:
        """The law's name in messages."""
        return type(self).__name__

    def inadmissible(self, or_else: str) -> tuple[str, str]:
        """Two parts of a message: the deformation that the law does not allow, and the remedy; `or_else` is what else
        helps, as the end of a sentence, and may be empty."""
        what = f"has a {self.measure.name} that {self.title()} does not allow ({self.measure.volume} ≤ 0)"
        return what, f"Reduce dt: a step must keep Δt {self.measure.rate} below 1{or_else}."


class AbstractElastic(AbstractLaw):
    """A law without a history, given by its energy density: of F in `AbstractMaterial`, of J in `AbstractVolumetric`.

    Deformations are component first: F [-] of shape (d, d, p), J [-] of shape (p,).
    """

    @abc.abstractmethod
    def energy(self, F: Deformation, /) -> Array:
        """Ψ [J/m³ of undeformed volume], shape (p,)."""

    def stress(self, F: Deformation, /) -> Deformation:
        """The energy's derivative by the deformation [Pa], of its shape: the first Piola-Kirchhoff stress P = ∂Ψ/∂F, or
        dΨ/dJ, minus the pressure. Default: the energy's gradient."""
        return jax.grad(lambda F: _density(self, F).sum())(F)

    @abc.abstractmethod
    def tangent(self, F: Deformation, /) -> AbstractTangent:
        """The stress differential at a deformation."""

    @abc.abstractmethod
    def projected_tangent(self, F: Deformation, /) -> AbstractTangent:
        """The stress differential with its negative eigenvalues set to zero."""

    @abc.abstractmethod
    def tangent_eigenvalues(self, F: Deformation, /, dim: int, *, total: bool) -> Float[Array, "m p"]:
        """Eigenvalues [Pa] of the tangent L ↦ (∂²Ψ/∂F∂F : (L F)) Fᵀ + τ Lᵀ, L = ∇v, τ = P Fᵀ, made symmetric; in the
        total description of ∂²Ψ/∂F∂F. The largest, which `stable_dt` needs, is among them."""

    def wave_modulus(self, F: Deformation) -> Float[Array, "*p"]:
        """The modulus M of pressure waves where nothing is deformed [Pa], λ + 2μ of an isotropic solid: the stress
        along an axis by a strain along it alone. One number, or one a particle where parameters differ among them. Only
        the shape of F counts."""
        alike = all(jnp.ndim(leaf) == 0 for leaf in jax.tree.leaves(self))
        of_one = self.measure.undeformed(len(F))  # len(F) is d, and not looked at by laws of J
        none = jnp.asarray(of_one, F.dtype)[..., None]
        none = jnp.broadcast_to(none, (*of_one.shape, 1 if alike else F.shape[-1]))
        if none.ndim == 1:
            return self.tangent(none)(jnp.ones_like(none))
        return self.tangent(none)(jnp.zeros_like(none).at[0, 0].set(1))[0, 0]

    def is_admissible(self, F: Deformation, /) -> Bool[Array, "p"]:
        """Whether the law is defined at a deformation, shape (p,). Default: where its energy is finite."""
        return jnp.isfinite(_density(self, F))

    def initial_history(self, F: Deformation, /) -> None:
        """None."""
        del F

    def remembers(self, history: Any, stored: Array, /) -> bool:
        del stored
        return history is None

    def elastic(self, history: None) -> "AbstractElastic":
        """The law itself."""
        del history
        return self

    def return_map(self, F: Deformation, history: None, dt: Scalar, /) -> tuple[Deformation, None]:
        """The deformation as it is."""
        del dt
        return F, history


def _density(law: AbstractElastic, F: Deformation) -> Array:
    """A law's energy, which must have the shape of one number a particle."""
    energy, batch = law.energy(F), F.shape[law.measure.axes :]
    require(
        jnp.shape(energy) == batch,
        f"{type(law).__name__}'s energy must be one number a particle, shape {batch} for {law.measure.symbol} of shape "
        f"{F.shape}, got shape {jnp.shape(energy)}: F is component first, as the functions of mpmjax.linalg expect it "
        "and those of jax.numpy.linalg do not.",
    )
    return energy


class AbstractInelastic(AbstractLaw):
    """A law with a history: elastic within a step, and returned to what it admits at the step's end.

    F is the elastic part F_E of the deformation. A step strains it by the elastic law in force, and the return map then
    takes out of it what does not stay elastic: plastic flow, the opening of sand, a fluid's expansion. Implicit solves
    see the elastic law alone.

    The history is what a particle remembers besides F_E: a pytree of the law's own, of arrays of shape (p,). F_E is not
    the deformation from the start, and the return map would act on another volume than an averaged one: neither the
    total description nor averaged volumes are allowed.
    """

    allows_total: ClassVar[bool] = False
    allows_averaged_volume: ClassVar[bool] = False
    relaxes_stress: ClassVar[bool] = True
