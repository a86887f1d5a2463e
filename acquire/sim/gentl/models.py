"""The modules of the simulated cameras, with the feature names of TDI CoaXPress cameras and their grabbers.

Features have their public SFNC names where these exist. SFNC has none for time delay and integration, so
those features are named as in cameras on the market.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from acquire.sim.gentl.features import Feature, Module, enum
from acquire.sim.gentl.layout import PIXEL_FORMATS, REGISTERS

VENDOR = "acquire"
MODEL = "simulated TDI line-scan camera"


@dataclass(frozen=True, slots=True)
class CameraModel:
    """The properties of one simulated camera.

    ``row_padding`` bytes follow every line in a buffer. Frame ids have ``id_bits`` bits, and start at
    ``id_first``, also after they wrap around.
    """

    serial: str
    sensor_width: int
    bits: int = 12
    model: str = MODEL
    firmware: str = "1.0"
    line_rate_hz: float = 100_000.0
    pixel_format: str = "Mono12"
    row_padding: int = 0
    id_bits: int = 64
    id_first: int = 0

    @property
    def sample_bytes(self) -> int:
        """Bytes of an unpacked sample."""
        return 1 if self.bits <= 8 else 2


def remote(model: CameraModel) -> Module:
    """The camera itself."""
    analog, counters = "AnalogControl", "CounterAndTimerControl"
    return Module(
        "Remote",
        (
            *_identity(model),
            *_image(model),
            *_acquisition(model),
            enum("AnalogGain", [f"Gain{n}" for n in ("1x", "2x", "4x")], analog),
            Feature("DigitalGain", "float", 1.0, 1.0, 32.0, category=analog),
            enum("BinningHorizontal", ["X1"], analog),
            enum("BinningVertical", ["X1"], analog),
            enum("CounterSelector", ["Counter0"], counters),
            enum("CounterEventSource", ["LineTriggerMissed"], counters),
            Feature(
                "CounterValue", maximum=2**62, writable=False, category=counters, at=REGISTERS["CounterValue"]
            ),
        ),
    )


def _identity(model: CameraModel) -> tuple[Feature, ...]:
    text = [
        ("DeviceVendorName", VENDOR),
        ("DeviceModelName", model.model),
        ("DeviceSerialNumber", model.serial),
        ("DeviceFirmwareVersion", model.firmware),
    ]
    return (
        *(Feature(name, "text", value, writable=False) for name, value in text),
        enum("DeviceScanType", ["Linescan"], "DeviceControl", writable=False),
        Feature("DeviceTemperature", "float", 35.0, -50.0, 150.0, writable=False, unit="C"),
        Feature(
            "TLParamsLocked", value=0, maximum=1, category="TransportLayerControl",
            at=REGISTERS["TLParamsLocked"],
        ),
        Feature(
            "PayloadSize", writable=False, category="TransportLayerControl", unit="B",
            at=REGISTERS["PayloadSize"],
        ),
    )  # fmt: skip


def _image(model: CameraModel) -> tuple[Feature, ...]:
    category, width = "ImageFormatControl", model.sensor_width
    formats = {name: code for name, (code, _, _) in PIXEL_FORMATS.items()}
    return (
        Feature("SensorWidth", value=width, maximum=width, writable=False, category=category),
        Feature(
            "Width", value=width, minimum=1, maximum="SENSOR - OFFSET",
            of={"SENSOR": "SensorWidth", "OFFSET": "OffsetX"},
            locked=True, category=category, at=REGISTERS["Width"],
        ),
        Feature(
            "OffsetX", value=0, maximum="SENSOR - WIDTH", of={"SENSOR": "SensorWidth", "WIDTH": "Width"},
            locked=True, category=category, at=REGISTERS["OffsetX"],
        ),
        Feature(
            "Height", value=1, minimum=1, maximum=1, category=category, at=REGISTERS["Height"],
            tip="a line-scan camera sends lines; the stream's BufferHeight sets the lines per buffer",
        ),
        Feature(
            "PixelFormat", "enum", model.pixel_format, entries=formats, locked=True, category=category,
            at=REGISTERS["PixelFormat"],
        ),
        enum("ReverseX", ["Off"], category, writable=False),
    )  # fmt: skip


def _acquisition(model: CameraModel) -> tuple[Feature, ...]:
    category = "AcquisitionControl"
    return (
        enum("AcquisitionMode", ["Continuous"], category),
        Feature("AcquisitionStart", "command", category=category, at=REGISTERS["AcquisitionStart"]),
        Feature("AcquisitionStop", "command", category=category, at=REGISTERS["AcquisitionStop"]),
        Feature(
            "AcquisitionLineRate", "float", model.line_rate_hz, 1.0, 2e6, category=category, unit="Hz",
            tip="line rate that the camera is prepared for; a line trigger alone sets the actual rate",
        ),
        enum("OperationMode", ["TDI", "Area"], category, locked=True),
        enum("TDIStages", [f"TDI{n}" for n in (64, 128, 192, 256)], category, locked=True),
        enum("ScanDirection", ["Forward", "Reverse"], category, locked=True),
        enum("TriggerSelector", ["FrameStart", "LineStart"], category),
        enum("TriggerMode", ["Off", "On"], category, selector="TriggerSelector"),
        enum("TriggerSource", ["CXPin", "LineIn0"], category, selector="TriggerSelector"),
        enum("TriggerActivation", ["RisingEdge", "FallingEdge"], category, selector="TriggerSelector"),
    )  # fmt: skip


def gige(model: CameraModel) -> Module:
    """The camera with a GigE Vision port: its frames have a height, and its pixels are not packed."""
    features = dict(remote(model).features)
    features["Height"] = replace(features["Height"], value=256, maximum=4096, tip="lines per frame")
    payload = 256 * model.sensor_width * model.sample_bytes
    features["PayloadSize"] = replace(features["PayloadSize"], value=payload)
    formats = {name: PIXEL_FORMATS[name][0] for name in ("Mono8", "Mono10", "Mono12", "Mono16")}
    del features["PixelFormat"]  # which is appended instead
    features["PixelFormat"] = Feature(
        "PixelFormat", "enum", model.pixel_format, entries=formats, locked=True,
        category="ImageFormatControl", at=REGISTERS["PixelFormat"],
    )  # fmt: skip
    return Module("Remote", features.values(), port="Device")  # the port's name in GigE Vision


def device(model: CameraModel) -> Module:
    """The camera as the grabber sees it."""
    category = "DeviceControl"
    return Module(
        "Device",
        (
            Feature("DeviceID", "text", model.serial, writable=False),
            enum("DeviceType", ["CXP"], category, writable=False),
            enum("CameraControlMethod", ["NC", "RG", "EXTERNAL"], category),
            Feature("CycleMinimumPeriod", "float", 1.0, 0.1, 1e6, category=category, unit="us"),
            enum("CycleTriggerSource", ["Immediate", "LIN1"], category),
            enum("CxpTriggerMessageFormat", ["Pulse", "RisingEdge"], category),
        ),
    )


def stream() -> Module:
    """The link from the grabber to memory, which sets the number of lines per buffer."""
    category = "StreamControl"
    return Module(
        "Stream",
        (
            Feature("StreamID", "text", "Stream0", writable=False, category=category),
            Feature(
                "BufferHeight", value=256, minimum=1, maximum=65536, category=category,
                at=REGISTERS["BufferHeight"], tip="lines per buffer",
            ),
            Feature(
                "StreamPayloadSize", writable=False, category=category, unit="B",
                at=REGISTERS["StreamPayloadSize"],
            ),
            enum("StartOfScanTriggerSource", ["Immediate"], category),
        ),
    )  # fmt: skip


def system() -> Module:
    return Module("System", (Feature("TLID", "text", "acquire-simulated", writable=False),))


def interface() -> Module:
    """The grabber card."""
    category = "InterfaceControl"
    return Module(
        "Interface",
        (
            Feature("InterfaceID", "text", "simulated grabber", writable=False, category=category),
            enum("LineInputToolSelector", ["LIN1", "LIN2"], category),
            enum("LineInputToolSource", ["DIN11", "DIN12"], category, selector="LineInputToolSelector"),
            enum(
                "LineInputToolActivation", ["RisingEdge", "FallingEdge"], category,
                selector="LineInputToolSelector",
            ),
        ),
    )  # fmt: skip
