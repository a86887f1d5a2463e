"""Utilisation of the ULX3S's ECP5-25F, and the trigger's maximum clock there, for placements of three seeds.

    python tools/fpga_report.py             about five minutes, including the paper's XC4VSX55 (area only)
    python tools/fpga_report.py --usb       the board with USB in place of the UART

Ends with 1 if a goal is missed: 95 MHz with every seed, a quarter of the logic. The goals are for the UART.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from rich.console import Console
from rich.table import Table

from firmware.build import Fit, area_xc4vsx55, place, synthesize

SEEDS = (1, 2, 3)
GOAL_MHZ = 95.0
GOAL_AREA = 0.25
LOGIC, MEMORY = "TRELLIS_COMB", "DP16KD"
SHOWN = (LOGIC, "TRELLIS_FF", MEMORY)
VIRTEX_LUTS, VIRTEX_RAMS = 49152, 320
PLACEMENTS_AT_A_TIME = 2


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("build/report"))
    parser.add_argument("--usb", action="store_true")
    chosen = parser.parse_args()
    folder = chosen.out
    synthesize(folder, chosen.usb)
    with ThreadPoolExecutor(PLACEMENTS_AT_A_TIME) as pool:
        fits = list(pool.map(lambda seed: place(folder, seed, must_meet=False), SEEDS))
    Console().print(_table(fits))
    if chosen.usb:
        return 0
    Console().print(_virtex(area_xc4vsx55(folder / "xc4vsx55")))
    good = all(fit.fmax_mhz >= GOAL_MHZ and _share(fit, LOGIC) <= GOAL_AREA for fit in fits)
    return 0 if good else 1


def _table(fits: list[Fit]) -> Table:
    needed = ", ".join(f"{need:.0f}" for _, need in fits[0].clocks.values())
    title = f"goals: {GOAL_MHZ:g} MHz, {GOAL_AREA:.0%} of {LOGIC}"
    table = Table("seed", f"Fmax / MHz, of clocks of {needed}", *SHOWN, title=title)
    for fit in fits:
        shares = (f"{fit.used[kind][0]} ({_share(fit, kind):.1%})" for kind in SHOWN)
        table.add_row(str(fit.seed), ", ".join(f"{mhz:.1f}" for mhz, _ in fit.clocks.values()), *shares)
    return table


def _virtex(cells: dict[str, int]) -> str:
    tables = sum(count for kind, count in cells.items() if kind.startswith("LUT"))
    blocks = cells["RAMB16"]
    return (
        f"XC4VSX55: {tables} LUTs ({tables / VIRTEX_LUTS:.1%}), {blocks} RAMB16 ({blocks / VIRTEX_RAMS:.1%})"
    )


def _share(fit: Fit, kind: str) -> float:
    used, there_are = fit.used[kind]
    return used / there_are


if __name__ == "__main__":
    sys.exit(main())
