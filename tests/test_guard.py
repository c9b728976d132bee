"""The guard: no number and no derivative of what is guarded without its check."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FORWARD, REVERSE, SECOND, ids

from mpmjax.autodiff._guard import guard


def guarded(x):
    """sin x, at fault beyond 1 and, in another way, beyond 2."""
    fault = jnp.where(x > 2, 2, jnp.where(x > 1, 1, 0)).astype(jnp.int32)
    tree, _ = guard({"y": jnp.sin(x), "n": jnp.asarray(3)}, jnp.zeros(()), fault, ["x is large", "x is huge"], "")
    return tree["y"]


@pytest.mark.parametrize("transform", **ids(REVERSE | FORWARD | SECOND))
def test_every_transformation_raises_what_is_at_fault_and_changes_nothing_else(transform):
    """Bit for bit where nothing is wrong; the fault by its number where something is."""
    run = transform(guarded)
    np.testing.assert_array_equal(run(0.5), transform(jnp.sin)(0.5))
    with pytest.raises(Exception, match="x is large"):  # of eager programs a RuntimeError, of others as jax says
        run(1.5)
    with pytest.raises(Exception, match="x is huge"):
        run(2.5)


@pytest.mark.parametrize("jit", [jax.jit, eqx.filter_jit])
def test_what_a_compiled_program_says_ends_with_the_fault(jit):
    """After JAX's trace of the callback; no advice on another kind of jit follows."""
    with pytest.raises(RuntimeError, match=r"\nRuntimeError: x is large(\n-+\nFor simplicity, JAX[^\n]*)?$"):
        jit(guarded)(jnp.asarray(1.5)).block_until_ready()


def test_what_is_not_used_is_not_checked():
    """A derivative that does not depend on the outcome is not stopped by it."""
    assert jax.jit(jax.grad(lambda x: 2 * x + 0 * jax.lax.stop_gradient(guarded(0.5))))(1.5) == 2


def test_only_derivatives_ask_the_signal():
    """Its primal says nothing; its tangent and its cotangent raise, with their size where it is known."""

    def through(x, s):
        return guard(x, s, jnp.asarray(0, jnp.int32), [], "not solved.")

    none, one = jnp.zeros(()), jnp.ones(())
    assert through(one, one)[0] == 1
    with pytest.raises(RuntimeError, match=r"not solved. The relative residual was 0.25"):
        jax.jvp(through, (one, none), (one, one / 4))
    with pytest.raises(RuntimeError, match="not solved"):
        jax.jit(lambda: jax.jvp(through, (one, none), (one, one / 4)))()
    _, back = jax.vjp(through, one, none)
    assert back((one, none))[0] == 1
    with pytest.raises(RuntimeError, match="not solved"):
        back((one, one / 4))


def test_it_calls_the_host_in_no_program_without_derivative_or_fault():
    """The signal's check alone, at the inlet of a rollout, keeps a program in the cache of compiled ones."""
    through = eqx.filter_jit(lambda x: guard(x, jnp.zeros(()), jnp.asarray(0, jnp.int32), [], "not solved."))
    assert "callback" not in through.lower(jnp.ones(3)).as_text()
