"""Frames and payloads: whatever damages the bytes, no wrong frame comes out."""

from __future__ import annotations

import struct
import zlib

import pytest
from cobs import cobs
from hypothesis import example, given
from hypothesis import strategies as st

from acquire.trigger import registers as r
from acquire.trigger.frames import (
    MAX_ENCODED,
    Decoder,
    Frame,
    FrameChecksumError,
    FrameLengthError,
    FrameStuffingError,
    answers,
    decode,
    encode,
    nak_payload,
    parse_nak,
    parse_read,
    parse_write,
    read_payload,
    write_payload,
)
from acquire.trigger.registers import FrameType

frames = st.builds(
    Frame,
    type=st.integers(0, 255),
    sequence=st.integers(0, 0xFFFF),
    payload=st.binary(max_size=r.MAX_PAYLOAD),
    version=st.integers(0, 255),
)
cuts = st.lists(st.integers(1, 60), max_size=40)


def pieces(data: bytes, lengths: list[int]):
    at = 0
    for length in lengths:
        yield data[at : at + length]
        at += length
    yield data[at:]


@given(st.lists(frames, max_size=8), cuts)
def test_frames_come_back_however_their_bytes_are_split(sent, lengths) -> None:
    decoder = Decoder()
    data = b"".join(map(encode, sent))
    got = [frame for piece in pieces(data, lengths) for frame in decoder.feed(piece)]
    assert got == sent
    assert (decoder.frames, decoder.faults.total()) == (len(sent), 0)


@given(st.lists(frames, min_size=1, max_size=6), st.data(), cuts)
def test_damaged_bytes_give_no_wrong_frame_and_cost_only_their_neighbours(sent, data, lengths) -> None:
    encoded = [bytearray(encode(frame)) for frame in sent]
    victim = data.draw(st.integers(0, len(sent) - 1))
    at = data.draw(st.integers(0, len(encoded[victim]) - 1))
    encoded[victim][at] ^= data.draw(st.integers(1, 255))
    decoder = Decoder()
    got = [f for piece in pieces(b"".join(encoded), lengths) for f in decoder.feed(piece)]
    untouched = [frame for i, frame in enumerate(sent) if i not in (victim, victim + 1)]
    assert [frame for frame in got if frame in untouched] == untouched or len(set(sent)) < len(sent)
    assert all(frame in sent for frame in got)
    assert decoder.faults.total() >= (at < len(encoded[victim]) - 1)


@given(st.binary(max_size=2000), frames, cuts)
@example(b"\1" * 1999, Frame(1, 2, b"x"), [])
def test_after_any_garbage_the_next_zero_resynchronises(rubbish, frame, lengths) -> None:
    decoder = Decoder()
    data = rubbish + b"\0" + encode(frame)
    assert [f for piece in pieces(data, lengths) for f in decoder.feed(piece)][-1:] == [frame]
    assert len(decoder._rest) <= MAX_ENCODED


@given(frames, st.data())
def test_a_truncated_frame_is_ignored(frame, data) -> None:
    encoded = encode(frame)
    cut = data.draw(st.integers(0, len(encoded) - 2))
    decoder = Decoder()
    assert decoder.feed(encoded[:cut] + b"\0" + encoded) == [frame]
    assert decoder.faults.total() == (cut > 0)


def test_every_defect_is_named() -> None:
    with pytest.raises(FrameLengthError, match="9 to 249"):
        decode(b"123")
    with pytest.raises(FrameLengthError):
        decode(b"\1" * (MAX_ENCODED + 1))
    with pytest.raises(FrameStuffingError):
        decode(b"\xf0" * 20)
    with pytest.raises(FrameLengthError):
        decode(cobs.encode(b"\0\0\0\0"))
    body = b"\1\1\0\0"
    with pytest.raises(FrameChecksumError, match="0x00000001"):
        decode(cobs.encode(body + struct.pack("<I", 1)))
    assert decode(cobs.encode(body + struct.pack("<I", zlib.crc32(body)))) == Frame(1, 0)
    with pytest.raises(FrameLengthError):
        encode(Frame(1, 1, bytes(r.MAX_PAYLOAD + 1)))


def test_the_longest_frame_needs_one_code_byte() -> None:
    assert len(encode(Frame(255, 0xFFFF, b"\1" * r.MAX_PAYLOAD))) == MAX_ENCODED + 1 < 255


words = st.lists(st.integers(0, 0xFFFFFFFF), min_size=1, max_size=r.MAX_WORDS)


@given(st.integers(0, 0xFFFF), words)
def test_payloads(address, values) -> None:
    assert parse_write(write_payload(address, values)) == (address, tuple(values))
    assert parse_read(read_payload(address, len(values))) == (address, len(values))
    assert parse_nak(nak_payload(address, 7)) == (address, 7)


@given(st.binary(max_size=12))
def test_invalid_payloads_are_named(payload) -> None:
    for parse in (parse_read, parse_write, parse_nak):
        try:
            parse(payload)
        except FrameLengthError:
            continue


def test_an_answer_must_match_its_request() -> None:
    request = Frame(FrameType.READ, 5, read_payload(0x10, 2))
    good = Frame(FrameType.DATA, 5, write_payload(0x10, [1, 2]))
    assert answers(request, good)
    for wrong in (
        good._replace(sequence=6),
        good._replace(type=FrameType.ACK),
        good._replace(payload=write_payload(0x11, [1, 2])),
        good._replace(payload=write_payload(0x10, [1])),
        good._replace(payload=b"\1"),
    ):
        assert not answers(request, wrong)


@given(
    st.builds(
        r.TagRecord,
        run=st.integers(0, 2**32 - 1),
        line=st.integers(0, 2**48 - 1),
        code_index=st.integers(0, 2**64 - 1),
        timestamp=st.integers(0, 2**48 - 1),
        flags=st.integers(0, 2**16 - 1),
    )
)
def test_tags_are_packed_according_to_their_table(tag) -> None:
    payload = r.pack_tag(tag)
    assert r.unpack_tag(payload) == tag
    at = 0
    for name, bits in r.TAG_FIELDS:
        assert int.from_bytes(payload[at : at + bits // 8], "little") == getattr(tag, name)
        at += bits // 8
    assert at == len(payload) == r.TAG_BYTES
