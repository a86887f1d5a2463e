"""A gateware module with assumptions about its surroundings, claims, and lemmas that help to prove them."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from amaranth.back import rtlil
from amaranth.hdl import (
    Assert,
    Assume,
    ClockDomain,
    Const,
    Cover,
    Fragment,
    Module,
    Mux,
    Signal,
    Value,
    ValueLike,
)
from amaranth.lib.wiring import In

if TYPE_CHECKING:
    from types import FrameType

_CHECK = re.compile(r'cell \$check \$\d+\n(\s+parameter \\FORMAT "(\w+)")')


@dataclass(frozen=True, slots=True)
class Proof:
    """Input of `engine`: the design as RTLIL with its properties as cells ``check.NAME``."""

    name: str
    rtlil: str
    claims: tuple[str, ...]
    lemmas: int
    covers: tuple[str, ...]
    cover_depth: int
    """Clocks from reset within which every cover is reached."""
    depth: int = 1
    """Depth of the induction: the clocks in which all properties must hold for the next one. A pipeline needs
    its length."""


class Harness:
    """Claims and lemmas hold in every clock. Both are asserted; only claims are the purpose of the proof.

    ``m`` takes whatever registers the claims need to remember the past. Nothing has a reset but the
    initial values: a proof's first clock is the first after configuration.
    """

    def __init__(self) -> None:
        self.m = Module()
        self._sync = ClockDomain("sync", reset_less=True)
        self.m.domains += self._sync
        self.claims: list[str] = []
        self.covers: list[str] = []
        self._names: set[str] = set()
        self._facts = 0

    def assume(self, condition: ValueLike) -> None:
        self.m.d.comb += Assume(condition)

    def claim(self, name: str, when: ValueLike, then: ValueLike) -> None:
        self.claims.append(name)
        self.lemma(name, when, then)

    def lemma(self, name: str, when: ValueLike, then: ValueLike) -> None:
        self._take(name)
        self.m.d.comb += Assert(~Value.cast(when).any() | Value.cast(then).any(), name)

    def fact(self, name: str, when: ValueLike, then: ValueLike) -> None:
        """A result of another proof, under assumptions that hold here as well."""
        self._take(name)
        self._facts += 1
        self.assume(~Value.cast(when).any() | Value.cast(then).any())

    def cover(self, name: str, condition: ValueLike) -> None:
        self._take(name)
        self.covers.append(name)
        self.m.d.comb += Cover(condition, name)

    def proof(self, name: str, inputs: list[Signal], cover_depth: int, depth: int = 1) -> Proof:
        text = rtlil.convert(self.m, ports=[self._sync.clk, *inputs])
        text = _CHECK.sub(lambda found: f"cell $check \\check.{found[2]}\n{found[1]}", text)
        lemmas = len(self._names) - len(self.claims) - len(self.covers) - self._facts
        return Proof(
            name=name,
            rtlil=text,
            claims=tuple(self.claims),
            lemmas=lemmas,
            covers=tuple(self.covers),
            cover_depth=cover_depth,
            depth=depth,
        )

    def _take(self, name: str) -> None:
        if name in self._names or not name.isidentifier():
            raise ValueError(f"property name {name!r} is taken or no identifier")
        self._names.add(name)


def opened(component: Any, *kinds: type) -> tuple[Any, ...]:
    """Return the elaborated module, and the locals of its ``elaborate``, or those of its parts of ``kinds``.

    Induction has to refer to registers that no port shows; they have the names of the source.
    """
    wanted: tuple[Any, ...] = kinds or (type(component),)
    local: dict[object, dict[str, Any]] = {kind.elaborate.__code__: {} for kind in wanted}

    def watch(frame: FrameType, event: str, _: object) -> None:
        if event == "return" and frame.f_code in local:
            local[frame.f_code] = dict(frame.f_locals)

    sys.setprofile(watch)
    try:
        fragment = Fragment.get(component, None)
    finally:
        sys.setprofile(None)
    return fragment, *(local[kind.elaborate.__code__] for kind in wanted)


def times(value: Value, factor: Value, most: int) -> Value:
    """Return ``value · factor`` for a factor of 0 to ``most``.

    It is computed by repeated addition: to a solver it is obvious that the next multiple is this one plus
    ``value``.
    """
    multiple: Value = Const(0, len(value) + most.bit_length())
    product = multiple
    for constant in range(1, most + 1):
        multiple = (multiple + value)[: len(product)]
        product = Mux(factor == constant, multiple, product)
    return product


def inputs_of(component: Any) -> list[Signal]:
    """Return the ports whose level the surroundings choose, including those of streams."""
    members = component.signature.flatten(component)
    return [Value.cast(signal) for _, member, signal in members if member.flow == In]
