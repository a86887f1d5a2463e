"""The composition root: a configuration becomes devices that belong together."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from acquire.config import builtin_directory, load_rig, load_scene
from acquire.config.base import FilePath
from acquire.daemon.plan import Run
from acquire.daemon.proof import Proof
from acquire.errors import ConfigError, UsageError
from acquire.geometry import Geometry
from acquire.plugins import Group
from acquire.rig import Rig, open_trigger
from acquire.sim import build_scene, truth
from acquire.sim.drivers import SimulatedTrigger
from acquire.sim.leds import LedSceneConfig
from acquire.simulate import simulate
from acquire.store import open_recording
from acquire.store.spec import root_attributes
from acquire.trigger.base import TriggerRun

OVERRIDES = {"geometry.stages": 8, "stream.block_lines": 16, "simulation.speed": 20.0}


def run_of(config):
    trigger = config.trigger
    return TriggerRun(
        "r", config.code.build(), config.geometry.substeps, trigger.substep_ticks, trigger.tag_every_lines
    )


def open_descriptors():
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


@pytest.fixture
def config():
    return load_rig("rig-demo.toml", OVERRIDES)


def test_trigger_and_cameras_of_a_rig_share_one_wire(config):
    with Rig(config) as rig:
        cameras = {arm: opener() for arm, opener in rig.openers().items()}
        for camera in cameras.values():
            camera.arm()
        rig.trigger.prepare(run_of(config))
        fit = rig.trigger.start()
        blocks = {arm: [camera.next_block(10.0) for _ in range(4)] for arm, camera in cameras.items()}
        pulses = rig.trigger.stop()
    assert fit.clock_hz == config.trigger.clock_hz
    assert pulses >= 64
    assert [block.first_line for block in blocks["a"]] == [0, 16, 32, 48]
    lines = {arm: np.concatenate([block.pixels for block in of_arm]) for arm, of_arm in blocks.items()}
    assert all(dn.shape == (64, 8) and dn.any() for dn in lines.values())
    assert not np.array_equal(lines["a"], lines["b"])


def test_both_arms_collect_the_light_of_the_same_scene(config):
    """The scene, summed over rows and columns, is the light of a line, and the same in both arms."""
    bright = config.model_copy(
        update={"code": config.code.model_validate({"kind": "prbs", "degree": 7, "seed": 3})}
    )
    geometry = Geometry(8, 3, 1)
    with Rig(bright) as rig:
        scene, code = rig.scene(), bright.code.build()
        cameras = [opener() for opener in rig.openers().values()]
        for camera in cameras:
            camera.arm()
        rig.trigger.prepare(run_of(bright))
        rig.trigger.start()
        blocks = [[camera.next_block(10.0).pixels for _ in range(4)] for camera in cameras]
    line = 40
    substeps = geometry.line_substeps(line)
    X = scene.frames(substeps.start, len(substeps)) * code.bits(substeps.start, len(substeps))[:, None, None]
    for dn, turns in zip(blocks, (0, 1), strict=True):
        seen = np.rot90(X, turns, axes=(1, 2))
        total = sum(seen[r + u, r].sum() for r in range(24) for u in range(3))
        measured = np.concatenate(dn)[line + geometry.depth_lines].sum() / 6.0
        assert measured == pytest.approx(total, abs=8 * 0.5 / 6)


def test_the_description_in_a_recording_rebuilds_the_scene(config):
    with Rig(config) as rig:
        described = json.loads(json.dumps(rig.describe()))
        scene = rig.scene()
    assert (described["simulated"], described["effects"]) == (True, [])
    again = build_scene(LedSceneConfig.model_validate(described["scene"]), 24, 1e-5)
    np.testing.assert_array_equal(truth(scene, 100, 40, 3, 4), truth(again, 100, 40, 3, 4))


def test_a_rig_of_real_cameras_is_not_called_simulated():
    with Rig(load_rig("rig-vt-4k5c-h100")) as rig:
        assert rig.describe() == {"simulated": False, "plugins": []}
        assert rig.layout == "dual"


HARDWARE = {"trigger.driver": "serial", "trigger.url": "/dev/ttyUSB0"}


def test_real_devices_need_no_scene_and_nothing_that_makes_one(tmp_path):
    """Checked in another process, since this one has imported the simulator."""
    code = (
        "import sys, acquire.cli, acquire.daemon.server\n"
        "from acquire.config import load_rig\n"
        "from acquire.rig import Rig\n"
        f"with Rig(load_rig('rig-vt-4k5c-h100', {HARDWARE})) as rig:\n"
        "    print(sorted(rig.openers()), rig.describe(), rig.layout)\n"
        "print([name for name in sys.modules if name.startswith('acquire.sim')])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True
    )
    facts, modules = done.stdout.splitlines()
    assert facts == "['a', 'b'] {'simulated': False, 'plugins': []} dual"
    scenes = {
        f"acquire.sim.{name}" for name in ("scenes", "scene", "pipeline", "lines", "effects", "instrument")
    }
    assert scenes.isdisjoint(ast.literal_eval(modules))


def test_a_scene_that_nothing_sees_is_not_looked_for(tmp_path):
    config = load_rig("rig-vt-4k5c-h100", {"simulation.scene": "nowhere.toml"} | HARDWARE)
    with Rig(config) as rig:
        assert rig.layout == "dual"
        with pytest.raises(UsageError, match="no simulated device"):
            rig.scene()


def without_scene(driver):
    text = (builtin_directory() / "rig-demo.toml").read_text()
    return text[: text.index("[simulation]")].replace(
        'driver = "simulated"\nserial', f'driver = "{driver}"\nserial'
    )


@pytest.mark.parametrize("driver", ["simulated", "gentl-simulated", "gige-simulated"])
def test_simulated_cameras_without_a_scene_are_refused_with_a_list_of_scenes(tmp_path, driver):
    (tmp_path / "rig.toml").write_text(without_scene(driver))
    with pytest.raises(
        ConfigError, match=r"simulation\.scene is missing.*scene-leds.*try: set simulation\.scene"
    ):
        load_rig(tmp_path / "rig.toml")


def test_stored_lines_are_shown_without_a_scene(tmp_path):
    (tmp_path / "rig.toml").write_text(without_scene("pattern"))
    with Rig(load_rig(tmp_path / "rig.toml", {"cameras.b.serial": "other"})) as rig:
        assert rig.describe() == {"simulated": True, "plugins": []}
        camera = rig.openers()["a"]()
        camera.arm()
        rig.trigger.prepare(run_of(rig.config))
        rig.trigger.start()
        assert camera.next_block(10.0).first_line == 0


def test_real_time_has_one_speed():
    config = load_rig("rig-vt-4k5c-h100", HARDWARE | {"simulation.speed": 2.0})
    with pytest.raises(
        ConfigError, match=r"simulation\.speed = 2 does not go with trigger\.driver = 'serial'"
    ):
        Rig(config)


def test_a_rig_without_its_scene_is_refused_before_anything_is_made(config, tmp_path):
    missing = config.simulation.model_copy(update={"scene": str(tmp_path / "none.toml")})
    before = open_descriptors()
    with pytest.raises(ConfigError, match=r"none\.toml"):
        Rig(config.model_copy(update={"simulation": missing}))
    assert open_descriptors() == before


def test_closing_stops_the_trigger_takes_the_wire_away_and_can_be_repeated(config):
    before = open_descriptors()
    rig = Rig(config)
    rig.trigger.prepare(run_of(config))
    rig.trigger.start()
    rig.close()
    rig.close()
    assert open_descriptors() == before


def test_a_trigger_can_be_opened_on_its_own(config):
    trigger = open_trigger(config)
    assert trigger.identify().clock_hz == 90_000_000
    trigger.prepare(run_of(config))
    trigger.start()
    assert trigger.stop() >= 1
    trigger.close()


def test_a_scene_that_is_saved_while_cameras_are_opened_is_that_of_the_next_run(config, tmp_path):
    """Both arms see one scene, that of the recording's description."""
    file = tmp_path / "scene.toml"
    file.write_text((builtin_directory() / "scene-leds.toml").read_text())
    simulation = config.simulation.model_copy(update={"scene": str(file)})
    with Rig(config.model_copy(update={"simulation": simulation})) as rig:

        def run():
            before = rig.simulated.sensor("a").optics.scene
            changed = file.with_suffix(".new")
            changed.write_text(file.read_text().replace("Scene #1", "Scene #2"))
            changed.rename(file)
            return before, rig.simulated.sensor("b").optics.scene

        a, b = run()
        assert a == b
        assert rig.describe()["scene"]["title"] == a.title == "Scene #1: four LEDs"
        a, b = run()
        assert a == b
        assert a.title == "Scene #2: four LEDs"


