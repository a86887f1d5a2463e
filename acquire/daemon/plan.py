"""From the rig's configuration to one run: the capture's plan, and the recording's specification."""

from __future__ import annotations

import os
import secrets
from dataclasses import asdict
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from acquire.calibrate.choose import carried_calibration
from acquire.camera.checked import CheckedOpener
from acquire.config import ConstantCodeConfig
from acquire.daemon.devices import KnownDevices
from acquire.daemon.events import budget_lines, window_of
from acquire.daemon.messages import CalibrationStatus
from acquire.daemon.storage import choose_for, storage_settings
from acquire.daemon.watching import watch_plan
from acquire.store import RecordingSpec, next_segment
from acquire.store.codecs import configured_codec
from acquire.stream import END_S, Begin, Capture, CapturePlan
from acquire.trigger.base import Delays, LightWindow, TriggerRun
from acquire.trigger.settings import with_delays, with_window

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from acquire.config import RigConfig
    from acquire.config.recording import RecordingConfig
    from acquire.daemon.messages import ArmRequest, StartRequest
    from acquire.daemon.options import LightCode
    from acquire.rig import Rig
    from acquire.store import CodecChoice


class Run:
    """One run of a rig: armed once, any number of recordings, closed once."""

    def __init__(
        self,
        config: RigConfig,
        rig: Rig,
        choose: Callable[[RigConfig], CodecChoice] = choose_for,
        devices: KnownDevices | None = None,
        light: LightCode = "rig",
    ) -> None:
        """Prepare a run without touching a device; ``choose`` finds the codec if that is ``auto``.

        ``devices`` remembers those that were armed, and ``light`` is what the code in ``config`` was made of.

        Raises UsageError for a configuration, or calibration, that cannot work.
        """
        self.run_id, self.light = new_run_id(config.name), light
        self._config = config
        self._rig = rig
        self._choose = choose
        self._devices = devices or KnownDevices()
        self._choice: CodecChoice | None = None
        self._calibration = carried_calibration(config, rig.layout)
        self.capture = Capture(capture_plan(config, rig, self.run_id), rig.trigger)

    @property
    def calibration(self) -> CalibrationStatus | None:
        """The calibration in recordings; None if the rig names none."""
        handed = self._calibration
        if handed.text is None:
            return None
        return CalibrationStatus(path=handed.place, carried="calibration" in handed.attrs, text=handed.text)

    def arm(self, progress: Callable[[str], object] = lambda _: None) -> None:
        """Start cameras and trigger; on failure everything is undone and the first error raised.

        ``progress`` is called with each awaited step.
        """
        if self._config.recording.codec == "auto":
            self._choice = self._choose(self._config)
        self.capture.arm(self._config.stream.arm_timeout_s, progress)
        self._devices.note(self._rig.trigger, self.capture.cameras)

    def adopt(self, recording: RecordingConfig) -> None:
        """Use the settings ``recording`` for the next recording."""
        self._config = self._config.model_copy(update={"recording": recording})

    def spec(self) -> RecordingSpec:
        """Return the recording's specification; the recorder fills in its first line."""
        config = self._config
        # Chosen by `arm`. Before that there is none, and nothing that it could pack.
        codec = configured_codec(config, auto=self._choice.codec if self._choice else "none")
        return RecordingSpec(
            run_id=self.run_id,
            stages=config.geometry.stages,
            substeps=config.geometry.substeps,
            pixels=config.pixels,
            dtype=config.cameras.a.dtype,
            first_line=0,
            clock=self.capture.clock,
            code=config.code.build().to_attrs(),
            substep_ticks=config.trigger.substep_ticks,
            trigger={
                **asdict(self._rig.trigger.identify()),
                "settings": config.trigger.model_dump(mode="json"),
            },
            cameras={arm: self._camera(arm, facts) for arm, facts in self.capture.cameras.items()},
            config=config.model_dump(mode="json"),
            extra=self._rig.describe()
            | self._calibration.attrs
            | ({"codec_choice": self._choice.to_attrs()} if self._choice else {}),
            codec=codec,
            layout=self._rig.layout,
            fibre=config.laid_out,
            **storage_settings(config),
        )

    def _camera(self, arm: str, facts: dict[str, Any]) -> dict[str, Any]:
        camera = self._config.cameras.arm(arm)
        calibration = {
            "white_dn": camera.white_dn,
            "black_level_dn": camera.black_level_dn,
            "responsivity_dn": camera.responsivity_dn,
            **camera.noise_facts,
        }
        lines = self.capture.poll().lines.get(arm, {})
        return {**calibration, **facts, "clock": lines.get("clock", {})}


