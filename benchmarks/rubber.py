"""Rubber: which law, fitted to uniaxial tension and pure shear alone, predicts equibiaxial tension?

    python benchmarks/rubber.py               # some minutes
    python benchmarks/rubber.py --closed      # closed forms alone, some seconds
    python benchmarks/rubber.py Yeoh Gent     # these laws

Treloar's rubber (examples/data): uniaxial tension to a stretch of 7.6, pure shear to 5.0. Each law is fitted by
`mpm.fit` to simulations of both tests (one cell, see examples/rubber_laws.py), from a single start, and beside it by
SciPy's least squares to the closed form at constant volume. Both tests count by one measure, their stress [Pa]. A row
has the root mean square of what the fit leaves of the data, and the error of equibiaxial tension to a stretch of 4.1,
at most and root mean square; then the closed form's; iterations; seconds; and the values.

Ogden's terms are fitted by their shear moduli (`Ogden.with_shear_moduli`), positive: each is stable at every stretch,
which is Drucker's condition. Of three terms two have positive exponents and the third one from -10 to 0, as in the set
that Ogden published (μ 6.3e5, 1.2e3, -1e4 Pa, α 1.3, 5, -2), which is the last row. "Ogden-3, μ and α" are the six
numbers of the law as they stand, without a condition: the squares that they leave still fall, slowly, where an exponent
goes to zero and its modulus grows without bound.
"""

import argparse
import sys
import time
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

import mpmjax as mpm
from mpmjax.verification import tension

sys.path.append(str(Path(__file__).parents[1] / "examples"))
from rubber_laws import BULK, LAWS, experiment, measured

NOISE = 1e5  # of both tests [Pa]: how they are weighed, not what is claimed of them
TESTS = ("uniaxial", "pure shear")
PUBLISHED = mpm.Ogden((6.3e5, 1.2e3, -1e4), (1.3, 5.0, -2.0), BULK)


def terms(law, bounds):
    """Parameters of Ogden's terms: exponents, positive or between bounds, then their shear moduli."""

    def exponent(k):
        def where(e):
            return e.scene.material.exponents[k]

        return mpm.Positive(where) if bounds[k] is None else mpm.Bounded(where, *bounds[k])

    def put(e, c):
        return eqx.tree_at(lambda e: e.scene.material, e, e.scene.material.with_shear_moduli(tuple(c)))

    start = np.array(law.moduli) * np.array(law.exponents) / 2
    each = {f"alpha{k + 1}": exponent(k) for k in range(len(bounds))}
    return each | {"c": mpm.Positive(update=put, start=start, unit="Pa")}


def as_they_stand(law):
    """Moduli and exponents, any number each."""

    def where(field, k):
        return lambda e: getattr(e.scene.material, field)[k]

    names = (("mu", "moduli"), ("alpha", "exponents"))
    return {f"{name}{k + 1}": mpm.Unbounded(where(field, k)) for k in range(3) for name, field in names}


CASES = {
    **{name: LAWS[name] for name in ("neo-Hookean", "Mooney-Rivlin", "Yeoh", "Gent")},
    "Ogden-2": (mpm.Ogden((6e5, 1e3), (1.3, 5.0), BULK), None),
    "Ogden-3": (PUBLISHED, None),
    "Ogden-3, μ and α": (PUBLISHED, as_they_stand(PUBLISHED)),
}


def closed(problem):
    """The law that SciPy's least squares finds by the closed form, in the coordinates of the fit."""

    def residuals(z):
        each = zip(problem.at(z), TESTS, strict=True)
        return jnp.concatenate([
            (tension(e.scene.material, jnp.asarray(measured(kind, 9.0)[0]), kind) - measured(kind, 9.0)[1]) / NOISE
            for e, kind in each
        ])  # fmt: skip

    r, J, z = jax.jit(residuals), jax.jit(jax.jacfwd(residuals)), np.zeros(problem.size)
    return problem.at(jnp.asarray(least_squares(r, z, J, max_nfev=500).x))[0].scene.material


def left(law):
    """Root mean square of what a law leaves of the two tests [MPa], by the closed form."""
    each = [np.asarray(tension(law, jnp.asarray(x), kind)) - y for kind in TESTS for x, y in [measured(kind, 9.0)]]
    return np.sqrt((np.concatenate(each) ** 2).mean()) / 1e6


def equibiaxial(law):
    """The error of equibiaxial tension to a stretch of 4.1, at most and root mean square [%]."""
    x, stress = measured("equibiaxial", 4.1)
    error = np.asarray(tension(law, jnp.asarray(x), "equibiaxial")) / stress - 1
    return 100 * np.abs(error).max(), 100 * np.sqrt((error**2).mean())


def row(name, simulated, by_formula, note):
    columns = [f"{left(law):.4f}  {'{:7.3g} {:6.3g}'.format(*equibiaxial(law))}" for law in (simulated, by_formula)]
    print(f"{name:<17} {columns[0]}   {columns[1]}   {note}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("laws", nargs="*", help="which; default: all")
    parser.add_argument("--closed", action="store_true", help="closed forms alone")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"{'':<17} {'by mpm.fit':<23}   {'by the closed form':<23}")
    print(f"{'law':<17} {'rms MPa':<8}{'at most':>8} {'rms %':>6}   {'rms MPa':<8}{'at most':>8} {'rms %':>6}   values")
    for name in asked.laws or CASES:
        law, parameters = CASES[name]
        if parameters is None:
            parameters = terms(law, (None, None, (-10.0, 0.0))[: len(law.moduli)])
        tests = [experiment(law, kind, *measured(kind, 9.0), sigma=NOISE) for kind in TESTS]
        by_formula = closed(mpm.fitting.FitProblem(tests, parameters))
        if asked.closed:
            row(name, by_formula, by_formula, "")
            continue
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what they say stands in the row
            result = mpm.fit(tests, parameters, starts=1)
        numbers = ", ".join(f"{e.label} {e.value:.4g}" for e in result.estimates)
        ended = "" if result.converged else "did not converge, "
        note = f"{ended}{len(result.history)} iterations, {time.perf_counter() - start:.0f} s: {numbers}"
        row(name, result.scene.material, by_formula, note)
    row("Ogden, published", PUBLISHED, PUBLISHED, "")


if __name__ == "__main__":
    main()
