r"""Only whole frames are accepted from the link: the deframer, for any bytes at any pace.

::

    bytes    c0 d d ... 00            any, with any gaps
    frame    ______________/‾‾‾‾\__   only for 32 bits of good CRC, a whole COBS frame, 4 to 244 bytes
    bad      __________________/‾\    one clock for every delimiter that ends anything else
    memory   written only while no frame is kept in it

Simulations check that CRC and COBS agree with zlib and the package cobs:
`tests/firmware/test_gateware_link.py`.
"""

from __future__ import annotations

from amaranth.hdl import Mux, Signal

from acquire.trigger.registers import MAX_PAYLOAD
from firmware.crc import RESIDUE, Crc32
from firmware.deframer import CRC_BYTES, HEADER_BYTES, Deframer
from firmware.formal.harness import Harness, Proof, inputs_of, opened

LONGEST = HEADER_BYTES + MAX_PAYLOAD + CRC_BYTES


def frames_proof() -> Proof:
    harness, deframer = Harness(), Deframer(MAX_PAYLOAD)
    m, claim, lemma = harness.m, harness.claim, harness.lemma
    m.submodules.deframer, inside = opened(deframer)
    # An independent decoder of COBS, to compare with: the frame's bytes, and what is left of its block.
    m.submodules.crc = crc = Crc32()
    taken, byte = deframer.bytes.valid & deframer.bytes.ready, deframer.bytes.payload
    size, block, begun, zero_due, too_long = Signal(9), Signal(8), Signal(), Signal(), Signal()
    delimiter = taken & (byte == 0)
    found = Mux(block == 0, begun & zero_due, 1)  # this byte means one of the frame
    m.d.comb += [
        crc.data.eq(Mux(block == 0, 0, byte)),
        crc.enable.eq(taken & (byte != 0) & found),
        crc.reset.eq(delimiter),
    ]
    with m.If(delimiter):
        m.d.sync += [size.eq(0), block.eq(0), begun.eq(0), zero_due.eq(0), too_long.eq(0)]
    with m.Elif(taken):
        m.d.sync += begun.eq(1)
        with m.If(block == 0):
            m.d.sync += [block.eq(byte - 1), zero_due.eq(byte != 0xFF)]
        with m.Else():
            m.d.sync += block.eq(block - 1)
        with m.If(found & (size == LONGEST)):
            m.d.sync += too_long.eq(1)
        with m.Elif(found):
            m.d.sync += size.eq(size + 1)
    good = (block == 0) & ~too_long & (size >= HEADER_BYTES + CRC_BYTES) & (crc.value == RESIDUE)
    was_good, was_bad, length, kept = Signal(), Signal(), Signal(8), Signal()
    m.d.sync += [was_good.eq(delimiter & good), was_bad.eq(delimiter & begun & ~good)]
    m.d.sync += kept.eq(deframer.frame & ~deframer.release)
    with m.If(delimiter & good):
        m.d.sync += length.eq(size - CRC_BYTES)
    claim("a_frame_is_whole_and_its_crc_is_right", 1, deframer.frame == (was_good | kept))
    claim("whatever_else_ends_is_bad", 1, deframer.bad == was_bad)
    claim("its_length_is_its_bytes", deframer.frame, deframer.length == length)
    claim("it_fits_the_protocol", deframer.frame, (length >= HEADER_BYTES) & (length <= LONGEST - CRC_BYTES))
    claim("no_byte_is_taken_over_a_frame", deframer.frame, ~taken & ~inside["write"].en)
    lemma("crc_is_crc", 1, inside["crc"].value == crc.value)
    lemma("block_is_left", 1, inside["left"] == block)
    lemma("begun_is_begun", 1, inside["begun"] == begun)
    lemma("zero_is_due", begun, inside["follow_zero"] == zero_due)
    lemma("block_is_begun", block != 0, begun)
    lemma("too_long_is_broken", 1, inside["broken"] == too_long)
    lemma("count_is_size", 1, (inside["count"] == size) & (size <= LONGEST))
    harness.cover("bad", deframer.bad)
    harness.cover("two_bytes_of_a_frame", size == 2)
    return harness.proof("frames", inputs_of(deframer), cover_depth=8)
