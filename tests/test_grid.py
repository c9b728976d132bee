"""The grid's window: what it is, and what it refuses."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DIMS

import mpmjax as mpm


@pytest.mark.parametrize("d", DIMS)
def test_nodes_are_the_lattice_in_c_order(d):
    """Node n of the flattened window lies at (origin + index of n) * spacing."""
    shape, origin, dx = (4, 5, 6)[:d], (-2, 3, 1)[:d], 0.25
    grid = mpm.Grid(shape, dx, origin=origin)
    assert grid.dim == d
    assert grid.size == np.prod(shape)
    nodes = grid.nodes(grid.window(jnp.zeros((1, d))))
    index = np.stack(np.unravel_index(np.arange(grid.size), shape), axis=1)
    np.testing.assert_array_equal(nodes, (index + origin) * dx)


@pytest.mark.parametrize("d", DIMS)
def test_window_stays_unless_it_follows(d):
    """At `origin`, by default zeros; with follow=True the particles' middle is the window's and `origin` is ignored."""
    x = jnp.asarray([[7.1] * d, [8.3] * d])
    np.testing.assert_array_equal(mpm.Grid((8,) * d, 0.5).window(x), 0)
    np.testing.assert_array_equal(mpm.Grid((8,) * d, 0.5, origin=(3,) * d).window(x), 3)
    # middle 7.7, that is 15.4 spacings
    np.testing.assert_array_equal(mpm.Grid((8,) * d, 0.5, origin=(3,) * d, follow=True).window(x), 15 - 4)


def test_one_bool_makes_every_direction_periodic():
    """`periodic=True` stands for all; lists become tuples, so that a grid can be hashed by its static part."""
    assert mpm.Grid((8, 8), 0.5, periodic=True).periodic == (True, True)
    grid = mpm.Grid([8, 8], 0.5, origin=[1, 2], periodic=[True, False])
    assert (grid.shape, grid.origin, grid.periodic) == ((8, 8), (1, 2), (True, False))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"shape": (8, 3)}, "shape must be at least 4, got"),
        ({"shape": ()}, "one, two or three integers"),
        ({"shape": (8, 8, 8, 8)}, "one, two or three integers"),
        ({"spacing": 0.0}, r"spacing \[m\] must be greater than zero"),
        ({"spacing": -0.5}, r"spacing \[m\] must be greater than zero"),
        ({"spacing": np.nan}, r"spacing \[m\] must be finite"),
        ({"spacing": np.inf}, r"spacing \[m\] must be finite"),
        ({"origin": (0,)}, "origin must have 2 entries"),
        ({"periodic": (True,)}, "periodic must have 2 entries"),
        ({"periodic": (True, False), "follow": True}, "periodic grid cannot follow"),
    ],
)
def test_bad_grids_are_refused(arguments, message):
    """Each with what must hold and what was got."""
    with pytest.raises(ValueError, match=message):
        mpm.Grid(**{"shape": (8, 8), "spacing": 0.5} | arguments)
