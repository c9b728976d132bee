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
from mpmjax.material._differential import (
    AbstractDifferential,
    IsotropicDifferential,
    MatrixDifferential,
    PrincipalDifferential,
    is_isotropic,
    projected_matrix,
)


class DeformationMeasure(NamedTuple):
    """The measure of deformation that a law's particles store, and how the motion of the grid changes it: the
    deformation gradient F or its elastic part [-], shape (d, d, p), or J = det F [-] alone, shape (p,)."""

    axes: int  # how many axes one particle's deformation has: 2 of F, none of J
    symbol: str  # in messages, what is stored; `name` says what it is
    name: str  # in messages, what the symbol stands for
    volume: str  # in messages, what most laws need to be positive
    rate: str  # in messages, the rate [1/s] whose product with a step must be below 1

    def undeformed(self, dim: int) -> np.ndarray:
        """The deformation of one particle at rest [-], of one particle's shape."""
        return np.eye(dim) if self.axes else np.ones(())

    def of(self, F: Matrix) -> Deformation:
        """The stored deformation at deformation gradients [-], shape (d, d, p)."""
        return F if self.axes else la.determinant(F)

    def change(self, gradient: Matrix, deformation: Deformation) -> Deformation:
        """∇u F or tr(∇u) J [-], the change by the gradient ∇u of a displacement, shape (d, d, p), to first order."""
        return la.matmul(gradient, deformation) if self.axes else la.trace(gradient) * deformation

    def kirchhoff_stress(self, stress: Deformation, deformation: Deformation, dim: int) -> Matrix:
        """τ = P Fᵀ or dΨ/dJ J I [Pa], shape (d, d, p), by the energy's derivative with respect to the deformation: the
        transpose of `change`. The nodal force is f_i = −Σ_p V0_p τ_p g_ip."""
        if self.axes:
            return la.matmul(stress, la.transpose(deformation))
        return stress * deformation * jnp.eye(dim, dtype=deformation.dtype)[..., None]

    def determinant(self, deformation: Deformation) -> Array:
        """J = det F [-], shape (p,)."""
        return la.determinant(deformation) if self.axes else deformation

    def collapsed(self, deformation: Deformation, least: float) -> Bool[Array, "p"]:
        """Whether the smallest principal stretch, or J, is below the least one that is allowed [-], shape (p,)."""
        if not self.axes:
            return jnp.abs(deformation) <= least
        # 1/‖F⁻¹‖ lies between the smallest stretch and 1/√d of it, and needs no eigenvalues
        cofactor = la.cofactor(deformation)
        return la.determinant(deformation) ** 2 <= least**2 * la.double_dot(cofactor, cofactor)


DEFORMATION_GRADIENT = DeformationMeasure(2, "F", "deformation gradient", "det F", "|∇v|")
VOLUME_RATIO = DeformationMeasure(0, "J", "volume", "J", "|div v|")


