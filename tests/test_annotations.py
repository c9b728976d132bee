"""Annotations are checked at every call, of functions within functions too, whose checks are compiled once."""

import jax.numpy as jnp
import jaxtyping
import pytest
from annotations import checked

from mpmjax._types import Array, Float
from mpmjax.discretisation import Stencil, gather


def scaled_by(factor):
    """A function within a function, defined anew at each call."""

    @jaxtyping.jaxtyped(typechecker=checked)
    def scaled(x: Float[Array, "n d"], y: Float[Array, "n"] | None = None) -> Float[Array, "d n"]:
        return factor * (x.T if y is None else y)

    return scaled


def test_a_function_defined_anew_is_checked_and_is_itself():
    first, second = scaled_by(2.0), scaled_by(3.0)
    assert float(first(jnp.ones((2, 3))).sum()) == 12
    assert float(second(jnp.ones((2, 3))).sum()) == 18
    for function in (first, second, scaled_by(4.0)):
        for arguments in ((jnp.ones(2),), (jnp.ones((2, 3)), jnp.ones(3)), (jnp.ones((2, 3)), jnp.ones(2))):
            with pytest.raises(jaxtyping.TypeCheckError):  # an argument's axes, axes that differ, the result's
                function(*arguments)


def test_functions_of_the_package_are_checked():
    with pytest.raises(jaxtyping.TypeCheckError):
        gather(Stencil, jnp.ones(3))
