# %% [markdown]
# A soft body learns to walk: six muscles on two legs and a back, a policy that sees the clock and how its parts move,
# and optax, which takes the derivative of the distance through the whole run. `--quick` is the size for tests.

# %%
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

import mpmjax as mpm

QUICK = "--quick" in sys.argv
DT, STEPS, ITERATIONS = 4e-3, 150 if QUICK else 500, 3 if QUICK else 80

grid = mpm.Grid(shape=(36, 12), spacing=0.1, origin=(-6, -3))
body = mpm.geometry.Union(
    (mpm.Box((0.0, 0.2), (1.0, 0.4)), mpm.Box((0.0, 0.0), (0.2, 0.2)), mpm.Box((0.8, 0.0), (1.0, 0.2)))
)
particles = mpm.fill(body, grid, particles_per_cell=4, density=1e3)
x, y = np.asarray(particles.x).T
leg, right = y < 0.2, x > 0.5
# the muscles: each leg has one before and one behind, the back one above and one below
muscle = np.where(leg, 2 * right + (np.where(right, x - 0.8, x) > 0.1), 4 + (y > 0.3))
flesh = mpm.extensions.Active(mpm.NeoHookean(5e4, 0.3), strength=3e4, angle=np.pi / 2 * leg)  # up in the legs
ground = mpm.ContactPlane(1, 0.0, friction=0.8)
scene = mpm.Scene(grid, flesh, gravity=(0.0, -9.81), boundary=ground)


# %%
class Policy(eqx.Module):
    """From the clock and the velocities of the six muscles to their activations."""

    network: eqx.nn.MLP

    def __call__(self, scene, particles, t, dt, memory):
        members = jax.nn.one_hot(muscle, 6, axis=0) / np.bincount(muscle)[:, None]
        clock = jnp.stack([jnp.sin(k * 2 * jnp.pi * 1.5 * t + phase) for k in (1, 2) for phase in (0.0, jnp.pi / 2)])
        seen = jnp.concatenate([clock, (members @ particles.v).ravel()])
        activation = jax.nn.sigmoid(3 * self.network(seen))
        soft = jnp.minimum(1.0, t / 0.1)  # no jump at the start
        return scene, eqx.tree_at(lambda q: q.history.activation, particles, soft * activation[muscle]), memory


def walk(policy, **saved):
    return mpm.simulate(scene, particles, t1=STEPS * DT, dt=DT, control=policy, **saved)


@eqx.filter_jit
def improved(policy, state):
    value, slope = eqx.filter_value_and_grad(lambda policy: -walk(policy).final.x[:, 0].mean())(policy)
    updates, state = optimiser.update(slope, state)
    return eqx.apply_updates(policy, updates), state, -value


policy = Policy(eqx.nn.MLP(4 + 12, 6, 16, 1, jnp.tanh, key=jax.random.key(0)))
optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(optax.cosine_decay_schedule(1e-2, ITERATIONS)))
state, places, best = optimiser.init(eqx.filter(policy, eqx.is_array)), [], policy
for _ in range(ITERATIONS):
    tried = policy
    policy, state, place = improved(tried, state)
    places.append(float(place))
    best = tried if places[-1] == max(places) else best  # steps of feet make the distance rough
    print(f"trial {len(places)}: {places[-1] - x.mean():+.3f} m", flush=True)

# %%
run = walk(best, save_every=STEPS // (5 if QUICK else 50))
mpm.render(run, "soft_walker.gif", colour="activation", dpi=60)
mpm.save("soft_walker.vtkhdf", run)
reached = float(run.final.x[:, 0].mean()) - x.mean()
print(f"{reached:.2f} m in {STEPS * DT:g} s")
assert max(places) > places[0]
assert QUICK or reached > 0.4
