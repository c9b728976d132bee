"""Charts of error against seconds, and their numbers."""

import csv
from pathlib import Path

import numpy as np

from mpmjax.analysis import WorkPrecision, name_of
from mpmjax.io import replacing, save_figure


def draw_chart(comparison: WorkPrecision, path: Path) -> Path:
    """Error over seconds, a line for each method and grid.

    Runs that failed and runs that were only foreseen stand at the upper edge; the error that was asked for is a line,
    and below the reference run's own error nothing is certain.
    """
    from matplotlib import pyplot as plt  # here, since it takes a second that only pictures should pay

    figure, axes = plt.subplots(figsize=(7.2, 4.8), layout="constrained")
    lines = list(dict.fromkeys((name_of(t.method), t.refinement) for t in comparison.trials))
    names = list(dict.fromkeys(name for name, _ in lines))
    top = 2 * max((t.error for t in comparison.trials if np.isfinite(t.error)), default=1.0)
    for name, refinement in lines:
        trials = [t for t in comparison.trials if (name_of(t.method), t.refinement) == (name, refinement)]
        colour, dashes = f"C{names.index(name)}", "-" if refinement == 1 else "--"
        label = name if refinement == 1 else f"{name}, spacing / {refinement}"
        good = sorted((t.seconds, t.error) for t in trials if np.isfinite(t.error))
        seconds, errors = zip(*good, strict=True) if good else ((), ())
        axes.plot(seconds, errors, dashes, color=colour, marker="o", markersize=4, label=label)
        for mark, test in (("x", np.isinf), (">", np.isnan)):
            bad = [t.seconds for t in trials if test(t.error)]
            axes.plot(bad, [top] * len(bad), mark, color=colour)
    axes.axhline(comparison.target, color="black", linewidth=0.8)
    axes.axhspan(0, comparison.reference.error, color="0.92")
    axes.set(xscale="log", yscale="log", xlabel="seconds", ylabel="relative error of the motion")
    axes.set_title("x failed, > foreseen; grey: less than the reference's own uncertainty", fontsize=9)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    save_figure(figure, path, 140)
    plt.close(figure)
    return path


def write_trials(comparison: WorkPrecision, path: Path) -> Path:
    """The trials as CSV; an error of inf is a run that failed, of nan one that was foreseen to take too long."""
    with replacing(path) as aside, aside.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["method", "refinement", "dt_s", "steps", "seconds", "error", "linearisation_error"])
        rows.writerows([name_of(t.method), *t[1:]] for t in comparison.trials)
    return path
