"""The seed of this run's random inputs, and tests that some seeds are known to fail."""

import os

import numpy as np
import pytest

# In the environment, so that pytest-xdist's workers have the same.
SEED = int(os.environ.setdefault("TEST_SEED", str(np.random.SeedSequence().generate_state(1)[0])))
FIXED = 0  # that of `make test`


def some_seeds_fail(measured):
    """Marks a test that must pass with the seed of `make test`, and fails with some others. measured: how many."""
    return pytest.mark.xfail(SEED != FIXED, reason=f"measured: {measured}", strict=False)