class Viscosity(eqx.Module):
    """A Newtonian viscous stress, linear in the velocity gradient L = ∇_x v."""

    shear: PerParticle  # η [Pa s]
    bulk: PerParticle  # ζ [Pa s]

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

    measure: ClassVar[DeformationMeasure] = DEFORMATION_GRADIENT  # the deformation that its particles store
    allows_total: ClassVar[bool] = True
    """Whether it may stand in the total description, in which the deformation is that from the start."""
    allows_averaged_volume: ClassVar[bool] = True
    """Whether the volumes of its particles may be averaged (see `AveragedVolume`)."""
    relaxes_stress: ClassVar[bool] = False
    """Whether its return map changes the stress, so that implicit solves resist by another one than the law's."""
    viscosity: ClassVar[Viscosity | None] = None  # the viscosity beside the law
    constraint: ClassVar[Any] = None
    """The constraint on how a body of it moves, an `mpmjax.state.AbstractConstraint`, as a method of the material's
    number and of its layer of nodes. None of what deforms freely."""

    @property
    def flows(self) -> bool:
        """Whether it bears a pressure alone at rest, but for a yield stress: `SeparatingBox` then holds it by planes.
        Default: of J alone."""
        return not self.measure.axes

    def hardly_changes_volume(self) -> bool:
        """Whether its bulk modulus is over 9.6 times its shear modulus (ν from 0.45 on). Default: by the attributes
        `bulk_modulus` and `shear_modulus`, no without these. It is asked only while numbers are known."""
        bulk, shear = (getattr(self, name, None) for name in ("bulk_modulus", "shear_modulus"))
        return bulk is not None and shear is not None and bool(np.any(np.asarray(bulk) > 9.6 * np.asarray(shear)))

    @abc.abstractmethod
    def initial_history(self, F: Deformation, /) -> Any:
        """The history of particles that have never yielded at a deformation, leaves of shape (p,); None without."""

    @abc.abstractmethod
    def elastic(self, history: Any) -> "AbstractMaterial":
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
        modulus = self.elastic(history).wave_modulus(F)
        if F.ndim == 1:
            modulus = modulus + jnp.maximum(-self.elastic(history).stress(F), 0)
        if history is not None:
            modulus = jnp.maximum(modulus, self.elastic(self.initial_history(F)).wave_modulus(F))
        return jnp.broadcast_to(modulus, F.shape[self.measure.axes :])

    def compaction(self, history: Any, /) -> Float[Array, "p"] | float:
        """The volume that yielding has left [-], at most 1, shape (p,), where the deformation that is stored is the
        elastic part. Default: 1, of flow that keeps the volume."""
        return 1.0

    def remembers(self, history: Any, stored: Array, /) -> bool:
        """Whether a history is one of the law's: of the structure and shapes of that of particles that store this F or
        J [-], particle first."""
        initial = jax.eval_shape(lambda stored: self.initial_history(components(stored)), stored)
        if jax.tree.structure(initial) != jax.tree.structure(history):
            return False
        return all(a.shape == b.shape for a, b in zip(jax.tree.leaves(initial), jax.tree.leaves(history), strict=True))

    def title(self) -> str:
        """The law's name in messages."""
        return type(self).__name__

    def inadmissible(self, or_else: str) -> tuple[str, str]:
        """Two parts of a message: the deformation that the law does not allow, and the remedy; `or_else` is what else
        helps, as the end of a sentence, and may be empty."""
        what = f"has a {self.measure.name} that {self.title()} does not allow ({self.measure.volume} ≤ 0)"
        return what, f"Reduce dt: a step must keep Δt {self.measure.rate} below 1{or_else}."


