"""The text of ``firmware/PROTOCOL.md``; `acquire.trigger.registers_table` fills in the tables and numbers."""

# ruff: noqa: E501 - a table's row is one line, and the rest is as wide as the other documents
from __future__ import annotations

from string import Template

PROTOCOL = Template("""\
$note

# The sync trigger's protocol, version $version

This and [REGISTERS.md](REGISTERS.md) are all that a host needs to know. Numbers are little endian, and decimal
unless 0x is in front of them.

## Frames

Bytes in both directions (UART, 8 data bits, no parity, one stop bit; or USB bulk) are frames:

| field | bytes | |
|---|---|---|
| version | 1 | $version |
| type | 1 | see Types |
| sequence | 2 | of a request: any; of its answer: the same; of a TAG: see Tags |
| payload | 0 to $max_payload | by the type |
| crc | 4 | CRC-32 of all bytes before it, as zlib has it: reflected, polynomial 0xEDB88320, first and last XOR 0xFFFFFFFF |

The whole is encoded by COBS (consistent overhead byte stuffing): it is cut at its zeros, which are left out, and
every piece is preceded by its length + 1. A piece of 254 bytes is preceded by 255, and no zero was left out after it.
One byte 0x00 ends the frame. What is between two zeros and is no frame is dropped: the device counts it in RX_ERRORS
and does not answer. Nothing between two zeros is no error, so a host may send a zero at any time to begin anew.

## Types

$types
| type | payload |
|---|---|
| READ | address u16, count u8: 1 to $max_words words |
| WRITE | address u16, 1 to $max_words words u32 |
| DATA | address u16, words u32 |
| ACK | address u16, count u8 |
| NAK | error u16 (see Errors), address u16: the word at fault, 0 where there is none |
| TAG | see Tags |

- Requests are answered in their order. The device does not compare sequences: a request that is sent twice is done
  twice, and every request may be sent twice (see Commands).
- A host keeps no more than QUEUES.rx_bytes encoded bytes of unanswered requests on the way.
- An address counts words of 32 bits. The map ends before $map_end. The code memory is from $code_memory on and has CODE_BITS
  bits, code bit 0 in bit 0 of its first word. A READ that goes beyond either is NAK BAD_ADDRESS with its first
  address. A READ of the code memory is NAK BUSY while a run is armed or runs. A word of the map where no register is
  reads as 0.
- Words of a WRITE take effect one after the other, at rising addresses. At the first that cannot, NAK says which, and
  those before it have taken effect. A word where no register is, or beyond the map, is NAK BAD_ADDRESS; only a 0
  within the map may be written there, so that a block of registers is one WRITE.
- A register ignores the bits of a word above its own width and reads them as 0. A register of 32 bits with fields
  keeps all 32; write those without a meaning as 0.
- A register wider than 32 bits takes two words, the low one first. A READ takes all words of the registers of access
  `read` in one clock: the halves belong together if they come in one READ.
- A WRITE to a register of access `config`, or to the code memory, is NAK BUSY while a run is armed, runs or stops,
  and while the device is busy (STATUS.busy, or the last tag of a run waits for room).
- The watchdog hears every READ and WRITE of good form (version, type and length), done or refused, and nothing else.

## Commands

$commands
One WRITE of three words from RUN_ID on: the run id (64 bits, not 0), then the command. Asking again changes nothing:

| command | what is done | asked again | refused |
|---|---|---|---|
| ARM | configuration checked, counters cleared, state ARMED; an external edge of the next 4 clocks is ignored | ACK \
while the same run is armed or runs | BUSY: another run is armed or runs, STATUS.busy, or the last tag of the run \
before waits for room; RUN_OVER; BAD_RUN_ID; an error of 32 or more: the configuration, with the register at fault, \
in REJECT as well |
| START | line 0 begins start_latency + LED.lead clocks later; the watchdog watches from the run's first clock | ACK \
while the same run runs, or has ended | NOT_ARMED, WRONG_RUN |
| STOP | the run ends after the line that runs; before START, at once and without a line | ACK | WRONG_RUN, unless \
the run id is 0 |
| CHECK_CODE | CODE_CRC is computed, STATUS.busy until then; the run id does not matter | done again | BUSY, \
BAD_CODE_LENGTH |
| SELF_TEST | the device tests itself, STATUS.busy until then; the run id does not matter | done again | BUSY |

The address of such a NAK is that of COMMAND where no other register is at fault. Any other number is NAK BAD_COMMAND.

A run: the configuration is written, then ARM, START, tags, and STOP or another end. Whatever ends it, it ends with a
whole line and with the light off; STATUS.state is ENDED then, and STATUS.end_reason says why. Every run has an id of
its own. A host that wants to keep a run going asks something, STATUS for example, more often than every WATCHDOG
clocks.

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
run: the low half of the run id. line: number of the line, from 0. code_index: index of its first code bit, S · line.
timestamp: TIME in the clock in which it happened; TIME has $time_bits bits and begins again at 0 after 2^$time_bits - 1.

- A tag with LINE has the time at which its line starts, exactly: START_TIME + line · S · SUBSTEP_CLOCKS.
- A tag without it tells of one or more events, with the number and code index of the latest line that has begun. Its
  time is that of the event, at most 15 clocks late; if the queue was full, that of the clock in which it had room.
- LAST has the time of the end of the last line, START_TIME + LINES · S · SUBSTEP_CLOCKS, at most 15 clocks late (with
  the same exception), and its line is LINES - 1. Of a run that ends before its first line (NO_LINES) it has the time
  of that end, line 0 and code index 0; START_TIME is 0. It comes once per run, always, and is the run's last tag.
- The frame's sequence is the low half of TAG_COUNT when the tag was made, 0 for a run's first: a gap is a lost tag.
  Only tags of lines are ever lost, for want of room in the queue. Tags are made in the order of their time stamps.

## Flags of a tag

$flags
## Errors

$errors""")
