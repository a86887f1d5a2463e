"""The result that the tests of figures, summaries and pages share."""

from __future__ import annotations

import pytest
from demo_result import make_result

from acquire.evaluate.report import DemoResult


@pytest.fixture(scope="session")
def result() -> DemoResult:
    return make_result()
