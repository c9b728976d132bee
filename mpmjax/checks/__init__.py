"""Checks of input: its values, its kind, the memory that it asks for."""

from mpmjax.checks._kinds import (
    alternatives as alternatives,
    checked as checked,
    choices as choices,
    is_abstract as is_abstract,
    is_class as is_class,
    is_own as is_own,
    may_be_infinite as may_be_infinite,
    require_fields as require_fields,
    shape_of as shape_of,
)
from mpmjax.checks._values import (
    as_floats as as_floats,
    as_plain as as_plain,
    canonical as canonical,
    coordinates as coordinates,
    first_unmet as first_unmet,
    is_traced as is_traced,
    require as require,
    require_between as require_between,
    require_finite as require_finite,
    require_memory as require_memory,
    require_moduli as require_moduli,
    require_placement as require_placement,
    require_positive as require_positive,
    require_that as require_that,
    require_tolerance as require_tolerance,
    require_whole as require_whole,
    requirements as requirements,
    shortened as shortened,
    warn as warn,
)
