# %% [markdown]
# A jelly block falls on a floor; the gradient of where it ends up with respect to its stiffness.

# %%
import equinox as eqx
import jax

import mpmjax as mpm

grid = mpm.Grid(shape=(48, 48), spacing=1 / 32)
jelly = mpm.fill(mpm.Box((0.3, 0.5), (0.7, 0.9)), grid, particles_per_cell=4, density=1e3)
scene = mpm.Scene(
    grid,
    mpm.FixedCorotated(youngs_modulus=1e5, poisson_ratio=0.3),
    gravity=(0.0, -9.81),
    boundary=mpm.SlipBox((0.125, 0.125), (1.375, 1.375)),
)
run = mpm.simulate(scene, jelly, t1=0.5, dt=5e-3, method=mpm.SemiImplicit(beta=1.0), save_every=5)
mpm.save("jelly.vtkhdf", run)  # opens in ParaView as it is


# %%
def height(stiffness):
    softer = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, stiffness)
    return mpm.simulate(softer, jelly, t1=0.5, dt=5e-3, method=mpm.SemiImplicit()).final.x[:, 1].mean()


slope = jax.grad(height)(1e5)
print(f"d(mean height)/dE = {slope:.4g} m/Pa")
assert abs(slope + 6.18e-7) < 0.02e-7
