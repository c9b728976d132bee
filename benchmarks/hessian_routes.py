"""Claim: the analytic Hessian action and the jvp of the energy's gradient agree to 1e-12 (float64).

Prints, for each law, dimension and family of deformation gradients, the worst relative difference of the two over both
descriptions and both gradient operators, then the worst of all. The cases are those of `tests/test_hessian.py`.

    python benchmarks/hessian_routes.py
"""

import sys
from pathlib import Path

import jax

sys.path.append(str(Path(__file__).parents[1] / "tests"))
jax.config.update("jax_enable_x64", True)


def main() -> None:
    from test_hessian import CASES, STRETCHES, route_difference, worst_difference

    rows = {}
    for law, d, family, *choice in CASES.values():
        row = rows.setdefault((law, d), dict.fromkeys(STRETCHES, None))
        row[family] = max(row[family] or 0.0, route_difference(law, d, family, *choice))
    print(f"{'law':16} d " + "".join(f"{family:>15}" for family in STRETCHES))
    for (law, d), row in rows.items():
        print(f"{law:16} {d} " + "".join(f"{'-' if value is None else f'{value:.1e}':>15}" for value in row.values()))
    worst, case = worst_difference()
    print(f"worst: {worst:.2e} ({case})")


if __name__ == "__main__":
    main()
