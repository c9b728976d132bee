"""The stress differential projected to positive semi-definite, with a derivative that holds at repeated stretches."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Float, Matrix
from mpmjax.autodiff import ruled
from mpmjax.material._tangent import MatrixTangent


def projected_tangent(law: Any, F: Matrix) -> MatrixTangent:
    """δP = A⁺ : δF, A⁺ being A = ∂²Ψ/∂F∂F with its negative eigenvalues set to zero (J. Teran, E. Sifakis, G. Irving,
    R. Fedkiw, SCA 2005, doi 10.1145/1073368.1073394): of the positive semi-definite maps, the nearest to A. In closed
    form: no eigenvalue problem larger than d x d is solved.

    Its first derivative with respect to F and the law's parameters is exact, at repeated stretches too: with E the
    eigenvectors of A and λ its eigenvalues, δA⁺ = E (K ∘ Eᵀ δA E) Eᵀ, K_kl = (λ_k⁺ − λ_l⁺)/(λ_k − λ_l) (J. L. Daleckii,
    S. G. Krein; N. J. Higham, Functions of Matrices, SIAM 2008, theorem 3.11, doi 10.1137/1.9780898717778), the limit
    of K being 1 where both are positive and 0 where both are negative.

    *When it breaks*: the law must be isotropic. Second derivatives are refused. Where an eigenvalue is zero A⁺ has a
    kink; the derivative given is the mean of the two sides, which is what a central difference tends to. At F = I that
    is so: all twists are zero.

    Args:
        law: a law of F, with `tangent` and `principal_tangent`.
        F: deformation gradient [-], shape (d, d, p).
    """
    return MatrixTangent(_projected_matrix(law, F))


@ruled
def _projected_matrix(law: Any, F: Matrix) -> Float[Array, "m m *p"]:
    values, modes = _spectrum(law, F)
    return _in_modes(modes, la.diagonal(jnp.maximum(values, 0)))


@_projected_matrix.defjvp
def _projected_matrix_jvp(primals: tuple[Any, Matrix], tangents: tuple[Any, Matrix | None]) -> tuple[Array, Array]:
    values, modes = _spectrum(*primals)

    def in_frame(law: Any, F: Matrix) -> Array:
        """Eᵀ A E, the frame held fixed."""
        images = jax.vmap(law.tangent(F))(modes.reshape(-1, *F.shape)).reshape(modes.shape)
        return la.matmul(modes, jnp.swapaxes(images, 0, 1))

    change = eqx.filter_jvp(in_frame, primals, tangents)[1]
    positive, size = jnp.maximum(values, 0), jnp.abs(values)
    total = size[:, None] + size
    # for every pair of signs the quotient of differences is this one of sums, which cancels nowhere
    K = jnp.where(total == 0, 0.5, (positive[:, None] + positive) / jnp.where(total == 0, 1, total))
    return _in_modes(modes, la.diagonal(positive)), _in_modes(modes, K * change)


def _spectrum(law: Any, F: Matrix) -> tuple[Float[Array, "m *p"], Float[Array, "m m *p"]]:
    """Eigenvalues λ_k of ∂²Ψ/∂F∂F and its eigenvectors E_ka, a over components in C order."""
    U, s, V = la.principal_frame(F)
    tangent = law.principal_tangent(s)
    scalings, Q = la.symmetric_eigen(tangent.scaling)
    d, modes = F.shape[0], la.principal_modes(U, V)
    modes = modes.reshape(d * d, d * d, *F.shape[2:])
    modes = jnp.concatenate([la.matmul(la.transpose(Q), modes[:d]), modes[d:]])
    return jnp.concatenate([scalings, tangent.twist, tangent.flip]), modes


def _in_modes(modes: Float[Array, "m m *p"], core: Float[Array, "m m *p"]) -> Float[Array, "m m *p"]:
    """Σ_kl E_ka core_kl E_lb."""
    return la.matmul(jnp.swapaxes(modes, 0, 1), la.matmul(core, modes))
