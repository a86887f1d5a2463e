"""Size of what ``pip install tdi-acquire`` installs, by distribution, without pip and setuptools.

``python -m tools.install_size`` follows the dependencies of the core, as they are installed here, and adds up
the sizes of their files, and of the compiled files that pip writes beside them. Ours are the checkout's.
For the same files in a fresh environment, `du -sm --apparent-size` adds 3 MiB of directories, and `du -sm` on
a disk with blocks of 4 KiB another 11 MiB: half a block for each file.
"""

from __future__ import annotations

import argparse
import marshal
import tomllib
from dataclasses import dataclass
from importlib import metadata
from importlib.util import cache_from_source
from pathlib import Path
from typing import TYPE_CHECKING

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

if TYPE_CHECKING:
    from collections.abc import Iterable

ROOT = Path(__file__).parents[1]
OURS = "tdi-acquire"
PYC_HEADER = 16


@dataclass(frozen=True)
class Size:
    """Bytes of a distribution's files as delivered, and of what Python compiles them to."""

    delivered: int
    compiled: int

    @property
    def total(self) -> int:
        return self.delivered + self.compiled


def installed(name: str = OURS) -> dict[str, Size]:
    """Return distribution → size, of ``name`` and of all that it needs without extras, as installed here."""
    sizes: dict[str, Size] = {}
    waiting = [Requirement(name)]
    while waiting:
        requirement = waiting.pop()
        if (key := canonicalize_name(requirement.name)) in sizes:
            continue
        if key == OURS:
            sizes[key], requires = _size(_our_files()), _our_dependencies()
        else:
            distribution = metadata.distribution(key)
            sizes[key], requires = _size(_files(distribution)), distribution.requires or []
        extras = {"", *requirement.extras}
        waiting += [
            needed
            for needed in map(Requirement, requires)
            if needed.marker is None or any(needed.marker.evaluate({"extra": extra}) for extra in extras)
        ]
    return sizes


def _files(distribution: metadata.Distribution) -> Iterable[Path]:
    # A file may be listed twice: as delivered, and with the installer's additions.
    return {Path(str(file.locate())).resolve() for file in distribution.files or ()}


def _our_dependencies() -> list[str]:
    # Those of the checkout, which may have changed since it was installed.
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return list(project["dependencies"])


def _our_files() -> Iterable[Path]:
    return [*(ROOT / "acquire").rglob("*"), *(ROOT / "configs").rglob("*")]


def _size(files: Iterable[Path]) -> Size:
    # Beside compiled files, numba keeps its loops there, which come with use.
    files = [file for file in files if file.is_file() and file.parent.name != "__pycache__"]
    return Size(sum(file.stat().st_size for file in files), sum(map(_compiled, files)))


def _compiled(file: Path) -> int:
    if file.suffix != ".py":
        return 0
    if (cached := Path(cache_from_source(str(file)))).exists():
        return cached.stat().st_size
    try:
        code = compile(file.read_bytes(), str(file), "exec", dont_inherit=True)
    except SyntaxError:  # some packages' tests contain code that is meant to be wrong
        return 0
    return PYC_HEADER + len(marshal.dumps(code))


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter).parse_args()
    sizes = installed()
    for name, size in sorted(sizes.items(), key=lambda item: -item[1].total):
        print(f"{size.total / 1e6:8.1f} MB, of which compiled {size.compiled / 1e6:5.1f}  {name}")
    delivered, total = (sum(size.delivered for size in sizes.values()), sum(s.total for s in sizes.values()))
    print(f"{total / 1e6:8.1f} MB ({total / 2**20:.1f} MiB) in all; {delivered / 1e6:.1f} MB as delivered")


if __name__ == "__main__":
    main()
