"""Write firmware/REGISTERS.md and firmware/PROTOCOL.md from acquire.trigger.registers."""

from __future__ import annotations

from pathlib import Path

from acquire.trigger.registers_table import protocol_markdown, registers_markdown

FIRMWARE = Path(__file__).parents[1] / "firmware"

(FIRMWARE / "REGISTERS.md").write_text(registers_markdown(), encoding="utf-8")
(FIRMWARE / "PROTOCOL.md").write_text(protocol_markdown(), encoding="utf-8")
