"""The text of ``firmware/PROTOCOL.md``; `acquire.trigger.registers_table` fills in the tables and numbers."""

# ruff: noqa: E501 - a table's row is one line, and the rest is as wide as the other documents
from __future__ import annotations

from string import Template

PROTOCOL = Template("""\
$note

# The sync trigger's protocol, version $version

This document and [REGISTERS.md](REGISTERS.md) contain everything that a host program needs. Numbers are little
endian, and decimal unless they begin with 0x.

## Frames

The bytes in both directions (UART with 8 data bits, no parity and one stop bit, or USB bulk) form frames:

| field | bytes | |
|---|---|---|
| version | 1 | $version |
| type | 1 | see Types |
| sequence | 2 | chosen freely in a request, repeated in its answer; for a TAG, see Tags |
| payload | 0 to $max_payload | depends on the type |
| crc | 4 | CRC-32 of all preceding bytes, as in zlib: reflected, polynomial 0xEDB88320, first and last XOR 0xFFFFFFFF |

The frame is encoded with COBS (consistent overhead byte stuffing): it is cut at its zeros, which are omitted, and
each piece is preceded by its length + 1. A piece of 254 bytes is preceded by 255, and no zero was omitted after it.
One byte 0x00 ends the frame. Anything between two zeros that is not a frame is dropped: the device counts it in
RX_ERRORS and does not answer. Two consecutive zeros are not an error, so a host may send a zero at any time to
resynchronise.

## Types

$types
| type | payload |
|---|---|
| READ | address u16, count u8: 1 to $max_words words |
| WRITE | address u16, 1 to $max_words words u32 |
| DATA | address u16, words u32 |
| ACK | address u16, count u8 |
| NAK | error u16 (see Errors), address u16 of the word at fault, 0 if there is none |
| TAG | see Tags |

- Requests are answered in order. The device does not compare sequence numbers: a request that is sent twice is
  carried out twice, and every request may be sent twice (see Commands).
- A host may have at most QUEUES.rx_bytes encoded bytes of unanswered requests in flight.
- An address counts words of 32 bits. The map ends before $map_end. The code memory begins at $code_memory and has CODE_BITS
  bits, with code bit 0 in bit 0 of its first word. A READ that goes beyond either is answered with NAK BAD_ADDRESS and
  its first address. A READ of the code memory is answered with NAK BUSY while a run is armed or running. A word of the
  map without a register reads as 0.
- The words of a WRITE take effect one after the other, at rising addresses. The first word that cannot be written is
  reported by a NAK with its address, and the words before it have taken effect. Writing a word without a register, or
  beyond the map, gives NAK BAD_ADDRESS. The exception is a 0 within the map, so that a block of registers can be
  written by one WRITE.
- A register ignores the bits of a word above its own width and reads them as 0. A register of 32 bits with fields
  keeps all 32; write 0 to the bits without a meaning.
- A register wider than 32 bits takes two words, the low one first. A READ samples all words of the registers with
  access `read` in one clock, so the two halves belong together if they are read by the same READ.
- A WRITE to a register with access `config`, or to the code memory, is answered with NAK BUSY while a run is armed,
  running or stopping, and while the device is busy (STATUS.busy, or the last tag of a run waits for room).
- Every well-formed READ or WRITE (version, type and length) feeds the watchdog, whether it is carried out or refused.
  Nothing else feeds it.

## Commands

$commands
A command is one WRITE of three words from RUN_ID on: the run id (64 bits, not 0), then the command. Repeating a command
changes nothing:

| command | effect | repeated | refused |
|---|---|---|---|
| ARM | the configuration is checked, the counters are cleared, the state becomes ARMED; an external edge in the next \
4 clocks is ignored | ACK while the same run is armed or running | BUSY: another run is armed or running, STATUS.busy, \
or the last tag of the previous run waits for room; RUN_OVER; BAD_RUN_ID; an error of 32 or more: the configuration is \
invalid, the address is that of the register at fault, and REJECT has both as well |
| START | line 0 begins start_latency + LED.lead clocks later; the watchdog is active from the run's first clock | ACK \
while the same run is running, or has ended | NOT_ARMED, WRONG_RUN |
| STOP | the run ends after the current line; before START, it ends at once and without a line | ACK | WRONG_RUN, \
unless the run id is 0 |
| CHECK_CODE | CODE_CRC is computed; STATUS.busy is set until it is done; the run id does not matter | done again | BUSY, \
BAD_CODE_LENGTH |
| SELF_TEST | the device tests itself; STATUS.busy is set until it is done; the run id does not matter | done again | BUSY |

The address in such a NAK is that of COMMAND unless another register is at fault. Any other command is answered with
NAK BAD_COMMAND.

A run consists of writing the configuration, ARM, START, tags, and STOP or another end. However it ends, it ends with a
whole line and with the light off; STATUS.state is then ENDED, and STATUS.end_reason gives the reason. Every run has its
own id. To keep a run going, a host must send a request, such as a READ of STATUS, more often than every WATCHDOG clocks.

## States

STATUS.state:

$states
STATUS.end_reason, 0 unless the state is ENDED:

$reasons
## Sources, modes, boards

CODE_SOURCE.kind:

$sources
LINE.mode:

$modes
VERSION.board:

$boards
## Tags

| field | bits | first byte |
|---|---|---|
$tag_fields
run is the low half of the run id. line is the number of the line, counted from 0. code_index is the index of its first
code bit, S · line. timestamp is TIME at the clock of the event; TIME has $time_bits bits and wraps to 0 after 2^$time_bits - 1.

- A tag with LINE has the exact time at which its line starts: START_TIME + line · S · SUBSTEP_CLOCKS.
- A tag without LINE reports one or more events, with the number and code index of the latest line that has begun. Its
  time is that of the event, at most 15 clocks late, or, if the queue was full, that of the clock in which there was room.
- A tag with LAST has the time of the end of the last line, START_TIME + LINES · S · SUBSTEP_CLOCKS, at most 15 clocks
  late (with the same exception), and its line is LINES - 1. If the run ended before its first line (NO_LINES), the tag
  has the time of that end, line 0 and code index 0, and START_TIME is 0. It is sent exactly once per run, as the run's
  last tag.
- The frame's sequence is the low half of TAG_COUNT when the tag was made, 0 for the first of a run: a gap is a lost tag.
  Only tags of lines can be lost, if the queue has no room. Tags are made in the order of their time stamps.

## Flags of a tag

$flags
## Errors

$errors""")