def test_a_scene_that_cannot_be_shown_is_refused_before_anything_is_made(config, tmp_path):
    (tmp_path / "scene.toml").write_text('kind = "video"\npath = "none.mp4"\n')
    missing = config.simulation.model_copy(update={"scene": str(tmp_path / "scene.toml")})
    before = open_descriptors()
    with pytest.raises(UsageError, match=r"none\.mp4"):
        Rig(config.model_copy(update={"simulation": missing}))
    assert open_descriptors() == before


def test_a_scene_that_the_light_cannot_serve_is_refused_before_a_camera_is_opened():
    """It would otherwise be refused in a camera's process, at the first line."""
    scene = {"simulation.scene": "scene-leds-measured", "trigger.light.close_ticks": 450}
    with pytest.raises(UsageError, match="light that is on for only part of each sub-step"):
        Rig(load_rig("rig-demo.toml", OVERRIDES | scene))


def test_devices_deliver_what_simulate_writes_effects_layout_losses_and_all(config, tmp_path):
    scene = load_scene("scene-leds-measured").model_dump(mode="json")
    scene["effects"].append({"kind": "dropped_lines", "rate": 0.03})
    scene["optics"]["layout"] = "compact"
    whole = LedSceneConfig.model_validate(scene)
    simulate(config, whole, tmp_path / "r.zarr", 200)
    stored = open_recording(tmp_path / "r.zarr")
    with Rig(config) as rig:
        rig.simulated._scene = whole
        cameras = {arm: opener() for arm, opener in rig.openers().items()}
        for camera in cameras.values():
            camera.arm()
        rig.trigger.prepare(run_of(config))
        rig.trigger.start()
        for arm, camera in cameras.items():
            lines, flags = (stored.camera(arm).read(name, 0, 200) for name in ("lines", "flags"))
            seen, number = [], 0
            while number < 200:
                if (block := camera.next_block(10.0)) is None:
                    continue
                for i, pixels in enumerate(block.pixels):
                    number = block.first_line + i - 9
                    if 0 <= number < 200:
                        np.testing.assert_array_equal(pixels, lines[number])
                        seen.append(number)
            np.testing.assert_array_equal(seen, np.flatnonzero((flags & 1) == 0))
            assert len(seen) < 200
            assert camera.statistics()["lost"] >= 200 - len(seen)
    assert rig.layout == "compact"


