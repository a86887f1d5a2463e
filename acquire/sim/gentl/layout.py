"""Layout of the file through which a simulated camera and its GenTL producer communicate.

::

    words      the camera, the format of lines, head and tail of the line ring, faults    (64-bit words)
    ports      register space of the modules: remote device, device, stream               (64 KiB each)
    headers    (line id, t_ns) per line                                                   (16 bytes each)
    lines      sensor-wide samples, uint8 or uint16                                       (a ring)

There is one file per camera, and one with the ports of system and interface. Python writes all of it and
every line; the producer (in C) reads lines and serves the ports. The numbers are defined only here: `header`
passes them to the compiler.
"""

from __future__ import annotations

MAGIC = int.from_bytes(b"ACQCAM01", "little")
VERSION = 1

WORD_BYTES = 8
PORT_BYTES = 1 << 16
XML_AT = 0x2000
"""Start of the XML within a port's space; registers are below it."""
URL_AT = 0x1F00
"""Start of the XML's URL within a port's space, as zero-terminated text."""
TEXT_BYTES = 64
PORTS_AT = 0x4000

WORDS = (
    "MAGIC", "VERSION",
    "PRESENT", "PLUGGED",
    "SESSION", "ACK",
    "HEAD", "TAIL", "BEGIN",
    "SENSOR_WIDTH", "SAMPLE_BYTES", "SENSOR_BITS",
    "LINE_CAPACITY", "LINE_STRIDE", "HEADERS_AT", "LINES_AT",
    "ROW_PADDING", "ID_BITS", "ID_FIRST",
    "FRAMES", "DELIVERED", "UNDERRUNS", "FAULTS_FIRED",
)  # fmt: skip
"""Words at the beginning of the file.

PRESENT      1 while the camera is plugged in; PLUGGED counts how often it was plugged in
SESSION, ACK odd while the host acquires; the feeder copies it to ACK once it has carried out the request
HEAD, TAIL   total lines written by the feeder, and total lines taken by the producer
BEGIN        HEAD when the host started to acquire: lines before it are of an earlier acquisition
"""

FAULTS_AT = 64
FAULTS = 64
FAULT_WORDS = 4
"""Words of a fault: kind (0: free), frame or line at which it happens, count, whether it has happened."""

FAULT_KINDS = ("", "BAD", "SHORT", "DROP", "OVERRUN", "GONE", "MISSED")

TEXTS_AT = 0x1000
TEXTS = ("SERIAL", "MODEL", "VENDOR", "FIRMWARE")

PORTS = ("REMOTE", "DEVICE", "STREAM")
HOST_PORTS = ("SYSTEM", "INTERFACE")
HOST_FILE = "host.ports"
SUFFIX = ".camera"
HEADER_BYTES = 16

PIXEL_FORMATS = {
    "Mono8": (0x01080001, 8, 8),
    "Mono10": (0x01100003, 10, 16),
    "Mono10p": (0x010A0046, 10, 10),
    "Mono10Packed": (0x010C0004, 10, 12),
    "Mono12": (0x01100005, 12, 16),
    "Mono12p": (0x010C0047, 12, 12),
    "Mono12Packed": (0x010C0006, 12, 12),
    "Mono16": (0x01100007, 16, 16),
}
"""SFNC name → PFNC code, significant bits, stored bits per pixel."""

REGISTERS = {
    "Width": 0x00, "OffsetX": 0x08, "Height": 0x10, "PixelFormat": 0x18, "PayloadSize": 0x20,
    "AcquisitionStart": 0x28, "AcquisitionStop": 0x30, "CounterValue": 0x38, "TLParamsLocked": 0x40,
    "BufferHeight": 0x00, "StreamPayloadSize": 0x08,
}  # fmt: skip
"""Registers that the producer itself reads or writes; the last two are the stream's."""
FREE_REGISTERS_AT = 0x100  # above those of the producer


def header() -> str:
    """Return the same numbers as a C header."""
    numbers: dict[str, int] = {
        "MAGIC": MAGIC,
        "VERSION": VERSION,
        "PORTS_AT": PORTS_AT,
        "PORT_BYTES": PORT_BYTES,
        "URL_AT": URL_AT,
        "FAULTS_AT": FAULTS_AT,
        "FAULTS": FAULTS,
        "FAULT_WORDS": FAULT_WORDS,
        "TEXT_BYTES": TEXT_BYTES,
        "HEADER_BYTES": HEADER_BYTES,
    }
    numbers |= {f"W_{name}": at for at, name in enumerate(WORDS)}
    numbers |= {f"FAULT_{name or 'NONE'}": number for number, name in enumerate(FAULT_KINDS)}
    numbers |= {f"{name}_AT": TEXTS_AT + at * TEXT_BYTES for at, name in enumerate(TEXTS)}
    numbers |= {f"PORT_{name}": at for ports in (PORTS, HOST_PORTS) for at, name in enumerate(ports)}
    numbers |= {f"REG_{name}": at for name, at in REGISTERS.items()}
    numbers |= {f"PFNC_{name}": code for name, (code, _, _) in PIXEL_FORMATS.items()}
    lines = [f"#define {name} {value:#x}ULL" for name, value in numbers.items()]
    lines += [f'#define HOST_FILE "{HOST_FILE}"', f'#define SUFFIX "{SUFFIX}"']
    return "\n".join(lines) + "\n"
