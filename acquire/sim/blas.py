"""One thread per camera process for the matrix products of numpy's BLAS.

Each simulated camera has a process of its own; a pool of spinning threads in both would fight for the
cores that the capture path needs. The environment variable that BLAS reads at its start comes too late in
a spawned process, which has imported numpy to receive its camera.
"""

from __future__ import annotations

import ctypes
from pathlib import Path

_SETTERS = (
    "scipy_openblas_set_num_threads64_",  # numpy's wheels
    "scipy_openblas_set_num_threads",
    "openblas_set_num_threads64_",
    "openblas_set_num_threads",  # distributions
    "MKL_Set_Num_Threads",
    "bli_thread_set_num_threads",
)


def limit_blas_threads(count: int) -> list[str]:
    """Let every BLAS loaded in this process use at most ``count`` threads; the libraries that were told.

    A library of another make keeps its own setting; results are the same, other processes get less time.
    """
    return [path for path in _loaded_blas() if _tell(path, count)]


def _loaded_blas() -> list[str]:
    maps = Path("/proc/self/maps").read_text(encoding="utf-8")
    paths = {line.split(maxsplit=5)[5] for line in maps.splitlines() if ".so" in line}
    return sorted(
        path for path in paths if any(make in Path(path).name for make in ("blas", "mkl_rt", "blis"))
    )


def _tell(path: str, count: int) -> bool:
    library = ctypes.CDLL(path)
    for name in _SETTERS:
        if hasattr(library, name):
            getattr(library, name)(ctypes.c_int(count))
            return True
    return False
