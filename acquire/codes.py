"""Exposure codes: the bit E(k) that gates the light during sub-step k of a run.

The pseudo-random code is a maximal-length Galois register that shifts right, as the gateware does::

    bit = state & 1;  state >>= 1;  if bit: state ^= mask        mask = Σ 1 << (tap - 1)

Its output obeys  o_k = ⊕_{tap} o_{k - tap}, hence also  o_k = ⊕ o_{k - 2^m·tap}  (squaring is linear in
GF(2)). The first gives the jump to any index by one power of x modulo the characteristic polynomial,
the second lets numpy generate blocks that double in length.

numpy is imported inside the functions that compute bits, so that a recording's code attribute can be read
without it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, Protocol

from acquire.errors import UsageError
from acquire.text import shortened

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

TAPS: dict[int, tuple[int, ...]] = {
    3: (3, 2),
    4: (4, 3),
    5: (5, 3),
    6: (6, 5),
    7: (7, 6),
    8: (8, 6, 5, 4),
    9: (9, 5),
    10: (10, 7),
    11: (11, 9),
    12: (12, 6, 4, 1),
    13: (13, 4, 3, 1),
    14: (14, 5, 3, 1),
    15: (15, 14),
    16: (16, 15, 13, 4),
    17: (17, 14),
    18: (18, 11),
    19: (19, 6, 2, 1),
    20: (20, 17),
    21: (21, 19),
    22: (22, 21),
    23: (23, 18),
    24: (24, 23, 22, 17),
    25: (25, 22),
    26: (26, 6, 2, 1),
    27: (27, 5, 2, 1),
    28: (28, 25),
    29: (29, 27),
    30: (30, 6, 4, 1),
    31: (31, 28),
    32: (32, 22, 2, 1),
    48: (48, 47, 21, 20),
    64: (64, 63, 61, 60),
}
"""Degree → taps of a maximal-length register. Degree 64 never repeats: 3·10⁵ years at 1.8 MHz."""


MOST_LISTED_BITS = 2**22
"""Upper limit on the bits of a listed code, which are stored as text in the recording's attributes."""


class Code(Protocol):
    """The light's code of a run: its bits by index, and the attributes that regenerate them."""

    def bits(self, start: int, length: int) -> NDArray[np.uint8]:
        """Return bits ``start .. start + length - 1`` (uint8, 0 or 1). The light is off before index 0."""
        ...

    def to_attrs(self) -> dict[str, Any]:
        """Return the recording's ``code`` attribute."""
        ...


@dataclass(frozen=True, slots=True)
class PrbsCode:
    """Maximal-length pseudo-random code, given by the ``state`` of its register at index 0.

    ``seed`` is the number that the user gave, if any; see `from_seed`.
    """

    degree: int
    state: int
    seed: int | None = field(default=None, compare=False)
    kind: Literal["prbs"] = "prbs"

    def __post_init__(self) -> None:
        _check_register(self.degree, self.state)

    @classmethod
    def from_seed(cls, degree: int, seed: int) -> PrbsCode:
        """Return the code that a seed in a configuration stands for: its state is mixed from the seed."""
        _check_register(degree, 1)
        if not _is_whole(seed):
            raise UsageError(f"a prbs code cannot have the seed {seed!r}", possible="an integer")
        return cls(degree, mix_seed(seed, degree), seed)

    def bits(self, start: int, length: int) -> NDArray[np.uint8]:
        """Return ``length`` bits from sub-step ``start`` on, as uint8; 0 before sub-step 0."""
        import numpy as np

        _check_range(start, length)
        dark = min(max(-start, 0), length)
        lit = prbs(self.degree, self.state, max(start, 0), length - dark)
        return np.concatenate([np.zeros(dark, np.uint8), lit])

    def to_attrs(self) -> dict[str, Any]:
        """Return the code as the attribute ``code`` of recordings; the seed only if it is known."""
        # Hexadecimal text: states of degree 64 exceed what JSON readers in other languages keep exactly.
        return {
            "kind": self.kind,
            "degree": self.degree,
            "taps": list(TAPS[self.degree]),
            "state": f"{self.state:#x}",
            **({} if self.seed is None else {"seed": self.seed}),
            "start": 0,
        }


