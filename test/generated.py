"""How many examples the property tests try: few and always the same ones, unless PROPERTY_EXAMPLES says how many new
ones."""

import os

import pytest

pytest.importorskip('hypothesis')

from hypothesis import HealthCheck, settings

EXAMPLES = int(os.environ.get('PROPERTY_EXAMPLES', 40))


def examples(times=1):
    """Settings of a property that is tried `times` EXAMPLES; no deadline: the machine may be busy."""
    return settings(max_examples=max(int(times * EXAMPLES), 1), derandomize='PROPERTY_EXAMPLES' not in os.environ,
                    deadline=None, database=None, suppress_health_check=list(HealthCheck))
