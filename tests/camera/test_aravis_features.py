"""Features are read and written by what their nodes can do; Aravis' stream has settings as well."""

from __future__ import annotations

import ctypes
import os
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from gige_helpers import WAIT_S, open_in_time, our_camera, spec_at
from waiting import until

from acquire.camera import settings
from acquire.camera.aravis import FAKE, AravisCamera, AravisOpener, load
from acquire.camera.aravis.stream import RECEIVE_BYTES
from acquire.camera.settings import Setting, apply_settings
from acquire.camera.spec import GenicamSpec
from acquire.errors import CameraError, CameraLostError
from acquire.sim.gige.camera import Transmission

pytestmark = pytest.mark.needs_aravis

PUBLISHED = """
<Category Name="Published">
  <pFeature>AcquisitionFrameRateConverter</pFeature> <pFeature>GainInHalves</pFeature>
  <pFeature>PeriodInMs</pFeature> <pFeature>PayloadSize</pFeature> <pFeature>LowGainBits</pFeature>
  <pFeature>GainRawRegister</pFeature> <pFeature>PlainRegister</pFeature>
  <pFeature>LoadSettings</pFeature> <pFeature>LoadRegister</pFeature> <pFeature>Forget</pFeature>
</Category>
<Command Name="LoadSettings"> <pValue>LoadRegister</pValue> <CommandValue>7</CommandValue> </Command>
<IntReg Name="LoadRegister">
  <Address>0x110</Address> <Length>4</Length> <AccessMode>RW</AccessMode> <pPort>Device</pPort>
  <Cachable>NoCache</Cachable> <Sign>Unsigned</Sign> <Endianess>BigEndian</Endianess>
</IntReg>
<Command Name="Forget"> <pValue>ForgetRegister</pValue> <CommandValue>7</CommandValue> </Command>
<IntReg Name="ForgetRegister">
  <Address>0x110</Address> <Length>4</Length> <AccessMode>WO</AccessMode> <pPort>Device</pPort>
  <Cachable>NoCache</Cachable> <Sign>Unsigned</Sign> <Endianess>BigEndian</Endianess>
</IntReg>
<IntConverter Name="GainInHalves">
  <FormulaTo>FROM / 2</FormulaTo> <FormulaFrom>TO * 2</FormulaFrom> <pValue>GainRaw</pValue>
</IntConverter>
<SwissKnife Name="PeriodInMs">
  <pVariable Name="US">AcquisitionFramePeriod</pVariable> <Formula>US / 1000.0</Formula>
</SwissKnife>
<MaskedIntReg Name="LowGainBits">
  <Address>0x110</Address> <Length>4</Length> <AccessMode>RW</AccessMode> <pPort>Device</pPort>
  <LSB>31</LSB> <MSB>30</MSB> <Sign>Unsigned</Sign> <Endianess>BigEndian</Endianess>
</MaskedIntReg>
<Register Name="PlainRegister">
  <Address>0x110</Address> <Length>4</Length> <AccessMode>RW</AccessMode> <pPort>Device</pPort>
</Register>
"""


def fake_camera(*settings: Setting) -> AravisCamera:
    return AravisOpener(GenicamSpec("1", cti=FAKE, settings=settings))()


@pytest.fixture(scope="module")
def described(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AravisCamera]:
    """Aravis' camera, which publishes nodes that compute."""
    library = load()
    camera = fake_camera()
    xml = library.arv_device_get_genicam_xml
    xml.restype, xml.argtypes = ctypes.c_char_p, (ctypes.c_void_p, ctypes.POINTER(ctypes.c_size_t))
    text = xml(camera._device, ctypes.byref(ctypes.c_size_t())).decode()
    camera.close()
    path = tmp_path_factory.mktemp("aravis") / "camera.xml"
    text = text.replace(
        "<pFeature>Debug</pFeature>", "<pFeature>Debug</pFeature><pFeature>Published</pFeature>"
    )
    path.write_text(text.replace("</RegisterDescription>", PUBLISHED + "</RegisterDescription>"))
    name = library.arv_set_fake_camera_genicam_filename
    name.argtypes = (ctypes.c_char_p,)
    name(str(path).encode())
    try:
        opened = fake_camera()
        yield opened
        opened.close()
    finally:
        name(None)


def apply(camera: AravisCamera, *settings: tuple[str, str, object]) -> None:
    apply_settings([Setting(*setting) for setting in settings], camera.features())


def read(camera: AravisCamera, feature: str) -> object:
    node = camera.features()["remote"].find(feature)
    assert node is not None
    return node.read()


