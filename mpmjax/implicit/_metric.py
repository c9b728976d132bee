"""The inner product in which an implicit solve works."""

import enum


class Metric(enum.Enum):
    """The diagonal weight W of conjugate residuals on M + cH, which is to say their preconditioner.

    Iterations grow with the spread of the eigenvalues of W⁻¹(M + cH), and the tolerance is of the residual in the norm
    of W⁻¹.
    """

    DIAGONAL = "diagonal"
    """M + c diag(H), negative parts of H left out: the default. How much it saves depends on the scene. Of halves,
    layers and inclusions at contrasts of 10 to 10 000, in two and three dimensions, it took an eighth to three fifths
    of the mass's iterations at a hundred times the limit, and a third to all of them at twenty times. In homogeneous
    bodies it took from a third of them to a fifth more."""
    MASS = "mass"
    """M, in which the solve is the reference's algorithm."""
