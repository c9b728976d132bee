"""What a user passes in: its values, its kind, the memory that it asks for."""

from mpmjax.checks._kinds import alternatives, checked, is_enum, is_module, may_be_infinite, require_fields, shape_of
from mpmjax.checks._memory import require_memory
from mpmjax.checks._values import (
    canonical,
    coordinates,
    first_unmet,
    is_traced,
    require,
    require_between,
    require_finite,
    require_moduli,
    require_positive,
    require_that,
    require_tolerance,
    require_whole,
    requirements,
    shortened,
    warn,
)

__all__ = [
    "alternatives",
    "canonical",
    "checked",
    "coordinates",
    "first_unmet",
    "is_enum",
    "is_module",
    "is_traced",
    "may_be_infinite",
    "require",
    "require_between",
    "require_fields",
    "require_finite",
    "require_memory",
    "require_moduli",
    "require_positive",
    "require_that",
    "require_tolerance",
    "require_whole",
    "requirements",
    "shape_of",
    "shortened",
    "warn",
]
