"""Array back ends of the reconstruction: a library of the array API standard, one of its devices, a dtype.

    numpy   the default; TV and the shear are compiled loops (numba)
    others  the same solvers, TV and the shear in the standard's operations, vectorised over all frames

The solvers ask `namespace` for the functions of whatever array they hold. Lines, weights and bases are made
on the host. `Arrays.asarray` is the only way to the device and `host` the only way back. Neither is called
inside an iteration, only between rounds of them, for small matrices and the predicted lines. All that an
iteration reads back are scalars: whether its residual is finite, or 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import array_api_compat
import array_api_compat.numpy
import numpy as np

from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

Array: TypeAlias = Any
"""An array of any library; the standard has no type for it yet."""
Dtype = Literal["float32", "float64"]
DTYPES: tuple[Dtype, ...] = ("float32", "float64")


@dataclass(frozen=True, slots=True)
class Arrays:
    """Makes arrays of one library, device and dtype (float32 or float64)."""

    xp: Any = array_api_compat.numpy
    device: Any = None
    dtype: Dtype = "float32"

    def asarray(self, given: Array) -> Array:
        """Copy a numpy array to the device; an array that is already there stays as it is."""
        return self.xp.asarray(given, dtype=getattr(self.xp, self.dtype), device=self.device)

    def zeros(self, shape: tuple[int, ...]) -> Array:
        """Return zeros of this back end's dtype, on its device."""
        return self.xp.zeros(shape, dtype=getattr(self.xp, self.dtype), device=self.device)

    def indices(self, given: NDArray[np.int64]) -> Array:
        """Copy integer indices for ``take`` to the device."""
        return self.xp.asarray(given, device=self.device)

    def exact(self) -> Arrays:
        """Return the same back end in float64."""
        return replace(self, dtype="float64")

    @property
    def compiled(self) -> bool:
        """Whether the compiled loops work on these arrays."""
        return bool(array_api_compat.is_numpy_namespace(self.xp))


HOST = Arrays()
"""numpy in float32."""


def namespace(array: Array) -> Any:
    """Return the functions of an array's library under the standard's names."""
    return array_api_compat.array_namespace(array)


def host(array: Array) -> NDArray[Any]:
    """Return the array as a numpy array: itself, or a copy from the device."""
    if array_api_compat.is_cupy_array(array):
        # numpy reads the memory of the host only, through DLPack as well.
        copied: NDArray[Any] = array.get()
        return copied
    return np.from_dlpack(array) if not array_api_compat.is_numpy_array(array) else array


def dot(a: Array, b: Array) -> Array:
    """Return Σ a·b over all elements, as a zero-dimensional array on their device."""
    return namespace(a).reshape(a, (-1,)) @ namespace(b).reshape(b, (-1,))


def _cupy() -> tuple[Any, Any]:
    try:
        import cupy
        from array_api_compat import cupy as xp
    except ImportError as error:
        raise UsageError(
            f"device 'gpu' needs CuPy, which cannot be imported ({error})",
            possible="cpu",
            hint="pip install 'tdi-acquire[gpu]'",
        ) from error
    try:
        return xp, cupy.cuda.Device()  # the current device; queries the driver
    except cupy.cuda.runtime.CUDARuntimeError as error:
        raise UsageError(
            f"device 'gpu' does not work: {error}",
            possible="cpu",
            hint="nvidia-smi, which lists the GPUs that the driver finds",
        ) from error


DEVICES: dict[str, Callable[[], tuple[Any, Any]]] = {
    "cpu": lambda: (array_api_compat.numpy, None),
    "gpu": _cupy,
}
"""Name → opener that returns the library and its device."""


def open_arrays(device: str = "cpu", dtype: str = "float32") -> Arrays:
    """Return the back end of a device and dtype. Raises UsageError for an unknown or unusable one."""
    if dtype not in DTYPES:
        raise UsageError(f"dtype {dtype!r} is not known", possible=", ".join(DTYPES))
    if device not in DEVICES:
        raise UsageError(f"device {device!r} is not known", possible=", ".join(DEVICES))
    xp, opened = DEVICES[device]()
    return Arrays(xp, opened, dtype)
