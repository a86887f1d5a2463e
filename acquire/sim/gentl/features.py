"""Features of simulated modules as a table, from which GenICam XML and register contents are generated.

A feature is one register of 8 bytes (64 for texts), little-endian. A selected feature has consecutive
registers, one per entry of its selector.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal
from xml.sax.saxutils import escape

from acquire.sim.gentl.layout import FREE_REGISTERS_AT, PORT_BYTES, TEXT_BYTES, URL_AT, WORD_BYTES, XML_AT

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

Kind = Literal["int", "float", "enum", "bool", "text", "command"]


@dataclass(frozen=True, slots=True)
class Feature:
    """One SFNC or vendor feature.

    ``entries`` are an enumeration's names and numbers; ``maximum`` may be a formula whose variables ``of``
    maps to features; ``at`` is the register's address, given only for registers that the producer uses.
    """

    name: str
    kind: Kind = "int"
    value: int | float | str = 0
    minimum: float = 0
    maximum: float | str = 2**31 - 1
    increment: int = 1
    entries: dict[str, int] = field(default_factory=dict)
    of: dict[str, str] = field(default_factory=dict)
    writable: bool = True
    locked: bool = False
    """Not writable while the host acquires (SFNC TLParamsLocked)."""
    selector: str = ""
    unit: str = ""
    category: str = "DeviceControl"
    tip: str = ""
    at: int = -1

    @property
    def size(self) -> int:
        return TEXT_BYTES if self.kind == "text" else WORD_BYTES


def enum(name: str, names: Sequence[str], category: str, tip: str = "", **more: object) -> Feature:
    """Return an enumeration whose entries count from 0; its value is the first unless given."""
    entries = {entry: number for number, entry in enumerate(names)}
    feature = Feature(name, "enum", names[0], entries=entries, category=category, tip=tip)
    return replace(feature, **more)  # type: ignore[arg-type]


class Module:
    """The features of one GenTL module at their addresses.

    Raises ValueError if the table does not fit into the module's register space.
    """

    def __init__(self, name: str, features: Iterable[Feature], port: str = "") -> None:
        self.name = name
        self.port = port or f"{name}Port"
        self._base = 0
        self.features: dict[str, Feature] = {}
        free = FREE_REGISTERS_AT
        for feature in features:
            placed = feature if feature.at >= 0 else replace(feature, at=free)
            if feature.at < 0:
                free += feature.size * self._copies(feature)
            self.features[feature.name] = placed
        if free > URL_AT:
            raise ValueError(f"module {name} has registers up to {free:#x}, and room only up to {URL_AT:#x}")

    def space(self, base: int = 0) -> bytes:
        """Return the module's whole register space, at address ``base``: values, URL and XML."""
        text = self.xml(base).encode()
        # As GenTL has it: file name, address and length, both in hex without 0x.
        url = f"local:{self.name}.xml;{XML_AT:X};{len(text):X}".encode()
        if XML_AT + len(text) > PORT_BYTES:
            raise ValueError(
                f"module {self.name} has {len(text)} bytes of XML, and room for {PORT_BYTES - XML_AT}"
            )
        space = bytearray(PORT_BYTES)
        for feature in self.features.values():
            if feature.kind == "text":
                # a text ends with a zero
                value = str(feature.value).encode()[: TEXT_BYTES - 1]
            elif feature.kind == "float":
                value = struct.pack("<d", float(feature.value))
            elif feature.kind == "enum":
                value = struct.pack("<Q", feature.entries[str(feature.value)])
            else:
                value = struct.pack("<Q", int(feature.value))
            for copy in range(self._copies(feature)):
                at = feature.at + copy * feature.size
                space[at : at + len(value)] = value
        space[URL_AT : URL_AT + len(url)] = url
        space[XML_AT : XML_AT + len(text)] = text
        return bytes(space)

    def _copies(self, feature: Feature) -> int:
        return len(self.features[feature.selector].entries) if feature.selector else 1

    def xml(self, base: int = 0) -> str:
        """Return the GenICam description (schema 1.1); the node order within an element is the schema's."""
        self._base = base
        categories: dict[str, list[str]] = {}
        for feature in self.features.values():
            categories.setdefault(feature.category, []).append(feature.name)
        parts = [_HEAD.format(name=self.name, port=self.port)]
        parts.append(_category("Root", list(categories)))
        parts += [_category(name, members) for name, members in categories.items()]
        for feature in self.features.values():
            selected = "".join(
                f"<pSelected>{other.name}</pSelected>"
                for other in self.features.values()
                if other.selector == feature.name
            )
            parts.append(_NODES[feature.kind](self, feature, selected))
        parts.append(f'<Port Name="{self.port}"/>\n</RegisterDescription>\n')
        return "".join(parts)

    def _register(self, feature: Feature, kind: str, tail: str) -> str:
        index = f'<pIndex Offset="{feature.size}">{feature.selector}Reg</pIndex>' if feature.selector else ""
        access = "WO" if feature.kind == "command" else "RW" if feature.writable else "RO"
        # Not cachable: the producer changes some registers itself, such as PayloadSize.
        return (
            f'<{kind} Name="{feature.name}Reg"><Address>{self._base + feature.at}</Address>{index}'
            f"<Length>{feature.size}</Length><AccessMode>{access}</AccessMode>"
            f"<pPort>{self.port}</pPort><Cachable>NoCache</Cachable>{tail}</{kind}>\n"
        )

    def _integer(self, feature: Feature, selected: str) -> str:
        if isinstance(feature.maximum, str):  # a formula, which needs a node of its own
            name = f"{feature.name}Max"
            variables = "".join(
                f'<pVariable Name="{variable}">{of}Reg</pVariable>' for variable, of in feature.of.items()
            )
            formula = f"<Formula>{escape(feature.maximum)}</Formula>"
            maximum = f"<pMax>{name}</pMax>"
            swiss_knife = f'<IntSwissKnife Name="{name}">{variables}{formula}</IntSwissKnife>\n'
        else:
            maximum, swiss_knife = f"<Max>{int(feature.maximum)}</Max>", ""
        unit = f"<Unit>{feature.unit}</Unit>" if feature.unit else ""
        return (
            f'<Integer Name="{feature.name}">{_common(feature)}<pValue>{feature.name}Reg</pValue>'
            f"<Min>{int(feature.minimum)}</Min>{maximum}<Inc>{feature.increment}</Inc>{unit}{selected}"
            f"</Integer>\n{swiss_knife}{self._register(feature, 'IntReg', _INT)}"
        )

    def _real(self, feature: Feature, selected: str) -> str:
        assert not isinstance(feature.maximum, str)
        unit = f"<Unit>{feature.unit}</Unit>" if feature.unit else ""
        return (
            f'<Float Name="{feature.name}">{_common(feature)}<pValue>{feature.name}Reg</pValue>'
            f"<Min>{feature.minimum}</Min><Max>{feature.maximum}</Max>{unit}{selected}</Float>\n"
            f"{self._register(feature, 'FloatReg', _LITTLE)}"
        )

    def _enumeration(self, feature: Feature, selected: str) -> str:
        entries = "".join(
            f'<EnumEntry Name="{name}"><Value>{number}</Value></EnumEntry>'
            for name, number in feature.entries.items()
        )
        return (
            f'<Enumeration Name="{feature.name}">{_common(feature)}{entries}'
            f"<pValue>{feature.name}Reg</pValue>{selected}</Enumeration>\n"
            f"{self._register(feature, 'IntReg', _INT)}"
        )

    def _boolean(self, feature: Feature, selected: str) -> str:
        return (
            f'<Boolean Name="{feature.name}">{_common(feature)}<pValue>{feature.name}Reg</pValue>'
            f"<OnValue>1</OnValue><OffValue>0</OffValue>{selected}</Boolean>\n"
            f"{self._register(feature, 'IntReg', _INT)}"
        )

    def _command(self, feature: Feature, _: str) -> str:
        return (
            f'<Command Name="{feature.name}">{_common(feature)}<pValue>{feature.name}Reg</pValue>'
            f"<CommandValue>1</CommandValue></Command>\n{self._register(feature, 'IntReg', _INT)}"
        )

    def _text(self, feature: Feature, _: str) -> str:
        access = "RW" if feature.writable else "RO"
        return (
            f'<StringReg Name="{feature.name}">{_common(feature)}<Address>{self._base + feature.at}</Address>'
            f"<Length>{feature.size}</Length><AccessMode>{access}</AccessMode>"
            f"<pPort>{self.port}</pPort></StringReg>\n"
        )


