# %% [markdown]
# A law of one's own is its energy: soft tissue, which stiffens exponentially as it is stretched. An implicit run, its
# gradient with respect to how fast it stiffens, and its file.

# %%
import equinox as eqx
import jax
import jax.numpy as jnp

import mpmjax as mpm
from mpmjax.verification import check_law


@mpm.register  # so that files can hold it
class SoftTissue(mpm.AbstractMaterial):
    """Demiray's soft tissue in plane strain (J. Biomech. Eng. 103 (1981) 73), made compressible."""

    shear_modulus: float | jax.Array
    bulk_modulus: float | jax.Array
    stiffening: float | jax.Array

    def energy(self, F):
        """Ψ = μ/(2b) (exp(b (F : F − d)) − 1) − μ ln J + K/2 (J − 1)²."""
        J, stretch = mpm.linalg.determinant(F), mpm.linalg.double_dot(F, F) - F.shape[0]
        fibres = jnp.expm1(self.stiffening * stretch) / (2 * self.stiffening) - jnp.log(J)
        return self.shear_modulus * fibres + self.bulk_modulus / 2 * (J - 1) ** 2


check_law(SoftTissue(1e5, 1e6, 0.5), dim=2)  # the derivatives are finite, at F = I too
grid = mpm.Grid(shape=(22, 22), spacing=0.1, origin=(-6, -6))
tissue = mpm.fill(mpm.Box((0.2, 0.2), (0.8, 0.8)), grid, particles_per_cell=4, density=1e3)
thrown = eqx.tree_at(lambda q: q.v, tissue, 12 * (tissue.x - 0.5) * jnp.array([1.0, -1.0]))  # pulled apart, pressed
scene = mpm.Scene(grid, SoftTissue(shear_modulus=1e5, bulk_modulus=1e6, stiffening=0.5))


# %%
def width(stiffening):
    """The mean square of what lies across, at the end."""
    stiffer = eqx.tree_at(lambda s: s.material.stiffening, scene, stiffening)
    final = mpm.simulate(stiffer, thrown, t1=0.05, dt=2.5e-3, method=mpm.SemiImplicit()).final
    return ((final.x[:, 0] - 0.5) ** 2).mean()


slope, h = jax.grad(width)(0.5), 0.005
difference = (width(0.5 + h) - width(0.5 - h)) / (2 * h)
print(f"d(width²)/d(stiffening) = {slope:.5g} m², by a difference {difference:.5g} m²")
assert abs(slope / difference - 1) < 0.01

# %%
mpm.save("tissue.vtkhdf", mpm.simulate(scene, thrown, t1=0.05, dt=2.5e-3, method=mpm.SemiImplicit()))
assert isinstance(mpm.load("tissue.vtkhdf").scene.material, SoftTissue)
