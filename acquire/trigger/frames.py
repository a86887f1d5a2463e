"""Conversion between bytes of the trigger's link and frames; no I/O.

::

    [ version | type | sequence | payload | CRC-32 ] ──COBS──▶ no zero within, one zero at the end

Between two zeros there is either a frame, or bytes that are dropped and counted by the kind of error. After
any noise, the next zero restores synchronisation.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

from cobs import cobs

from acquire.errors import TriggerError
from acquire.trigger.registers import MAX_PAYLOAD, MAX_WORDS, PROTOCOL_VERSION, FrameType

if TYPE_CHECKING:
    from collections.abc import Sequence

_HEADER = struct.Struct("<BBH")
_CRC = struct.Struct("<I")
_ADDRESS = struct.Struct("<H")
_ADDRESS_COUNT = struct.Struct("<HB")
_ERROR_ADDRESS = struct.Struct("<HH")
_OVERHEAD = _HEADER.size + _CRC.size
MAX_ENCODED = MAX_PAYLOAD + _OVERHEAD + 1
"""Encoded bytes of the longest frame, its delimiter not counted."""


class FrameError(TriggerError):
    """Bytes that are not a frame."""


class FrameStuffingError(FrameError):
    """Bytes that are not COBS."""


class FrameLengthError(FrameError):
    """Too short or too long for any frame, or for its type."""


class FrameChecksumError(FrameError):
    """The CRC is wrong."""


class Frame(NamedTuple):
    """One frame of any version; ``type`` may be unknown."""

    type: int
    sequence: int
    payload: bytes = b""
    version: int = PROTOCOL_VERSION


def encode(frame: Frame) -> bytes:
    """Return the frame's bytes with delimiter. Raises FrameLengthError if the payload is too long."""
    if len(frame.payload) > MAX_PAYLOAD:
        raise FrameLengthError(
            f"a payload cannot have {len(frame.payload)} bytes", possible=f"at most {MAX_PAYLOAD}"
        )
    body = _HEADER.pack(frame.version, frame.type, frame.sequence) + frame.payload
    return bytes(cobs.encode(body + _CRC.pack(zlib.crc32(body)))) + b"\0"


def decode(encoded: bytes) -> Frame:
    """Return the frame between two zeros. Raises a FrameError for the kind of fault."""
    if not _OVERHEAD < len(encoded) <= MAX_ENCODED:
        raise FrameLengthError(
            f"an encoded frame cannot have {len(encoded)} bytes", possible=f"{_OVERHEAD + 1} to {MAX_ENCODED}"
        )
    try:
        whole = cobs.decode(encoded)
    except cobs.DecodeError as error:
        raise FrameStuffingError(f"{len(encoded)} bytes are not COBS: {error}") from error
    if len(whole) < _OVERHEAD:
        raise FrameLengthError(f"a frame cannot have {len(whole)} bytes", possible=f"{_OVERHEAD} or more")
    # CRC-32, since with a CRC of 16 bits a false tag passed when 5 % of the bytes were wrong.
    body, (crc,) = whole[: -_CRC.size], _CRC.unpack(whole[-_CRC.size :])
    if zlib.crc32(body) != crc:
        raise FrameChecksumError(f"CRC {crc:#010x} is wrong, the bytes have {zlib.crc32(body):#010x}")
    version, kind, sequence = _HEADER.unpack_from(body)
    return Frame(kind, sequence, body[_HEADER.size :], version)


class Decoder:
    """Takes bytes in any pieces, returns frames; ``faults`` counts dropped ones by error name.

    It never holds more than one frame's bytes: of anything longer it only remembers that it was too long.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.faults: Counter[str] = Counter()
        self._rest = bytearray()
        self._overlong = False

    def feed(self, data: bytes) -> list[Frame]:
        """Take bytes; return the frames that are complete now."""
        # COBS leaves no zero inside a frame: after any noise, the next zero ends it, and the frame after it
        # is intact again.
        *ended, rest = data.split(b"\0")
        found: list[Frame] = []
        for piece in ended:
            self._keep(piece)
            # Consecutive zeros are ignored: a sender may begin with one.
            encoded, overlong = bytes(self._rest), self._overlong
            self._rest.clear()
            self._overlong = False
            if overlong:
                self.faults[FrameLengthError.__name__] += 1
            elif encoded:
                try:
                    found.append(decode(encoded))
                    self.frames += 1
                except FrameError as error:
                    self.faults[type(error).__name__] += 1
        self._keep(rest)
        return found

    def _keep(self, piece: bytes) -> None:
        if self._overlong or len(self._rest) + len(piece) > MAX_ENCODED:
            self._overlong = True
            self._rest.clear()
        else:
            self._rest += piece


# ---- payloads


def read_payload(address: int, count: int) -> bytes:
    """Return the payload of a READ of ``count`` words from ``address`` on."""
    return _ADDRESS_COUNT.pack(address, count)


def write_payload(address: int, words: Sequence[int]) -> bytes:
    """Return the payload, address and words, of a WRITE or a DATA."""
    if not 0 < len(words) <= MAX_WORDS:
        raise FrameLengthError(f"one frame cannot have {len(words)} words", possible=f"1 to {MAX_WORDS}")
    return struct.pack(f"<H{len(words)}I", address, *words)


def nak_payload(error: int, address: int) -> bytes:
    """Return the payload of a refusal: the error's code, and the register that it concerns."""
    return _ERROR_ADDRESS.pack(error, address)


def parse_read(payload: bytes) -> tuple[int, int]:
    """Return address and count of a READ or an ACK."""
    _demand(len(payload) == _ADDRESS_COUNT.size, payload)
    address, count = _ADDRESS_COUNT.unpack(payload)
    _demand(0 < count <= MAX_WORDS, payload)
    return address, count


def parse_write(payload: bytes) -> tuple[int, tuple[int, ...]]:
    """Return address and words of a WRITE or a DATA."""
    count, rest = divmod(len(payload) - _ADDRESS.size, 4)
    _demand(rest == 0 and 0 < count <= MAX_WORDS, payload)
    address, *words = struct.unpack(f"<H{count}I", payload)
    return address, tuple(words)


def parse_nak(payload: bytes) -> tuple[int, int]:
    """Return error and address of a NAK."""
    _demand(len(payload) == _ERROR_ADDRESS.size, payload)
    error, address = _ERROR_ADDRESS.unpack(payload)
    return error, address


def answers(request: Frame, answer: Frame) -> bool:
    """Return whether ``answer`` matches ``request`` in sequence, type, address and count."""
    if answer.sequence != request.sequence:
        return False
    # The sequence alone is not enough: every program begins at 0, and late answers to the previous one may
    # come.
    try:
        if request.type == FrameType.READ and answer.type == FrameType.DATA:
            address, words = parse_write(answer.payload)
            return parse_read(request.payload) == (address, len(words))
        if request.type == FrameType.WRITE and answer.type == FrameType.ACK:
            address, words = parse_write(request.payload)
            return parse_read(answer.payload) == (address, len(words))
    except FrameLengthError:
        return False
    return answer.type == FrameType.NAK


def _demand(right: bool, payload: bytes) -> None:
    if not right:
        raise FrameLengthError(f"payload of {len(payload)} bytes does not fit its type")