def test_on_the_gateware_each_camera_follows_its_own_trigger_pin(config):
    """Nothing is started until the trigger is used."""
    before = open_descriptors()
    rtl = config.model_copy(update={"trigger": config.trigger.model_copy(update={"driver": "rtl"})})
    with Rig(rtl) as rig:
        wires = [opener.wire for opener in rig.openers().values()]
        assert [wire.arm for wire in wires] == ["a", "b"]
        assert all(wire.read().train is None for wire in wires)
    assert open_descriptors() == before


def test_beside_a_real_trigger_only_the_simulated_camera_is_named():
    """Both cameras' drivers were called simulated."""
    mixed = {"cameras.a.driver": "harvesters", "trigger.driver": "serial", "trigger.url": "/dev/ttyUSB0"}
    config = load_rig("rig-demo", mixed)
    with pytest.raises(ConfigError, match=r"simulated cameras \(b: simulated\) cannot be triggered by"):
        Rig(config)


def test_a_path_among_the_options_of_a_plug_in_reaches_the_recording_as_text(tmp_path, monkeypatch):
    """A recording's attributes are JSON."""

    class Charted(SimulatedTrigger):
        chart: FilePath

    load = Group.load
    monkeypatch.setattr(
        Group, "load", lambda group, name: Charted if name == "charted" else load(group, name)
    )
    named = {"trigger.driver": "charted", "trigger.options": {"chart": "levels.csv"}}
    config = load_rig("rig-demo", named | {"recording.directory": str(tmp_path), "recording.codec": "none"})
    assert config.trigger.options == Charted(chart="levels.csv")
    with Rig(config) as rig:
        run = Run(config, rig, Proof(config).choose)
        try:
            run.arm()
            attributes = json.loads(json.dumps(root_attributes(run.spec())))
        finally:
            run.capture.close()
    for settings in (attributes["trigger"]["settings"], attributes["config"]["trigger"]):
        assert settings["options"] == {"chart": "levels.csv"}