@dataclass(frozen=True, slots=True)
class ConstantCode:
    """Light always on (1) or off (0): flat fields, dark frames and alignment."""

    value: int
    kind: Literal["constant"] = "constant"

    def __post_init__(self) -> None:
        if self.value not in (0, 1):
            raise UsageError(f"a constant code cannot be {self.value!r}", possible="0 or 1")

    def bits(self, start: int, length: int) -> NDArray[np.uint8]:
        """Return ``length`` equal bits from sub-step ``start`` on, as uint8; 0 before sub-step 0."""
        import numpy as np

        _check_range(start, length)
        index = np.arange(start, start + length)
        return np.where(index < 0, 0, self.value).astype(np.uint8)

    def to_attrs(self) -> dict[str, Any]:
        """Return the code as the attribute ``code`` of recordings."""
        return {"kind": self.kind, "value": self.value, "start": 0}


@dataclass(frozen=True, slots=True)
class ListedCode:
    """Arbitrary bits, listed one by one: the first is the most significant of ``digits`` (hexadecimal).

    With ``repeats`` the list is repeated without end; otherwise the light is off after the last bit.
    """

    digits: str
    length: int
    repeats: bool = False
    kind: Literal["bits"] = "bits"

    def __post_init__(self) -> None:
        possible = f"1 to {MOST_LISTED_BITS} bits, four in each hexadecimal digit"
        if not 1 <= self.length <= MOST_LISTED_BITS or len(self.digits) != -(-self.length // 8) * 2:
            raise UsageError(
                f"a code of {self.length} bits cannot have {len(self.digits)} digits", possible=possible
            )
        if set(self.digits) - set("0123456789abcdef"):
            raise UsageError("the code has digits that are not hexadecimal", possible=possible)

    @classmethod
    def of(cls, bits: NDArray[np.uint8], *, repeats: bool = False) -> ListedCode:
        """Return the code with these bits (0 or 1)."""
        import numpy as np

        given = np.asarray(bits)
        if given.ndim != 1 or given.dtype.kind not in "biu" or (given > 1).any() or (given < 0).any():
            raise UsageError(
                f"an array of shape {given.shape} and dtype {given.dtype} is not a list of code bits",
                possible="(bit,) of 0 and 1, as integers",
            )
        return cls(np.packbits(given).tobytes().hex(), len(given), repeats)

    def bits(self, start: int, length: int) -> NDArray[np.uint8]:
        """Return ``length`` bits from sub-step ``start`` on, as uint8; 0 before the list."""
        import numpy as np

        _check_range(start, length)
        listed = np.unpackbits(np.frombuffer(bytes.fromhex(self.digits), np.uint8), count=self.length)
        index = np.arange(start, start + length)
        inside = (index >= 0) & (self.repeats | (index < self.length))
        return np.where(inside, listed[index % self.length], 0).astype(np.uint8)

    def to_attrs(self) -> dict[str, Any]:
        """Return the code as the attribute ``code`` of recordings, with all of its bits."""
        return {
            "kind": self.kind,
            "bits": self.digits,
            "length": self.length,
            "repeats": self.repeats,
            "start": 0,
        }


def code_from_attrs(attrs: Mapping[str, Any]) -> Code:
    """Return the code that a recording's ``code`` attribute describes.

    Raises UsageError if there is none, or the attribute lacks something.
    """
    try:
        return _described(attrs)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise UsageError(
            f"a code attribute {shortened(repr(attrs))} describes no code: {type(error).__name__}: {error}",
            possible="what the `to_attrs` of a code returns",
        ) from error


def _described(attrs: Mapping[str, Any]) -> Code:
    kind = attrs.get("kind")
    if kind == "prbs":
        degree = int(attrs["degree"])
        if tuple(attrs["taps"]) != TAPS.get(degree):
            raise UsageError(
                f"a prbs code of degree {degree} cannot have the taps {attrs['taps']}",
                possible=f"taps {TAPS.get(degree)}",
            )
        # In format 1, ``seed`` was the state of the register, not a number that a user gave.
        seed = attrs.get("seed") if "state" in attrs else None
        return PrbsCode(degree, register_state(attrs), None if seed is None else int(seed))
    if kind == "constant":
        return ConstantCode(int(attrs["value"]))
    if kind == "bits":
        return ListedCode(str(attrs["bits"]), int(attrs["length"]), bool(attrs["repeats"]))
    raise UsageError(f"there is no code of kind {kind!r}", possible="'prbs', 'constant', 'bits'")


def register_state(attrs: Mapping[str, Any]) -> int:
    """Return a pseudo-random code's register state at index 0; recordings of format 1 call it ``seed``."""
    return int(str(attrs["state"] if "state" in attrs else attrs["seed"]), 0)


def prbs(degree: int, state: int, start: int, length: int) -> NDArray[np.uint8]:
    """Return bits ``start .. start + length - 1`` of the pseudo-random code (uint8, 0 or 1).

    The cost is logarithmic in ``start`` and linear in ``length``, at numpy speed.
    """
    _check_register(degree, state)
    _check_range(start, length, least=0)
    window = _window(degree, state, start)
    if length <= degree:
        return window[:length]
    import numpy as np

    out = np.empty(length, np.uint8)
    out[:degree] = window
    # in blocks whose lag doubles whenever enough bits are known
    taps, known, scale = TAPS[degree], degree, 1
    while known < length:
        while max(taps) * 2 * scale <= known:
            scale *= 2
        count = min(min(taps) * scale, length - known)
        block = out[known : known + count]
        block[:] = 0
        for tap in taps:
            block ^= out[known - tap * scale : known - tap * scale + count]
        known += count
    return out


def state_at(degree: int, state: int, index: int) -> int:
    """Return the register's state before it emits bit ``index``, for a code that begins with ``state``.

    After ``degree`` steps the state depends only on the bits emitted since, whatever it was before.
    """
    _check_register(degree, state)
    _check_range(index, 0, least=0)
    mask = sum(1 << (tap - 1) for tap in TAPS[degree])
    if index < degree:
        for _ in range(index):
            state = state >> 1 ^ (mask if state & 1 else 0)
        return state
    emitted = _window(degree, state, index - degree)
    state = 0
    for bit in emitted.tolist():
        state = state >> 1 ^ (mask if bit else 0)
    return state


def mix_seed(number: int, degree: int) -> int:
    """Mix a register state with about as many ones as zeros from any small integer (splitmix64, never 0).

    A register that starts at 1 emits tens of zeros first, and ``--seed 1`` is what people like to type.
    """
    z = (number + 1) * 0x9E3779B97F4A7C15 & 0xFFFFFFFFFFFFFFFF
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 & 0xFFFFFFFFFFFFFFFF
    z = (z ^ (z >> 27)) * 0x94D049BB133111EB & 0xFFFFFFFFFFFFFFFF
    return (z ^ (z >> 31)) & ((1 << degree) - 1) or 1


def _is_whole(value: object) -> bool:
    """Whether a value is an integer, also one of numpy's."""
    return hasattr(value, "__index__")


def _check_range(start: int, length: int, least: int | None = None) -> None:
    if not _is_whole(start) or not _is_whole(length) or length < 0 or (least is not None and start < least):
        raise UsageError(
            f"bits of a code cannot have start = {start!r} and length = {length!r}",
            possible=f"integers, {'start and length' if least == 0 else 'length'} 0 or more",
        )


def _check_register(degree: int, state: int) -> None:
    if degree not in TAPS:
        raise UsageError(f"there is no prbs code of degree {degree}", possible=", ".join(map(str, TAPS)))
    if not _is_whole(state) or not 0 < state < 1 << degree:
        raise UsageError(
            f"a prbs code of degree {degree} cannot have the state {state!r}",
            possible=f"1 to {(1 << degree) - 1:#x}",
        )


def _window(degree: int, state: int, start: int) -> NDArray[np.uint8]:
    """Return ``degree`` output bits from index ``start``: o_{N+i} = Σ_j a_j·o_{j+i}, x^N ≡ Σ_j a_j·x^j."""
    import numpy as np

    head = 0  # o_0 .. o_{2·degree - 1}, bit k = o_k
    mask = sum(1 << (tap - 1) for tap in TAPS[degree])
    for k in range(2 * degree):
        bit = state & 1
        head |= bit << k
        state = state >> 1 ^ (mask if bit else 0)
    a = _x_power(start, degree)
    return np.array([(a & head >> i).bit_count() & 1 for i in range(degree)], dtype=np.uint8)


def _x_power(exponent: int, degree: int) -> int:
    """Return x^exponent modulo the characteristic polynomial x^d + Σ_tap x^(d - tap), with x^j as bit j."""
    poly = 1 << degree | sum(1 << (degree - tap) for tap in TAPS[degree])
    result = 1
    for digit in f"{exponent:b}":
        result = int(f"{result:b}", 4)  # squaring in GF(2) spreads the bits: binary digits read in base 4
        if digit == "1":
            result <<= 1
        while (excess := result.bit_length() - 1 - degree) >= 0:
            result ^= poly << excess
    return result
