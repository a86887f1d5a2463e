"""Description of a register: its address, its access, and its fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

WORD_BITS = 32

Access = Literal["constant", "read", "config", "operand", "command"]
"""Access of a register:

``constant`` never changes; ``read`` is changed by the device; ``config`` is written while no run is armed or
running, and reads back; ``operand`` is written at any time and reads back; ``command`` acts when written
and reads as 0.
"""


@dataclass(frozen=True, slots=True)
class Field:
    """Bits ``low .. low + width - 1`` of a register."""

    name: str
    low: int
    width: int = 1
    doc: str = ""

    @property
    def limit(self) -> int:
        """The largest value that fits."""
        return (1 << self.width) - 1

    def of(self, value: int) -> int:
        """Return this field of a register's value."""
        return value >> self.low & self.limit

    def put(self, value: int) -> int:
        """Return a register's value with only this field set. Raises ValueError if it does not fit."""
        if not 0 <= value <= self.limit:
            raise ValueError(f"{self.name} = {value} does not fit {self.width} bits")
        return value << self.low


@dataclass(frozen=True, slots=True)
class Register:
    """One register: ``width`` bits from the word ``address`` on, ``reset`` after power-up."""

    name: str
    address: int
    access: Access
    width: int
    doc: str
    fields: tuple[Field, ...] = ()
    reset: int = 0

    @property
    def words(self) -> int:
        """Number of 32-bit words."""
        return -(-self.width // WORD_BITS)

    @property
    def writable(self) -> bool:
        """Whether the host may write it."""
        return self.access in ("config", "operand", "command")

    def __getattr__(self, name: str) -> Field:
        """``STATUS.state`` is the field of that name."""
        if name.startswith("_"):  # copying and pickling look for special methods, which are no fields
            raise AttributeError(name)
        return self.field(name)

    def field(self, name: str) -> Field:
        """Return the field of that name. Raises AttributeError if there is none."""
        for field in self.fields:
            if field.name == name:
                return field
        raise AttributeError(f"register {self.name} has no field {name!r}")

    def pack(self, **values: int) -> int:
        """Return a value with these fields; the others are 0."""
        return sum(self.field(name).put(value) for name, value in values.items())

    def unpack(self, value: int) -> dict[str, int]:
        """Return the values of all fields by name."""
        return {field.name: field.of(value) for field in self.fields}

    def to_words(self, value: int) -> tuple[int, ...]:
        """Return a value as words, the low one first. Raises ValueError if it does not fit."""
        if not 0 <= value < 1 << self.width:
            raise ValueError(f"{self.name} = {value} does not fit {self.width} bits")
        return tuple(value >> WORD_BITS * i & 0xFFFFFFFF for i in range(self.words))
