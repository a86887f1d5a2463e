"""Exposure codes on the command line: a register and its state, bits in a file or in hex, a constant."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acquire.codes import MOST_LISTED_BITS, ConstantCode, ListedCode, PrbsCode
from acquire.errors import UsageError
from acquire.exchange.foreign import check_file, mapped
from acquire.reading import read_regular
from acquire.store.refusals import refused
from acquire.text import shortened

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.codes import Code

POSSIBLE = (
    "prbs:DEGREE:SEED with a seed as in a rig file, or with the register's state as 0x…; bits:0x… (the first "
    "bit is the highest one of the first digit); bits:FILE, a text of 0 and 1 or of 0x…, or a .npy file; "
    "constant:1"
)


def parse_code(text: str, *, repeats: bool = False) -> Code:
    """Parse a code; with ``repeats``, listed bits repeat. Raises UsageError that names the forms."""
    kind, _, rest = text.partition(":")
    # A seed has at most 39 digits, and Python refuses to convert thousands.
    if kind == "prbs" and (found := re.fullmatch(r"(\d{1,2}):(0x[0-9a-fA-F]+|\d{1,39})", rest)):
        degree, number = int(found[1]), found[2]
        if number.startswith("0x"):
            return PrbsCode(degree, int(number, 16))
        return PrbsCode.from_seed(degree, int(number))
    if kind == "constant" and rest in {"0", "1"}:
        return ConstantCode(int(rest))
    if kind == "bits" and rest:
        return ListedCode.of(_bits(rest), repeats=repeats)
    raise UsageError(f"the code {shortened(text)!r} cannot be read", possible=POSSIBLE)


def _bits(text: str) -> NDArray[np.uint8]:
    """Return the bits of hex digits, or of a file."""
    if not re.fullmatch("0x[0-9a-fA-F]+", text):
        path = Path(text)
        if path.suffix == ".npy":
            return _from_array(path)
        with refused(path, "read"):
            # Twice the bits, which leaves room for white space between them.
            raw = read_regular(path, MOST_LISTED_BITS * 2)
        # Other characters become ones that are no bits, and are refused below.
        text = "".join(raw.decode("ascii", "replace").split())
        if re.fullmatch("[01]+", text):
            return np.frombuffer(text.encode(), np.uint8) - ord("0")
        if not re.fullmatch("0x[0-9a-fA-F]+", text):
            raise UsageError(f"{path} does not hold bits", possible="0 and 1, with or without spaces, or 0x…")
    digits = text[2:]
    # Bytes take two digits each; the bits of an added one are cut off again.
    padded = digits + "0" * (len(digits) % 2)
    return np.unpackbits(np.frombuffer(bytes.fromhex(padded), np.uint8))[: 4 * len(digits)]


def _from_array(path: Path) -> NDArray[np.uint8]:
    check_file(path)
    with refused(path, "read"):
        try:
            found = mapped(path)
        except ValueError as error:
            raise UsageError(f"{path} cannot be read as NumPy: {error}") from error
    # Records cannot be compared with numbers, and complex numbers would lose their imaginary part.
    is_real = found.dtype.kind in "biuf" and found.ndim == 1
    if is_real and 0 < len(found) <= MOST_LISTED_BITS:
        # A copy: reading a mapped file that is cut short meanwhile would end this process (SIGBUS).
        with refused(path, "read"), path.open("rb") as file:
            raw = file.read(found.offset + found.nbytes)
        if len(raw) != found.offset + found.nbytes:
            raise UsageError(f"{path} was changed while it was read", hint="again, once it is complete")
        bits = np.frombuffer(raw, found.dtype, offset=found.offset)
        if np.isin(bits, (0, 1)).all():
            return np.asarray(bits, np.uint8)
    raise UsageError(
        f"{path} does not hold bits: it is an array of {found.dtype} {found.shape}",
        possible=f"one axis of up to {MOST_LISTED_BITS} values, 0 or 1",
    )
