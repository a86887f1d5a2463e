"""What `tools/house.py` counts, on a package of a few lines."""

from __future__ import annotations

from pathlib import Path

from tools.house import measures

ONE = '''
"""A module."""
from two import _shared


def _once(value):
    """Called here."""
    return value  # why


def _handed_over():
    return 1


def _twice():
    return _once(_shared(1, 2, 3, 4, 5, 6))


class Thing:
    def __init__(self):
        self.a, self.b = _twice(), _twice()
        self.c = run(_handed_over)
'''
TWO = '''
def _shared(*values):
    return values


class Thing:
    """Another one of that name."""
'''


def test_the_figures_are_those_of_the_package(tmp_path: Path) -> None:
    (tmp_path / "one.py").write_text(ONE)
    (tmp_path / "two.py").write_text(TWO)
    found = measures(tmp_path)
    assert found["files, functions"] == "2, 5"
    assert found["private functions referred to once"] == "75.0 % (3 of 4)"  # all but `_twice`
    assert found["of which called, and not handed over"] == "50.0 % (2 of 4)"
    assert found["comments per 100 lines of code"] == f"{100 / 14:.1f}"
    assert found["public names without a docstring"] == "50.0 % (1 of 2)"
    assert found["calls with 6 positional arguments or more"] == "1"
    assert found["class names used more than once"] == "1"