@pytest.mark.parametrize(
    ("feature", "value", "behind", "becomes"),
    [
        ("AcquisitionFrameRateConverter", 50.0, "AcquisitionFramePeriod", 20_000),
        ("GainInHalves", 6, "GainRaw", 3),
        ("LowGainBits", 2, "GainRaw", 2),
        ("GainRawRegister", 7, "GainRaw", 7),
    ],
)
def test_a_node_that_computes_is_written_and_what_is_behind_it_follows(
    described: AravisCamera, feature: str, value: float, behind: str, becomes: int
) -> None:
    assert feature in described.features()["remote"].categories()["Published"]
    apply(described, ("remote", behind, 10_000 if "Period" in behind else 0), ("remote", feature, value))
    assert (read(described, feature), read(described, behind)) == (value, becomes)
    assert described.settings()[feature] == value


def test_what_only_computes_is_read_and_is_refused_with_what_it_reads(described: AravisCamera) -> None:
    apply(described, ("remote", "AcquisitionFramePeriod", 40_000))
    assert (read(described, "PeriodInMs"), read(described, "PayloadSize")) == (40.0, 512 * 512)
    with pytest.raises(CameraError, match=r"PeriodInMs = 3: it cannot be written now, it reads 40\.0"):
        apply(described, ("remote", "PeriodInMs", 3))
    with pytest.raises(
        CameraError,
        match="PlainRegister = 3: the feature cannot have this value; possible: nothing that can be",
    ):
        apply(described, ("remote", "PlainRegister", 3))


def test_a_feature_that_fails_comes_with_advice(described: AravisCamera) -> None:
    """It was Aravis' message alone."""
    node = described.features()["remote"].find("PeriodInMs")
    assert node is not None
    with pytest.raises(CameraError, match=r"set PeriodInMs to 3\.0: ") as refused:
        node.write(3.0)
    assert "acquire camera features SERIAL lists" in refused.value.hint


