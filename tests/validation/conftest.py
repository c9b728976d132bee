"""Validation compiles a program for every grid: what no later test shares is dropped, since each holds memory maps."""

import jax
import pytest


@pytest.fixture(autouse=True)
def forget_programs(request):
    yield
    if request.node.get_closest_marker("slow"):
        jax.clear_caches()
