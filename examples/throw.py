# %% [markdown]
# A throw at a target: a policy moves a shovel with a soft ball on it, by where ball and target are, and is trained at
# three targets by derivatives through the throw, contact and flight included. It is then asked about a fourth.
# `--quick` is the size for tests.

# %%
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from matplotlib.collections import PolyCollection

import mpmjax as mpm

QUICK = "--quick" in sys.argv
DT, STEPS, ITERATIONS = 2.5e-3, 280, 2 if QUICK else 90
RELEASE = 0.3  # s, when the shovel stands still again

grid = mpm.Grid(shape=(44, 30), spacing=0.05, origin=(-8, -6))
ball = mpm.fill(mpm.Ball((0.0, 0.1), 0.1), grid, particles_per_cell=4, density=1e3)
shovel = mpm.geometry.Union((mpm.Box((-0.3, -0.2), (0.25, 0.0)), mpm.Box((-0.3, -0.2), (-0.1, 0.2))))
scene = mpm.Scene(
    grid,
    mpm.NeoHookean(3e4, 0.3),
    gravity=(0.0, -9.81),
    boundary=mpm.SeparatingCollider(shovel, mpm.geometry.still(2), friction=0.3),
)


# %%
class Thrower(eqx.Module):
    """From the time, the ball and the target to the velocity of the shovel; the memory is where the shovel is."""

    network: eqx.nn.MLP
    target: jax.Array

    def __call__(self, scene, particles, t, dt, memory):
        middle, speed = particles.x.mean(axis=0), particles.v.mean(axis=0)
        seen = jnp.concatenate([jnp.stack([t / RELEASE]), middle - memory, speed / 3, self.target])
        swing = jnp.where(t < RELEASE, jnp.sin(jnp.pi * jnp.minimum(t / RELEASE, 1)) ** 2, 0)
        ahead = memory + dt * swing * (jnp.asarray([2.5, 3.0]) + 3 * self.network(seen))
        motion = mpm.Motion(jnp.stack([t, t + dt]), jnp.stack([memory, ahead]))
        return eqx.tree_at(lambda s: s.boundary[0].motion, scene, motion), particles, ahead


def throw(network, target, **saved):
    thrower = Thrower(network, target)
    return mpm.simulate(scene, ball, t1=STEPS * DT, dt=DT, control=thrower, memory=jnp.zeros(2), **saved)


def miss(network, target):
    """How far the ball's centre is from the target at the end [m]."""
    return jnp.linalg.norm(throw(network, target).final.x.mean(axis=0) - target)


targets = jnp.asarray([[0.8, 0.3], [1.2, 0.3], [1.2, 0.7]])
unseen = jnp.asarray([1.0, 0.45])


@eqx.filter_jit
def improved(network, state):
    def misses(network):
        return (jax.vmap(lambda target: miss(network, target))(targets) ** 2).mean()

    value, slope = eqx.filter_value_and_grad(misses)(network)
    updates, state = optimiser.update(slope, state)
    return eqx.apply_updates(network, updates), state, jnp.sqrt(value)


network = eqx.nn.MLP(7, 2, 16, 1, jnp.tanh, key=jax.random.key(1))
optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(optax.cosine_decay_schedule(3e-2, ITERATIONS)))
state, history = optimiser.init(eqx.filter(network, eqx.is_array)), []
for _ in range(ITERATIONS):
    network, state, value = improved(network, state)
    history.append(float(value))
    print(f"throw {len(history)}: {100 * history[-1]:.1f} cm off", flush=True)

# %%
figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
corners = np.sqrt(np.asarray(ball.volume))[:, None, None] / 2 * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
for number, target in enumerate([*targets, unseen]):
    run = throw(network, target, save_every=STEPS // 7)
    colour, x = f"C{number}", np.asarray(run.frames.x)
    squares = x[:, :, None] + np.einsum("tpij,pkj->tpki", run.frames.F, corners)  # which deform with their particles
    axes.add_collection(PolyCollection(squares.reshape(-1, 4, 2), facecolors=colour, antialiaseds=False, alpha=0.4))
    axes.plot(*x.mean(axis=1).T, color=colour, lw=1)
    axes.plot(*target, marker="x" if number < 3 else "+", ms=12, mew=2, color="k", zorder=3)
    print(f"{'trained' if number < 3 else 'unseen'} target {target} m: {100 * float(miss(network, target)):.1f} cm off")
axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="x: trained at, +: never seen")
figure.savefig("throw.png", dpi=110)
assert history[-1] < history[0]
assert QUICK or float(miss(network, unseen)) < 0.1