def test_a_command_is_waited_for_until_the_camera_has_carried_it_out(
    described: AravisCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Loading settings takes a camera a while, and overwrites what was set in the meantime."""

    def carry_out() -> None:
        node = described.features()["remote"].find("LoadRegister")
        assert node is not None
        until(lambda: node.read() == 7, "the command")
        time.sleep(0.3)
        node.write(0)

    apply(described, ("remote", "LoadRegister", 0))
    with ThreadPoolExecutor(1) as camera:
        carried_out = camera.submit(carry_out)
        apply(described, ("remote", "LoadSettings", True))
        assert read(described, "LoadRegister") == 0
        carried_out.result()
    monkeypatch.setattr(settings, "COMMAND_S", 0.1)
    with pytest.raises(CameraError, match=r"LoadSettings is not done after 0\.1 s; possible: .*; try: look"):
        apply(described, ("remote", "LoadSettings", True))
    apply(described, ("remote", "Forget", True))  # its register cannot be read: nothing to wait for
    assert read(described, "LoadRegister") == 7
    apply(described, ("remote", "LoadRegister", 0))


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with our_camera(50, Transmission()) as (_, address):
        open_in_time(AravisOpener(spec_at(address, 50))).close()
        yield address


def gige_camera(address: str, *settings: Setting, line_rate_hz: float = 20_000.0) -> AravisCamera:
    return AravisOpener(spec_at(address, 50, *settings, line_rate_hz=line_rate_hz))()


WANTED: dict[str, object] = {
    "packet-size-adjustment": "never",
    "frame-retention": 250_000,
    "packet-timeout": 7000,
    "initial-packet-timeout": 300,
    "packet-resend": "never",
    "packet-request-ratio": 0.5,
    "socket-buffer": "auto",
    "socket-buffer-size": 100_000,
}


def test_parameters_of_the_stream_are_settings_read_back_and_kept_from_one_arming_to_the_next(
    address: str,
) -> None:
    camera = gige_camera(address, *(Setting("stream", name, value) for name, value in WANTED.items()))
    try:
        for _ in range(2):
            found = camera.settings()
            assert {name: found[name] for name in WANTED} == WANTED
            camera.arm()
            found = camera.settings()
            assert {name: found[name] for name in WANTED} == WANTED
            camera.disarm()
    finally:
        camera.close()


@pytest.mark.parametrize(
    ("line_rate_hz", "timeout_us", "retention_us"), [(20_000.0, 20_000, 100_000), (100.0, 500_000, 2_000_000)]
)
def test_a_frame_is_waited_for_as_long_as_its_lines_take(
    address: str, line_rate_hz: float, timeout_us: int, retention_us: int
) -> None:
    camera = gige_camera(address, line_rate_hz=line_rate_hz)
    found = camera.settings()
    camera.close()
    assert (found["packet-timeout"], found["frame-retention"]) == (timeout_us, retention_us)
    assert found["packet-resend"] == "always"
    largest = int(Path("/proc/sys/net/core/rmem_max").read_text())
    assert (found["socket-buffer"], found["socket-buffer-size"]) == ("fixed", min(largest, RECEIVE_BYTES))


def test_its_socket_has_a_large_buffer_before_the_first_packet(address: str) -> None:
    camera = gige_camera(address)
    try:
        camera.arm()
        sizes = []
        for descriptor in filter(Path.is_socket, Path("/proc/self/fd").iterdir()):
            with socket.socket(fileno=os.dup(int(descriptor.name))) as opened:
                if opened.family == socket.AF_INET and opened.type == socket.SOCK_DGRAM:
                    sizes.append(opened.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF))
    finally:
        camera.close()
    largest = int(Path("/proc/sys/net/core/rmem_max").read_text())
    assert max(sizes) == 2 * min(largest, RECEIVE_BYTES)  # the kernel counts its own data, too


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        (
            ("stream", "frame-retension", 3),
            "stream has no feature 'frame-retension'; possible: frame-retention",
        ),
        (("stream", "packet-timeout", -1), "out of range; possible: 0 to 4294967295"),
        (("stream", "packet-timeout", 1.5), "the feature cannot have this value"),
        (("stream", "packet-resend", "sometimes"), "the feature has no such entry; possible: never, always"),
        (("stream", "packet-request-ratio", 3.0), "out of range; possible: 0 to 2"),
        (
            ("stream", "packet-size-adjustment", "default"),
            "the feature has no such entry; possible: never, .*always$",
        ),
        (("stream", "socket-buffer-size", 2**31 - 1), "out of range; possible: -1 to "),
        (("remote", "packet-timeout", 3), "no feature 'packet-timeout'.*try: module stream"),
        (("stream", "Width", 3), "no feature 'Width'.*try: module remote"),
    ],
)
def test_what_the_stream_does_not_have_is_refused_with_what_it_has(
    address: str, setting: tuple[str, str, object], words: str
) -> None:
    with pytest.raises(CameraError, match=words):
        gige_camera(address, Setting(*setting))


def test_packets_are_not_asked_for_again_of_a_camera_that_keeps_none() -> None:
    with our_camera(50, Transmission(resends=False)) as (_, address):
        camera = open_in_time(AravisOpener(spec_at(address, 50)))
        assert camera.settings()["packet-resend"] == "never"
        with pytest.raises(
            CameraError, match="packet-resend = 'always': the feature has no such entry; possible: never"
        ):
            apply(camera, ("stream", "packet-resend", "always"))
        camera.close()


def test_a_slow_frame_whose_packets_trickle_in_is_whole() -> None:
    """Half of the packets come later than Aravis waits for any by default."""

    def slowly(frame: int, packets: list[bytes]) -> Iterator[bytes]:
        for number, packet in enumerate(packets):
            if number == len(packets) // 2:
                time.sleep(0.15)
            yield packet

    with our_camera(50, Transmission(link=slowly)) as (sensor, address):
        camera = open_in_time(AravisOpener(spec_at(address, 50, line_rate_hz=50 / 0.15)))
        try:
            camera.arm()
            sensor.allowed = 3 * 50
            blocks = []
            deadline = time.monotonic() + WAIT_S
            while len(blocks) < 3:
                assert time.monotonic() < deadline
                if (block := camera.next_block(0.1)) is not None:
                    blocks.append((block.first_line, bool(block.flags.any())))
                    camera.release(block)
            assert blocks == [(0, False), (50, False), (100, False)]
        finally:
            camera.close()


def test_frames_that_were_fetched_from_a_camera_that_is_gone_are_freed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each has the memory of a frame, and was lost whenever a camera went away while frames waited."""
    fetched, freed = set(), set()

    class Watched:
        def __getattr__(self, name: str) -> object:
            return getattr(load(), name)

        def arv_stream_timeout_pop_buffer(self, stream: int, wait_us: int) -> int | None:
            fetched.add(buffer := load().arv_stream_timeout_pop_buffer(stream, wait_us))
            return buffer

        def g_object_unref(self, thing: int) -> None:
            freed.add(thing)
            load().g_object_unref(thing)

    def gone() -> int:
        raise CameraError("no answer")

    with our_camera(50, Transmission()) as (sensor, address):
        camera = open_in_time(AravisOpener(spec_at(address, 50)))
        try:
            camera.arm()
            monkeypatch.setattr(camera, "_library", Watched())
            monkeypatch.setattr(camera._missed, "count", gone)
            sensor.allowed = 3 * 50
            with pytest.raises(CameraLostError, match="no answer"):
                until(lambda: camera.next_block(0.2), "a frame")
        finally:
            camera.close()
    assert fetched - {None} <= freed
    assert fetched - {None}
