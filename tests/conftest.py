"""Settings of every test: 64-bit numbers, strict dtype promotion, array shapes and dtypes checked at every call."""

import matplotlib

matplotlib.use("Agg")

import jax
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")

with install_import_hook("mpmjax", "beartype.beartype"):
    import mpmjax  # noqa: F401
