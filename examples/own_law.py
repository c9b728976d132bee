# %% [markdown]
# A law of one's own is its energy: Gent's rubber, whose chains can be stretched so far and no farther. An implicit run,
# its gradient with respect to the limit, and its file.

# %%
import equinox as eqx
import jax
import jax.numpy as jnp

import mpmjax as mpm
from mpmjax.verification import check_law


@mpm.register  # so that files can hold it
class Gent(mpm.AbstractMaterial):
    """Gent's rubber in plane strain (Rubber Chem. Technol. 69 (1996) 59, doi 10.5254/1.3538357)."""

    shear_modulus: float | jax.Array
    bulk_modulus: float | jax.Array
    limit: float | jax.Array

    def energy(self, F):
        """Ψ = −μ J_m/2 ln(1 − (F : F − d)/J_m) − μ ln J + K/2 (J − 1)²."""
        J, stretch = mpm.linalg.determinant(F), mpm.linalg.double_dot(F, F) - F.shape[0]
        chains = -self.limit / 2 * jnp.log(1 - stretch / self.limit) - jnp.log(J)
        return self.shear_modulus * chains + self.bulk_modulus / 2 * (J - 1) ** 2


check_law(Gent(1e5, 1e6, 3.0), dim=2)  # the derivatives are finite, at F = I too
grid = mpm.Grid(shape=(22, 22), spacing=0.1, origin=(-6, -6))
rubber = mpm.fill(mpm.Box((0.2, 0.2), (0.8, 0.8)), grid, particles_per_cell=4, density=1e3)
thrown = eqx.tree_at(lambda q: q.v, rubber, 12 * (rubber.x - 0.5) * jnp.array([1.0, -1.0]))  # pulled apart, pressed
scene = mpm.Scene(grid, Gent(shear_modulus=1e5, bulk_modulus=1e6, limit=3.0))


# %%
def width(limit):
    """The mean square of what lies across, at the end."""
    stiffer = eqx.tree_at(lambda s: s.material.limit, scene, limit)
    final = mpm.simulate(stiffer, thrown, t1=0.05, dt=2.5e-3, method=mpm.SemiImplicit()).final
    return ((final.x[:, 0] - 0.5) ** 2).mean()


slope, h = jax.grad(width)(3.0), 0.03
difference = (width(3.0 + h) - width(3.0 - h)) / (2 * h)
print(f"d(width²)/d(limit) = {slope:.5g} m², by a difference {difference:.5g} m²")
assert abs(slope / difference - 1) < 0.01

# %%
mpm.save("rubber.h5", mpm.simulate(scene, thrown, t1=0.05, dt=2.5e-3, method=mpm.SemiImplicit()))
assert isinstance(mpm.load("rubber.h5").scene.material, Gent)
