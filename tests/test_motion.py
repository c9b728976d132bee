"""Rigid motions: exact places and velocities, and derivatives that hold at no rotation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, thorough
from scipy.spatial.transform import Rotation

import mpmjax as mpm
from mpmjax.checks._values import canonical

TIMES = (0.0, 1.0, 3.0)
MOTIONS = {
    2: mpm.RigidMotion(TIMES, ((0.0, 0.0), (0.2, -0.1), (0.3, 0.4)), (0.0, 1.0, -2.0), (0.1, 0.2)),
    3: mpm.RigidMotion(
        TIMES,
        ((0.0,) * 3, (0.2, -0.1, 0.3), (0.3, 0.4, 0.0)),
        ((0.0,) * 3, (1.0, 0.5, -0.7), (0.0, 2.0, 2.0)),
        (0.1,) * 3,
    ),
}
EACH = pytest.mark.parametrize("motion", [MOTIONS[2], *thorough(MOTIONS[3])], ids=["2d", "3d"])


def place(motion, X, t):
    """By SciPy's rotations."""
    d = motion.dim
    rotation = np.array([np.interp(t, TIMES, r) for r in np.asarray(motion.rotation).reshape(3, -1).T])
    vector = rotation if d == 3 else np.array([0, 0, rotation[0]])
    R = Rotation.from_rotvec(vector).as_matrix()[:d, :d]
    shift = np.array([np.interp(t, TIMES, c) for c in np.asarray(motion.displacement).T])
    return np.asarray(motion.centre) + shift + (X - np.asarray(motion.centre)) @ R.T, R


@EACH
def test_points_move_as_prescribed(motion):
    """The velocity takes a point to its place after the step, however large and across corners; the origin is where it
    came from; vectors turn along."""
    X = np.random.default_rng(0).normal(size=(7, motion.dim))
    for t, dt in [(0.0, 0.5), (0.4, 1e-3), (0.5, 2.0), (2.9, 0.5), (5.0, 1.0)]:
        here, R = place(motion, X, t)
        there, _ = place(motion, X, t + dt)
        assert_close(motion.velocity_of(jnp.asarray(X), t, dt) * dt, there - here, 1e-13, 1e-15)
        assert_close(motion.origin(jnp.asarray(here), t), X, 1e-14)
        assert_close(motion.turned(jnp.asarray(X), t), X @ R.T, 1e-14)
        assert_close(motion.pivot(jnp.ones(motion.dim), t), place(motion, np.asarray(motion.centre), t)[0], 1e-14)


def test_without_rotation_it_is_the_plain_motion():
    plain = mpm.Motion(TIMES, MOTIONS[3].displacement)
    rigid = mpm.RigidMotion(TIMES, MOTIONS[3].displacement, np.zeros((3, 3)), (0.1, 0.2, 0.3))
    X = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3)))
    for f in (lambda m: m.origin(X, 0.7), lambda m: m.turned(X, 0.7), lambda m: m.velocity_of(X, 0.7, 0.9)):
        assert_close(f(plain), f(rigid), 1e-14)


@EACH
@pytest.mark.parametrize("scale", [0.0, *thorough(1e-8, 0.02, 0.0316, 0.0317), 1.0])
def test_its_derivatives_are_right_at_no_rotation_too(motion, scale):
    """First and second, against central differences of places and of first derivatives."""
    X = jnp.asarray(np.random.default_rng(1).normal(size=(4, motion.dim)))
    rest = jnp.asarray(motion.rotation)[1:]

    def velocity(r):
        rotation = jnp.concatenate([scale * r[None], rest])
        return mpm.RigidMotion(TIMES, motion.displacement, rotation, motion.centre).turned(X, 0.0).ravel()

    at = jnp.asarray(motion.rotation)[1] / jnp.linalg.norm(jnp.atleast_1d(jnp.asarray(motion.rotation)[1]))
    step = 1e-5
    for f in (velocity, lambda r: jax.jacfwd(velocity)(r).ravel()):
        exact = jax.jacfwd(f)(at).reshape(-1, at.size)
        moved = [jnp.asarray(at + s * e.reshape(at.shape)) for e in np.eye(at.size) for s in (step, -step)]
        difference = [(f(a) - f(b)) / (2 * step) for a, b in zip(moved[::2], moved[1::2], strict=True)]
        assert_close(exact, jnp.stack(difference, axis=1), 1e-6, 1e-9)
    assert_close(jax.jacrev(velocity)(at), jax.jacfwd(velocity)(at), 1e-12, 1e-15)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rotation": (0.0, 1.0)}, "rotation must have shape"),
        ({"rotation": np.zeros((3, 1))}, "rotation must have shape"),
        ({"centre": (0.0,) * 3}, "centre must have 2 coordinates"),
        ({"times": (0.0, 0.0, 1.0)}, "times must increase"),
        ({"displacement": np.zeros((3, 1)), "centre": (0.0,)}, "take a Motion"),
    ],
)
def test_bad_motions_are_refused(change, message):
    data = {"times": TIMES, "displacement": np.zeros((3, 2)), "rotation": np.zeros(3), "centre": (0.0, 0.0)}
    with pytest.raises(ValueError, match=message):
        mpm.RigidMotion(**data | change)


@pytest.mark.thorough
@EACH
def test_in_single_precision_small_steps_have_the_speed_of_large_ones(motion):
    """Where the difference of two places would keep three digits of it, or none."""
    X = jnp.asarray(np.random.default_rng(0).normal(size=(7, motion.dim)))
    for t in (0.3, 2.1):
        exact = motion.velocity_of(X, t, 1e-7)
        for dt in (1e-4, 1e-6):
            found = canonical(motion, jnp.float32).velocity_of(X.astype(jnp.float32), np.float32(t), np.float32(dt))
            assert_close(found, exact, 1e-6 + 5 * dt)
