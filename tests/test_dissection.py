"""Nested dissection: an order of elimination, and a factor that solves."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close

from mpmjax.extensions._dissection import Dissection, dissected_factor

BOXES = {
    "line": Dissection((90,), 3),
    "plane": Dissection((23, 14), 4),
    "two materials": Dissection((17, 12), 2, materials=2),
    "space": Dissection((13, 11, 12), 2),
    "uncut": Dissection((3, 4), 4),
}
CUT = [name for name in BOXES if name != "uncut"]


def coupled(box):
    """Which numbers are within reach of each other, shape (m, m)."""
    places = np.stack(np.unravel_index(np.arange(box.size) // box.materials, box.shape))
    return (np.abs(places[:, :, None] - places[:, None]) <= box.reach).all(axis=0)


@pytest.mark.parametrize("name", BOXES)
def test_each_number_is_eliminated_once(name):
    box = BOXES[name]
    own = np.concatenate([level.eliminated.reshape(-1) for level in box.levels])
    np.testing.assert_array_equal(np.sort(own[own < box.size]), np.arange(box.size))
    assert len(box.levels) > 1 if name in CUT else len(box.levels) == 1
    assert box.levels[-1].border.size == 0


@pytest.mark.parametrize("name", CUT)
def test_a_front_is_coupled_with_nothing_later_but_its_border(name):
    box = BOXES[name]
    near, gone = coupled(box), np.zeros(box.size, bool)
    for level in box.levels:
        fronts = [
            (own[own < box.size], border[border < box.size])
            for own, border in zip(level.eliminated, level.border, strict=True)
        ]
        for (one, border), (other, _) in itertools.permutations(fronts, 2):
            assert not near[np.ix_(one, other)].any()
            assert not np.isin(other, border).any()
        for own, border in fronts:
            later = ~gone
            later[own] = later[border] = False
            assert not near[np.ix_(own, np.flatnonzero(later))].any()
        for own, _ in fronts:
            gone[own] = True
    assert gone.all()


@pytest.mark.parametrize("name", BOXES)
def test_the_factor_solves_and_is_as_large_as_was_said(name):
    box = BOXES[name]
    rng = np.random.default_rng(0)
    S = np.where(coupled(box), rng.normal(size=(box.size,) * 2), 0)
    S = S + S.T + np.diag(2 * np.abs(S).sum(axis=1))
    held = jnp.pad(jnp.asarray(S), (0, 1))  # a number past the last has zeros
    right = rng.normal(size=(3, box.size))

    @jax.jit
    def solved(held, right):
        factor = dissected_factor(box, lambda rows, columns: held[rows[:, None], columns])
        return factor, jax.vmap(factor.solve)(right)

    factor, solution = solved(held, jnp.asarray(right))
    assert_close(solution, np.linalg.solve(S, right.T).T, 1e-12)
    assert sum(block.size for block in (*factor.inverse, *factor.below)) == box.entries


def test_it_is_smaller_than_a_band():
    """The factor of a band matrix of blocks of `reach` planes has 2 K b² numbers."""
    for d, side in ((2, 100), (3, 22)):
        band = 2 * -(-side // 4) * (4 * side ** (d - 1)) ** 2
        assert Dissection((side,) * d, 4).entries < 0.55 * band