def recording_of(request: StartRequest, config: RigConfig, spec: RecordingSpec) -> Begin:
    """Return the request for the recorder; to resume the recording at a path, that of a segment next to it.

    Raises UsageError if it is impossible, before anything is changed.
    """
    path = request.path or default_path(config)
    if request.resume:
        path, spec = next_segment(path, spec)
    rate_hz = config.line_rate_hz
    return Begin(path, spec, budget_lines(request, rate_hz), window_of(request, rate_hz))


def armed_as(config: RigConfig, request: ArmRequest) -> RigConfig:
    """Return the rig with the options of the request."""
    config = with_code(config, request.code)
    if request.calibration == "none":
        config = config.model_copy(update={"calibration": None})
    trigger = config.trigger
    if (delays := request.delays) is not None:
        trigger = with_delays(trigger, Delays(delays.light_lead, delays.a, delays.b))
    if (window := request.window) is not None:
        trigger = with_window(trigger, LightWindow(window.open, window.close))
    return config.model_copy(update={"trigger": trigger})


def with_code(config: RigConfig, code: LightCode) -> RigConfig:
    """Return the rig with another code for its light."""
    if code == "rig":
        return config
    constant = ConstantCodeConfig(kind="constant", value=0 if code == "dark" else 1)
    return config.model_copy(update={"code": constant})


def worker_modules(rig: Rig) -> tuple[str, ...]:
    """Return the modules that a run's processes import, to be imported once before any run is armed."""
    openers = [each.opener if isinstance(each, CheckedOpener) else each for each in rig.openers().values()]
    modules = {type(opener).__module__ for opener in openers}
    modules |= {f"acquire.stream.{name}" for name in ("recorder", "grabber", "watcher")}
    if rig.config.simulates_cameras:
        modules.add("acquire.sim.pipeline")  # imported by simulated cameras when they are opened
    if (codec := rig.config.recording.codec_options) is not None:
        modules.add(type(codec).__module__)
    return tuple(sorted(modules))


def capture_plan(config: RigConfig, rig: Rig, run_id: str) -> CapturePlan:
    """Return the capture's plan. Raises UsageError for settings that cannot work."""
    return CapturePlan(
        run=trigger_run(config, run_id),
        stages=config.geometry.stages,
        pixels=config.pixels,
        dtype=config.cameras.a.dtype,
        block_lines=config.stream.block_lines,
        ring_slots=config.ring_slots,
        ring_reserve=config.ring_reserve,
        watch=watch_plan(config),
        white_dn=config.cameras.a.white_dn,
        openers=rig.openers(),
        stall_timeout_s=config.stall_timeout_s,
        reopen_timeout_s=config.stream.reopen_s,
        columns=config.columns,
        realtime=config.stream.realtime,
        line_period_ns=1e9 / config.passing_hz,
        patience_s=config.recording.patience_s,
        continues=config.recording.on_disk_trouble == "continue",
        # A recorder that makes no progress is not waited for longer than the rig allows, nor than any other
        # process.
        seal_timeout_s=min(config.recording.seal_timeout_s, END_S),
    )


def trigger_run(config: RigConfig, run_id: str) -> TriggerRun:
    """Return the trigger's settings for a run."""
    return TriggerRun(
        run_id=run_id,
        code=config.code.build(),
        substeps=config.geometry.substeps,
        substep_ticks=config.trigger.substep_ticks,
        tag_every_lines=config.trigger.tag_every_lines,
        delays=Delays.of(config.trigger),
        window=LightWindow.of(config.trigger),
    )


def new_run_id(name: str) -> str:
    """Return a unique name for a run: rig, UTC, and a random part for runs within one second."""
    return f"{name}-{_stamp()}-{secrets.token_hex(3)}"


def default_path(config: RigConfig) -> Path:
    """Return a free path in the configured directory, named after rig and UTC."""
    directory = config.recording.directory.absolute()
    path = directory / f"{config.name}-{_stamp()}.zarr"
    number = 2
    # A link that leads nowhere has the name, too.
    while os.path.lexists(path):
        path = directory / f"{config.name}-{_stamp()}-{number}.zarr"
        number += 1
    return path


def _stamp() -> str:
    return datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