_NODES = {
    "int": Module._integer,
    "float": Module._real,
    "enum": Module._enumeration,
    "bool": Module._boolean,
    "command": Module._command,
    "text": Module._text,
}
_INT = "<Sign>Unsigned</Sign><Endianess>LittleEndian</Endianess>"
_LITTLE = "<Endianess>LittleEndian</Endianess>"
_HEAD = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<RegisterDescription ModelName="{name}" VendorName="acquire" StandardNameSpace="None"'
    ' SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" MajorVersion="1"'
    ' MinorVersion="0" SubMinorVersion="0" ToolTip="simulated"'
    ' ProductGuid="5A1D2B1C-70D1-4C1A-A2F0-0C0A0E1D2B1C"'
    ' VersionGuid="5A1D2B1C-70D1-4C1A-A2F0-0C0A0E1D2B1D" xmlns="http://www.genicam.org/GenApi/Version_1_1"'
    ' xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"'
    ' xsi:schemaLocation="http://www.genicam.org/GenApi/Version_1_1'
    ' http://www.genicam.org/GenApi/GenApiSchema_Version_1_1.xsd">\n'
)


def _category(name: str, members: Iterable[str]) -> str:
    features = "".join(f"<pFeature>{member}</pFeature>" for member in members)
    return f'<Category Name="{name}">{features}</Category>\n'


def _common(feature: Feature) -> str:
    tip = f"<ToolTip>{escape(feature.tip)}</ToolTip>" if feature.tip else ""
    locked = "<pIsLocked>TLParamsLockedReg</pIsLocked>" if feature.locked else ""
    return f"{tip}<DisplayName>{feature.name}</DisplayName>{locked}"
