"""The end of a command's process."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import os, sys
{load}
from acquire.__main__ import run

class Last:
    def __del__(self, write=os.write):
        write(1, b"finalized ")

last = Last()
sys.argv = ["acquire", "ls", "/nowhere"]
run()
"""


@pytest.mark.parametrize("load", ["import obstore", ""])
def test_a_process_with_threads_of_an_object_store_is_not_finalized(load: str) -> None:
    """There, its threads would abort the process now and then, after everything has been done."""
    found = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(load=load)],
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert found.returncode == 2, found.stderr
    assert "/nowhere" in found.stderr
    assert ("finalized" in found.stdout) is not bool(load)
