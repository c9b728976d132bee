"""Annotations are checked at every call of a function of the package."""

import jax.numpy as jnp
import jaxtyping
import pytest
from annotations import checked
from beartype.roar import BeartypeCallHintViolation

from mpmjax._types import Array, Float
from mpmjax.boundary import ContactInfo
from mpmjax.discretisation import Stencil, gather


@checked
def transposed(x: Float[Array, "n d"], y: Float[Array, "n"] | None = None) -> Float[Array, "d n"]:
    return x.T if y is None else y


def test_a_checked_function_is_itself():
    assert transposed(jnp.ones((2, 3))).shape == (3, 2)
    for arguments in ((jnp.ones(2),), (jnp.ones((2, 3)), jnp.ones(3)), (jnp.ones((2, 3)), jnp.ones(2))):
        with pytest.raises(BeartypeCallHintViolation):  # an argument's axes, axes that differ, the result's
            transposed(*arguments)


def test_functions_and_classes_of_the_package_are_checked():
    with pytest.raises(BeartypeCallHintViolation):
        gather(Stencil, jnp.ones(3))
    with pytest.raises(jaxtyping.TypeCheckError):
        ContactInfo(jnp.ones(3), jnp.ones(3))
