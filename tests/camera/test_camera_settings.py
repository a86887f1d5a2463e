"""Settings against the real node maps of our producer's camera: what is refused says what is possible."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from ramp_sensor import RampOpener

from acquire.camera.harvesters import HarvestersCamera
from acquire.camera.settings import Setting, apply_settings
from acquire.camera.spec import GenicamSpec, spec_of
from acquire.config import load_rig
from acquire.errors import CameraError, ConfigError
from acquire.sim.gentl.bench import GentlBench
from acquire.sim.gentl.models import CameraModel

pytestmark = pytest.mark.needs_compiler


@pytest.fixture(scope="module")
def camera() -> Iterator[HarvestersCamera]:
    with GentlBench({CameraModel("S", 64): RampOpener(width=64)}) as bench:
        opened = HarvestersCamera(GenicamSpec("S", cti=str(bench.cti)))
        yield opened
        opened.close()


def apply(camera: HarvestersCamera, *settings: tuple[str, str, object]) -> None:
    apply_settings([Setting(*setting) for setting in settings], camera.features())


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        (("remote", "Widht", 3), r"remote has no feature 'Widht'; possible: Width, "),
        (("remote", "BufferHeight", 3), r"no feature 'BufferHeight'; .*try: module stream"),
        (("camera", "Width", 3), r"module 'camera'; possible: remote, interface, device, stream, system"),
        (("remote", "Width", 65), r"Width = 65: the value is out of range; possible: 1 to 64"),
        (("remote", "Width", 1.5), r"Width = 1.5: the feature cannot have this value; possible: 1 to 64"),
        (("remote", "Width", True), r"the feature cannot have this value"),
        (("remote", "Width", "wide"), r"the feature cannot have this value"),
        (("remote", "Width", float("inf")), r"the feature cannot have this value"),
        (("remote", "Width", 10**400), r"Width = 10+\.\.\.0+: the value is out of range; possible: 1 to 64"),
        (("remote", "Width", 1 << 20_000), r"the value is out of range; possible: 1 to 64"),
        (
            ("remote", "TDIStages", "TDI96"),
            r"the feature has no such entry; possible: TDI64, TDI128, TDI192, TDI256",
        ),
        (("remote", "TDIStages", 64), r"the feature cannot have this value; possible: TDI64"),
        (("remote", "DigitalGain", "nan"), r"cannot have this value"),
        (("remote", "DigitalGain", 10**400), r"cannot have this value"),
        (("remote", "DigitalGain", 99), r"out of range; possible: 1 to 32"),
        (("remote", "SensorWidth", 64), r"cannot be written now, it reads 64"),
        (("remote", "DeviceModelName", "x"), r"cannot be written now"),
    ],
)
def test_what_cannot_be_had_is_refused_with_what_can(
    camera: HarvestersCamera, setting: tuple[str, str, object], words: str
) -> None:
    with pytest.raises(CameraError, match=words):
        apply(camera, setting)


def test_values_are_coerced_by_the_feature_s_type(camera: HarvestersCamera) -> None:
    apply(
        camera,
        ("remote", "Width", "0x20"),
        ("remote", "OffsetX", 4.0),
        ("remote", "DigitalGain", 2),
        ("remote", "TDIStages", "TDI192"),
        ("stream", "BufferHeight", 8),
        ("device", "CameraControlMethod", "RG"),
        ("interface", "LineInputToolSelector", "LIN2"),
        ("interface", "LineInputToolSource", "DIN12"),
    )
    settings = camera.settings()
    assert (settings["Width"], settings["OffsetX"], settings["TDIStages"]) == (32, 4, "TDI192")
    assert (settings["DigitalGain"], settings["BufferHeight"]) == (2.0, 8)
    apply(camera, ("remote", "OffsetX", 0), ("remote", "Width", 64))


def test_the_order_is_the_user_s(camera: HarvestersCamera) -> None:
    with pytest.raises(CameraError, match="OffsetX = 32: the value is out of range; possible: 0 to 0"):
        apply(camera, ("remote", "OffsetX", 32), ("remote", "Width", 32))
    apply(camera, ("remote", "Width", 32), ("remote", "OffsetX", 32))
    apply(camera, ("remote", "OffsetX", 0), ("remote", "Width", 64))


def test_a_setting_that_a_later_one_undoes_is_refused(camera: HarvestersCamera) -> None:
    def settings() -> Iterator[Setting]:
        yield Setting("remote", "Width", 32)
        node = camera.features()["remote"].find("Width")
        assert node is not None
        node.write(16)  # as modes of real cameras do
        yield Setting("remote", "OffsetX", 0)

    with pytest.raises(CameraError, match="Width = 32: the camera has 16 after a later setting"):
        apply_settings(settings(), camera.features())
    apply(camera, ("remote", "Width", 64))


def test_selected_features_keep_a_value_per_selection(camera: HarvestersCamera) -> None:
    apply(
        camera,
        ("remote", "TriggerSelector", "LineStart"),
        ("remote", "TriggerMode", "On"),
        ("remote", "TriggerSelector", "FrameStart"),
        ("remote", "TriggerMode", "Off"),
    )
    assert camera.settings()["TriggerMode"] == "Off"
    apply(camera, ("remote", "TriggerSelector", "LineStart"))
    assert camera.settings()["TriggerMode"] == "On"


def test_sizes_are_locked_while_lines_come(camera: HarvestersCamera) -> None:
    camera.arm()
    with pytest.raises(CameraError, match="Width = 32: it cannot be written now, it reads 64"):
        apply(camera, ("remote", "Width", 32))
    camera.disarm()
    apply(camera, ("remote", "Width", 64))


def test_a_rig_file_s_settings_are_typed_and_ordered() -> None:
    spec = spec_of(load_rig("rig-vt-4k5c-h100"), "a")
    assert spec.model == "VT-4K5C-H100"
    assert Setting("remote", "TDIStages", "TDI192") in spec.settings
    assert Setting("stream", "BufferHeight", 256) in spec.settings
    names = [setting.feature for setting in spec.settings]
    assert names.index("Width") < names.index("OffsetX")
    with pytest.raises(ConfigError, match=r"cameras\.a\.settings"):
        load_rig("rig-demo", {"cameras.a.settings": [["remotely", "Width", 3]]})
