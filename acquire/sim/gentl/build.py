"""``python -m acquire.sim.gentl.build``: compile the producer once per content, with any C compiler.

The result is kept in the user's cache and named after a hash of the sources and of the compiler's name.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from acquire.errors import DeviceError
from acquire.place import home
from acquire.sim.gentl.layout import header
from acquire.store.files import DISK
from acquire.store.refusals import refused

SOURCE = Path(__file__).with_name("producer.c")
OPTIONS = (
    "-std=gnu11",
    "-O2",
    "-shared",
    "-fPIC",
    # A host sees the functions of the standard, which the source exports, and no others.
    "-fvisibility=hidden",
    "-Wall",
    "-Wextra",
    "-lpthread",
    "-ldl",
)
COMPILE_S = 120.0
CACHE_HINT = "XDG_CACHE_HOME, another directory for what is compiled"


def compiler() -> str | None:
    """Return the C compiler that would be used: $CC, else cc, gcc or clang; None if there is none."""
    names = [os.environ["CC"]] if os.environ.get("CC") else ["cc", "gcc", "clang"]
    return next((found for name in names if (found := shutil.which(name))), None)


def build() -> Path:
    """Return the producer's .cti, which is compiled if necessary.

    Raises DeviceError without a compiler that comes to an end, PlaceError or StoreError if the cache
    directory cannot be written.
    """
    found = compiler()
    if found is None:
        raise DeviceError(
            "the simulated GenTL producer has to be compiled, and there is no C compiler",
            possible="cc, gcc or clang on PATH, or CC in the environment",
            hint="install the system's compiler package, or use the simulated cameras without GenTL",
        )
    # The name covers everything that the result depends on, so that versions do not overwrite each other.
    digest = hashlib.sha256("\0".join((SOURCE.read_text(), header(), found, *OPTIONS)).encode()).hexdigest()
    base = os.environ.get("XDG_CACHE_HOME")
    cache = (Path(base) if base else home() / ".cache") / "tdi-acquire"
    target = cache / f"acquire-simulated-{digest[:16]}.cti"
    if not target.is_file():
        with refused(target.parent, "written", hint=CACHE_HINT):
            _compile(found, target)
    return target


def _compile(found: str, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    # Compiled into a directory next to the target, then moved: concurrent builds both succeed.
    with tempfile.TemporaryDirectory(dir=target.parent) as name:
        directory = Path(name)
        (directory / "layout.h").write_text(header())
        made = directory / target.name
        command = [found, *OPTIONS, f"-I{directory}", "-o", str(made), str(SOURCE)]
        try:
            done = subprocess.run(  # noqa: S603 - the user's own compiler
                command, capture_output=True, text=True, timeout=COMPILE_S, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise DeviceError(
                f"{found} did not compile the producer within {COMPILE_S:g} s",
                hint="a machine that is less busy, or CC in the environment for another compiler",
            ) from error
        if done.returncode:
            raise DeviceError(
                f"{found} failed to compile the producer: {done.stderr.strip()[-2000:]}",
                hint="CC in the environment for another compiler",
            )
        # Its bytes before its name: after a power cut an empty file would count as compiled from then on.
        DISK.sync_tree(directory)
        made.replace(target)


if __name__ == "__main__":
    print(build())  # noqa: T201 - the command's answer