class AbstractMaterial(AbstractLaw):
    """A hyperelastic law, given by its energy density Ψ(F).

    A law needs `energy` alone, and then works with every method, Hessian and description, and under every derivative:
    the stress is the energy's gradient, the stress differential the stress's derivative. A law that has closed forms
    overrides these methods; `mpmjax.verification.check_law` compares them with the defaults.

        class Quadratic(mpm.AbstractMaterial):
            stiffness: float

            def energy(self, F):
                C = mpm.linalg.matmul(mpm.linalg.transpose(F), F)
                E = (C - mpm.linalg.identity_like(F)) / 2
                return self.stiffness * mpm.linalg.double_dot(E, E)

    Matrices are component first, (d, d, p), and so an energy is written with the functions of `mpmjax.linalg`
    (`determinant`, `double_dot`, `matmul`, ...): those of `jax.numpy.linalg` take the last two axes, which are not the
    matrix. Two dimensions are plane strain, one is uniaxial strain.

    Parameters are fields, each one number or one for each particle, shape (p,), or a tuple of such. Each is a leaf that
    can be differentiated and batched.

    *When it breaks*: implicit steps take second derivatives of Ψ, and gradients through them third ones, which must be
    finite wherever the body goes, F = I first of all. Polynomials of F, invariants and functions of them have these
    derivatives. What is written in eigenvalues or singular values has not, where stretches coincide; the functions of
    `mpmjax.linalg` (`rotation`, `Logarithm`) have. Roots such as ‖F − R‖ have a kink at rest.
    """

    @abc.abstractmethod
    def energy(self, F: Deformation, /) -> Array:
        """Ψ [J/m³ of undeformed volume], shape (p,)."""

    def in_space(self, F: Deformation, /) -> tuple["AbstractMaterial", Deformation]:
        """The law and the deformation in three dimensions, (3, 3, p), of which F is the part in the plane or along the
        line. Default: the other stretches are 1. A law of J is in space as it is."""
        if not self.measure.axes:
            return self, F
        d, whole = len(F), jnp.broadcast_to(jnp.eye(3, dtype=F.dtype)[..., None], (3, 3, *F.shape[2:]))
        return self, whole.at[:d, :d].set(F)

    def stress(self, F: Deformation, /) -> Deformation:
        """The energy's derivative by the deformation [Pa], of its shape: the first Piola-Kirchhoff stress P = ∂Ψ/∂F, or
        dΨ/dJ, minus the pressure. Default: the energy's gradient."""
        return jax.grad(lambda F: _density(self, F).sum())(F)

    def kirchhoff_numbers(self, F: Matrix, /) -> tuple[Float[Array, "p"], Float[Array, "p"]] | None:
        """Numbers q and r [Pa] of each particle, shape (p,), with τ = P Fᵀ = q F Fᵀ + r I: all that an explicit step
        stores of the stress then. Default: None, of a law without."""
        return None

    def stress_differential(self, F: Matrix, /) -> AbstractDifferential:
        """The stress differential ∂²Ψ/∂F∂F at F, a symmetric map. Default: the derivative of the stress, of a law with
        a closed form of `principal_differential` in one direction at a time, else in each of d² as a matrix."""
        if type(self).principal_differential is not AbstractMaterial.principal_differential:
            return IsotropicDifferential(self, F)
        return MatrixDifferential(la.matrix_of(lambda dF: jax.jvp(self.stress, (F,), (dF,))[1], F))

    def principal_differential(self, s: Float[Array, "d *p"]) -> PrincipalDifferential:
        """The eigenstructure of the stress differential at signed principal stretches, which `stable_dt` and
        `AnalyticHessian(projected=True)` need.

        Default: of the stress differential A at F = diag(s), twist A_ijij − A_ijji, flip A_ijij + A_ijji, scaling
        A_iijj. No quotient is formed, so it is as finite as A is, at repeated stretches too.

        *When it breaks*: an anisotropic law has no such eigenstructure. Where a rotation of the material changes the
        energy, by a ten-thousandth of itself or more at one deformation that keeps the volume, the default is NaN, and
        `stable_dt` and the projected Hessian refuse the law. Give it a step as a number and `AnalyticHessian()`.

        Args:
            s: signed principal stretches [-], shape (d, *p).
        """
        F = la.diagonal(s)
        A, d = la.matrix_of(self.stress_differential(F), F), len(s)
        A = jnp.where(is_isotropic(self, F), A, jnp.nan)

        def entry(i: int, j: int, k: int, l: int) -> Array:  # noqa: E741
            return A[i * d + j, k * d + l]

        return PrincipalDifferential.of(
            s,
            twist=lambda i, j: (entry(i, j, i, j) + entry(j, i, j, i)) / 2 - entry(i, j, j, i),
            flip=lambda i, j: (entry(i, j, i, j) + entry(j, i, j, i)) / 2 + entry(i, j, j, i),
            scaling=lambda i, j: entry(i, i, j, j),
        )

    def projected_differential(self, F: Matrix, /) -> AbstractDifferential:
        """The stress differential with its negative eigenvalues set to zero (J. Teran, E. Sifakis, G. Irving,
        R. Fedkiw, SCA 2005, doi 10.1145/1073368.1073394): of the positive semi-definite maps, the nearest to it.

        *When it breaks*: the law must be isotropic; where it has no `principal_differential` of its own and is not, a
        `RuntimeError` says so. Second derivatives are refused. Where an eigenvalue is zero the map has a kink; the
        derivative is the mean of both sides, that of a central difference. At F = I all twists are zero.
        """
        if type(self).principal_differential is AbstractMaterial.principal_differential:
            name = type(self).__name__
            F = eqx.error_if(
                F,
                ~is_isotropic(self, F),
                f"{name} is not isotropic, and the projected Hessian needs a law that is: take AnalyticHessian() "
                f"without projection or JvpHessian(), or write {name}'s energy in invariants of FᵀF.",
            )
        return MatrixDifferential(projected_matrix(self, F))

    def stiffness_eigenvalues(self, F: Matrix, /, dim: int, *, total: bool) -> Float[Array, "m p"]:
        """Eigenvalues [Pa] of the tangent L ↦ (∂²Ψ/∂F∂F : (L F)) Fᵀ + τ Lᵀ, L = ∇v, τ = P Fᵀ, made symmetric; in the
        total description of ∂²Ψ/∂F∂F. The largest, which `stable_dt` needs, is among them."""
        # in the principal frame the map is d x d on the diagonal and 2 x 2 on (L_ij, L_ji) for each pair
        _, s, _ = la.principal_frame(F)
        tangent = self.principal_differential(s)
        d = s.shape[0]
        if total:
            pull, tau = jnp.ones_like(s), jnp.zeros_like(s)
        else:
            P = self.stress(la.diagonal(s))
            pull, tau = s, s * jnp.stack([P[i, i] for i in range(d)])
        scaling = tangent.scaling * pull[:, None] * pull + la.diagonal(tau)
        values = [*la.symmetric_eigen(scaling)[0]]
        for (i, j), twist, flip in zip(la.pairs(d), tangent.twist, tangent.flip, strict=True):
            near, far = (flip + twist) / 2 * pull[j] ** 2, (flip + twist) / 2 * pull[i] ** 2
            across = (flip - twist) / 2 * pull[i] * pull[j] + (tau[i] + tau[j]) / 2
            centre, radius = (near + far) / 2, jnp.hypot((near - far) / 2, across)
            values += [centre - radius, centre + radius]
        return jnp.stack(values)

    def wave_modulus(self, F: Deformation) -> Float[Array, "*p"]:
        """The modulus M of pressure waves where nothing is deformed [Pa], λ + 2μ of an isotropic solid: the stress
        along an axis by a strain along it alone. One number, or one a particle where parameters differ among them. Only
        the shape of F counts."""
        alike = all(jnp.ndim(leaf) == 0 for leaf in jax.tree.leaves(self))
        of_one = self.measure.undeformed(len(F))  # len(F) is d, and not looked at by laws of J
        none = jnp.asarray(of_one, F.dtype)[..., None]
        none = jnp.broadcast_to(none, (*of_one.shape, 1 if alike else F.shape[-1]))
        if none.ndim == 1:
            return self.stress_differential(none)(jnp.ones_like(none))
        return self.stress_differential(none)(jnp.zeros_like(none).at[0, 0].set(1))[0, 0]

    def is_admissible(self, F: Deformation, /) -> Bool[Array, "p"]:
        """Whether the law is defined at a deformation, shape (p,). Default: where its energy is finite."""
        return jnp.isfinite(_density(self, F))

    def initial_history(self, F: Deformation, /) -> None:
        return None

    def elastic(self, history: None) -> "AbstractMaterial":
        return self

    def return_map(self, F: Deformation, history: None, dt: Scalar, /) -> tuple[Deformation, None]:
        return F, history

    def inadmissible(self, or_else: str) -> tuple[str, str]:
        what, remedy = super().inadmissible(or_else)
        instead = f"Reduce dt{or_else}, or use FixedCorotated, which allows inversion."
        return what, instead if self.measure.axes else remedy


def _density(law: AbstractMaterial, F: Deformation) -> Array:
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
