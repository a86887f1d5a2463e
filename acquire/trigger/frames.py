"""Bytes of the trigger's link ↔ frames; no I/O.

::

    [ version | type | sequence | payload | CRC-32 ] ──COBS──▶ no zero within, one zero at the end

Whatever arrives, in whatever pieces: between two zeros there is a frame, or something that is dropped and
counted by the name of what was wrong with it. The next zero is always a new beginning.
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
    """Bytes that are no frame."""


class FrameStuffingError(FrameError):
    """Not COBS."""


class FrameLengthError(FrameError):
    """Too short or too long for any frame, or for its type."""


class FrameChecksumError(FrameError):
    """The CRC belongs to other bytes."""


class Frame(NamedTuple):
    """One frame of any version; ``type`` may be one that nobody knows."""

    type: int
    sequence: int
    payload: bytes = b""
    version: int = PROTOCOL_VERSION


def encode(frame: Frame) -> bytes:
    """The frame's bytes, delimiter included. Raises FrameLengthError for too long a payload."""
    if len(frame.payload) > MAX_PAYLOAD:
        raise FrameLengthError(
            f"a payload cannot have {len(frame.payload)} bytes", possible=f"at most {MAX_PAYLOAD}"
        )
    body = _HEADER.pack(frame.version, frame.type, frame.sequence) + frame.payload
    return bytes(cobs.encode(body + _CRC.pack(zlib.crc32(body)))) + b"\0"


def decode(encoded: bytes) -> Frame:
    """The frame between two zeros. Raises a FrameError that says what is wrong."""
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
    # CRC-32: with 16 bits, a false tag passed among bytes of which 5 % were wrong.
    body, (crc,) = whole[: -_CRC.size], _CRC.unpack(whole[-_CRC.size :])
    if zlib.crc32(body) != crc:
        raise FrameChecksumError(f"CRC {crc:#010x} where the bytes have {zlib.crc32(body):#010x}")
    version, kind, sequence = _HEADER.unpack_from(body)
    return Frame(kind, sequence, body[_HEADER.size :], version)


class Decoder:
    """Takes bytes in any pieces, gives frames; ``faults`` counts what was dropped, by error name.

    Never holds more than one frame's bytes: of anything longer only the length is remembered.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.faults: Counter[str] = Counter()
        self._rest = bytearray()
        self._overlong = False

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that are complete now."""
        # COBS leaves no zero inside a frame: after any noise, the next zero is the end of something, and what
        # follows it is whole again.
        *ended, rest = data.split(b"\0")
        found: list[Frame] = []
        for piece in ended:
            self._keep(piece)
            # Zeros in a row are nothing: a sender may begin with one.
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


# What the payloads say.


def read_payload(address: int, count: int) -> bytes:
    return _ADDRESS_COUNT.pack(address, count)


def write_payload(address: int, words: Sequence[int]) -> bytes:
    """Address and words: a WRITE, and equally a DATA."""
    if not 0 < len(words) <= MAX_WORDS:
        raise FrameLengthError(f"one frame cannot have {len(words)} words", possible=f"1 to {MAX_WORDS}")
    return struct.pack(f"<H{len(words)}I", address, *words)


def nak_payload(error: int, address: int) -> bytes:
    return _ERROR_ADDRESS.pack(error, address)


def parse_read(payload: bytes) -> tuple[int, int]:
    """Address and count: of a READ, and equally of an ACK."""
    _demand(len(payload) == _ADDRESS_COUNT.size, payload)
    address, count = _ADDRESS_COUNT.unpack(payload)
    _demand(0 < count <= MAX_WORDS, payload)
    return address, count


def parse_write(payload: bytes) -> tuple[int, tuple[int, ...]]:
    """Address and words: of a WRITE, and equally of a DATA."""
    count, rest = divmod(len(payload) - _ADDRESS.size, 4)
    _demand(rest == 0 and 0 < count <= MAX_WORDS, payload)
    address, *words = struct.unpack(f"<H{count}I", payload)
    return address, tuple(words)


def parse_nak(payload: bytes) -> tuple[int, int]:
    """Error and address."""
    _demand(len(payload) == _ERROR_ADDRESS.size, payload)
    error, address = _ERROR_ADDRESS.unpack(payload)
    return error, address


def answers(request: Frame, answer: Frame) -> bool:
    """Whether ``answer`` has the form of an answer to ``request``: type, address and count belong to it."""
    if answer.sequence != request.sequence:
        return False
    # The number alone is not enough: every program begins at 0, and the answer to the one before may be late.
    try:
        return answer.type == FrameType.NAK or _matches(request, answer)
    except FrameLengthError:
        return False


def _matches(request: Frame, answer: Frame) -> bool:
    if request.type == FrameType.READ and answer.type == FrameType.DATA:
        address, words = parse_write(answer.payload)
        return parse_read(request.payload) == (address, len(words))
    if request.type == FrameType.WRITE and answer.type == FrameType.ACK:
        address, words = parse_write(request.payload)
        return parse_read(answer.payload) == (address, len(words))
    return False


def _demand(right: bool, payload: bytes) -> None:
    if not right:
        raise FrameLengthError(f"payload of {len(payload)} bytes does not fit its type")
