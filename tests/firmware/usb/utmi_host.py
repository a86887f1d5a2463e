"""A USB host at the device's UTMI bus, packet by packet: tokens, data with CRC-16, handshakes."""

from __future__ import annotations

from typing import Any

OUT, IN, SETUP = 0xE1, 0x69, 0x2D
DATA0, DATA1, ACK, NAK = 0xC3, 0x4B, 0xD2, 0x5A
_PATIENCE = 2000


class UtmiHost:
    """In the domain ``usb``. Each method is one transaction or a transfer of several."""

    def __init__(self, context: Any, bus: Any) -> None:
        self.context, self.bus, self.address = context, bus, 0
        self.toggles = {OUT: DATA0, IN: DATA0}

    async def control_in(self, request: int, value: int, length: int) -> bytes:
        """A standard request that reads."""
        await self._setup(
            bytes([0x80, request, *value.to_bytes(2, "little"), 0, 0, length & 0xFF, length >> 8])
        )
        answer = b""
        while len(answer) < length:
            part = await self._in(0)
            answer += part
            if len(part) < 64:
                break
        assert await self._out(0, b"", DATA1) == ACK
        return answer

    async def control_out(self, request: int, value: int) -> None:
        """A standard request without data."""
        await self._setup(bytes([0x00, request, *value.to_bytes(2, "little"), 0, 0, 0, 0]))
        assert await self._in(0) == b""

    async def write(self, endpoint: int, data: bytes) -> None:
        for start in range(0, len(data), 64):
            while await self._out(endpoint, data[start : start + 64], self.toggles[OUT]) != ACK:
                pass
            self.toggles[OUT] ^= DATA0 ^ DATA1

    async def read(self, endpoint: int) -> bytes:
        """One packet; waits for it as a host does, by asking again."""
        return await self._in(endpoint)

    async def _setup(self, request: bytes) -> None:
        assert await self._out(0, request, DATA0, token=SETUP) == ACK

    async def _out(self, endpoint: int, data: bytes, toggle: int, token: int = OUT) -> int:
        await self._send(self._token(token, endpoint))
        await self._send(bytes([toggle]) + data + _crc16(data).to_bytes(2, "little"))
        return (await self._receive())[0]

    async def _in(self, endpoint: int) -> bytes:
        for _ in range(_PATIENCE):
            await self._send(self._token(IN, endpoint))
            packet = await self._receive()
            if packet[0] in {DATA0, DATA1}:
                data, checksum = packet[1:-2], packet[-2:]
                assert int.from_bytes(checksum, "little") == _crc16(data)
                await self._send(bytes([ACK]))
                return data
            assert packet[0] == NAK, "stalled"
        raise AssertionError("the device has nothing to say")

    def _token(self, kind: int, endpoint: int) -> bytes:
        bits = self.address | endpoint << 7
        return bytes([kind]) + (bits | _crc5(bits) << 11).to_bytes(2, "little")

    async def _send(self, packet: bytes) -> None:
        set_, bus = self.context.set, self.bus
        set_(bus.rx_active, 1)
        set_(bus.rx_valid, 0)
        await self._tick()
        for byte in packet:
            set_(bus.rx_valid, 1)
            set_(bus.rx_data, byte)
            await self._tick()
        set_(bus.rx_valid, 0)
        set_(bus.rx_active, 0)
        await self._tick(4)

    async def _receive(self) -> bytes:
        self.context.set(self.bus.tx_ready, 1)
        packet = bytearray()
        for _ in range(_PATIENCE):
            if self.context.get(self.bus.tx_valid):
                packet.append(self.context.get(self.bus.tx_data))
            elif packet:
                await self._tick(4)
                return bytes(packet)
            await self._tick()
        raise AssertionError("no answer")

    async def _tick(self, clocks: int = 1) -> None:
        await self.context.tick("usb").repeat(clocks)


def _crc5(bits: int) -> int:
    crc = 0b11111
    for at in range(11):
        crc = (crc >> 1) ^ (0b10100 if (crc ^ bits >> at) & 1 else 0)
    return crc ^ 0b11111


def _crc16(data: bytes) -> int:
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0xA001 if crc & 1 else 0)
    return crc ^ 0xFFFF
