"""Designs for the boards: every port has its pin, the netlist fits, the same sources give the same bytes."""

from __future__ import annotations

import json
import re
from collections import Counter
from typing import TYPE_CHECKING

import pytest
from amaranth.back import rtlil
from amaranth.hdl import Fragment, Signal

from firmware.boards import ulx3s
from firmware.build import main, synthesize

if TYPE_CHECKING:
    from pathlib import Path

LOGIC_CELLS, BLOCK_RAMS = 24288, 56
"""Of an ECP5-25F."""


def bits(name: str, width: int, form: str) -> list[str]:
    return [name] if width == 1 else [name + form.format(bit) for bit in range(width)]


def test_every_port_of_the_ulx3s_has_a_pin_of_its_own() -> None:
    board = ulx3s.Ulx3s()
    Fragment.get(board, None)
    ports = [board.reference, *board.pins.values()]
    names = ["reference", *board.pins]
    wanted = [bit for name, port in zip(names, ports, strict=True) for bit in bits(name, len(port), "[{}]")]
    located = re.findall(r'LOCATE COMP "(.+)" SITE "(.+)";', ulx3s.constraints(board.sites))
    assert sorted(name for name, _ in located) == sorted(wanted)
    assert len({site for _, site in located}) == len(located)


def test_the_ulx3s_netlist_fits_a_quarter_of_the_device_and_is_reproducible(tmp_path: Path) -> None:
    synthesize(tmp_path)
    again = ulx3s.Ulx3s()
    assert (tmp_path / "trigger.il").read_text() == rtlil.convert(again, ports=again.ports, emit_src=False)
    netlist = json.loads((tmp_path / "trigger.json").read_text())["modules"]["top"]
    cells = Counter(cell["type"] for cell in netlist["cells"].values())
    assert not [kind for kind in cells if kind.startswith("$_")], "something was not mapped"
    assert cells["LUT4"] + 2 * cells["CCU2C"] <= LOGIC_CELLS // 4
    assert cells["DP16KD"] <= BLOCK_RAMS
    (pll,) = (cell["parameters"] for cell in netlist["cells"].values() if cell["type"] == "EHXPLLL")
    divide = {name.removesuffix("_DIV"): int(pll[name], 2) for name in pll if name.endswith("_DIV")}
    compared_mhz = 25 / divide["CLKI"]
    oscillator_mhz = compared_mhz * divide["CLKFB"] * divide[pll["FEEDBK_PATH"]]
    assert 10 <= compared_mhz <= 400, "the maker's limits of the phase detector"
    assert 400 <= oscillator_mhz <= 800, "and of the oscillator"
    assert oscillator_mhz / divide["CLKOP"] == 90


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_pll_of_usb_is_within_its_limits_too() -> None:
    from firmware.boards.ulx3s_usb import _usb_pll

    parameters = _usb_pll(Signal(), Signal(), Signal()).parameters
    divide = {name.removesuffix("_DIV"): value for name, value in parameters.items() if name.endswith("_DIV")}
    compared_mhz = 90 / divide["CLKI"]
    oscillator_mhz = compared_mhz * divide["CLKFB"] * divide["CLKOS2"]
    assert compared_mhz >= 10
    assert 400 <= oscillator_mhz <= 800
    assert (oscillator_mhz / divide["CLKOP"], oscillator_mhz / divide["CLKOS"]) == (48, 12)


def test_one_command_writes_the_input_of_the_vendor_s_tools(tmp_path: Path) -> None:
    assert main(["xc4vsx55", "--out", str(tmp_path / "one")]) == 0
    assert main(["xc4vsx55", "--out", str(tmp_path / "two")]) == 0
    written = {path.name: path.read_bytes() for path in (tmp_path / "one").iterdir()}
    assert {path.name: path.read_bytes() for path in (tmp_path / "two").iterdir()} == written
    source, constraints = written["trigger.v"].decode(), written["trigger.ucf"].decode()
    ports = re.findall(r"^ {2}(?:input|output) (?:\[(\d+):0\] )?(\w+);", module_trigger(source), re.MULTILINE)
    wanted = [bit for high, name in ports for bit in bits(name, int(high or 0) + 1, "<{}>")]
    assert {name for _, name in ports} == {"clock", "clock_locked", *ulx3s.INPUTS, *ulx3s.OUTPUTS}
    assert sorted(re.findall(r'^NET "(.+)" IOSTANDARD', constraints, re.MULTILINE)) == sorted(wanted)
    assert "PERIOD" in constraints
    assert "11.111 ns" in constraints


def module_trigger(source: str) -> str:
    """Return the text of the Verilog module with the board's pins."""
    return re.split(r"^endmodule", source[source.index("\nmodule trigger(") :], flags=re.MULTILINE)[0]
