"""``acquire reconstruct | render | paper | tradeoff`` as a user types them."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from small_files import noise_video, run_with_small_files

from acquire.cli.reconstruct_request import Arguments, requested_lines
from acquire.config import load_rig
from acquire.config.scene import ConstantDrive, SineDrive
from acquire.reconstruct import Options
from acquire.sim.leds import LedConfig, LedSceneConfig
from acquire.simulate import simulate
from acquire.store import open_recording, open_video

Cli = Callable[..., Any]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rig = load_rig("rig-demo", {"geometry.stages": 12, "geometry.substeps": 2})
    drive = SineDrive(waveform="sine", frequency_hz=500.0, low=0.1)
    led = LedConfig(name="x", shape="square", row=0.5, column=0.5, size=0.5, drive=drive)
    path = tmp_path_factory.mktemp("r") / "run.zarr"
    simulate(rig, LedSceneConfig(kind="leds", title="one LED", leds=(led,)), path, 300)
    return path


def test_lines_and_times(cli: Cli, recording: Path, tmp_path: Path) -> None:
    answer = cli(
        "reconstruct",
        recording,
        "--out",
        tmp_path / "a.zarr",
        "--first-line",
        20,
        "--lines",
        100,
        "--nm",
        2,
        "--iterations",
        8,
        "--json",
    )
    assert answer.code == 0, answer.err
    assert (answer.json["first_line"], answer.json["lines"]) == (20, 100)
    assert answer.json["shape"] == [177, 12, 12]
    times = ("--from", "1ms", "--to", "2ms", "--nm", 2, "--iterations", 8)
    answer = cli("reconstruct", recording, "--out", tmp_path / "b.zarr", *times)
    assert answer.code == 0, answer.err
    video = open_video(tmp_path / "b.zarr")
    assert video.video.shape == (100, 12, 12)
    start = open_video(tmp_path / "a.zarr").time_ns[0] - 20 * 20_000
    assert video.time_ns[0] - start == 1_000_000


@pytest.mark.parametrize(
    ("first", "count", "begin", "end", "selected"),
    [
        (None, None, None, None, (None, None)),
        (20, None, None, None, (20, None)),
        (None, 50, "L30", None, (30, 50)),
        (None, None, "2ms", None, (100, None)),
        (None, None, "2ms", "3ms", (100, 62)),  # 50 lines, and those of 12 stages that also see the range
    ],
)
def test_lines_that_show_a_range(
    recording: Path, first: Any, count: Any, begin: Any, end: Any, selected: Any
) -> None:
    arguments = Arguments(
        first_line=first,
        lines=count,
        begin=begin,
        end=end,
        voxels=("2x1",),
        plan=None,
        segments=(),
        auto=False,
        save_plan=None,
        ends=None,
        preview=False,
        preset=None,
        options=Options("balanced"),
    )
    assert requested_lines(open_recording(recording), arguments) == selected


def test_several_voxels_side_by_side(cli: Cli, recording: Path, tmp_path: Path) -> None:
    words = ("--lines", 120, "--voxels", "1x66", "--voxels", "2x3", "--iterations", 8)
    assert cli("reconstruct", recording, "--out", tmp_path / "v.zarr", *words).code == 0
    slow, fast = tmp_path / "v-1x66.zarr", tmp_path / "v-2x3.zarr"
    assert open_video(slow).video.shape[1:] == (24, 24)
    assert open_video(fast).video.shape[1:] == (12, 12)
    answer = cli("render", slow, fast, "--out", tmp_path / "both.png", "--frames", 3)
    assert answer.code == 0, answer.err
    with Image.open(tmp_path / "both.png") as sheet:
        assert sheet.width > 6 * 190
    refused = cli("render", slow, "--out", tmp_path / "flat.png", "--height", 0)
    assert (refused.code, "--height 0 is out of range" in refused.err) == (2, True)
    answer = cli("render", slow, fast, "--out", tmp_path / "both.html", "--json")
    assert answer.code == 0, answer.err
    page = (tmp_path / "both.html").read_text(encoding="utf-8")
    assert answer.json["bytes"] == len(page.encode()) < 700_000
    facts = open_video(fast).attrs["provenance"]
    part = facts["segments"][0]
    assert part["processor_s"] > 0
    assert f"<td>{part['seconds']:.1f}</td><td>{part['processor_s']:.1f}</td>" in page
    assert f"{facts['lines']} lines starting with {facts['first_line']}" in page


def test_a_plan_on_the_command_line(cli: Cli, recording: Path, tmp_path: Path) -> None:
    words = (
        "--segment",
        "40:2x2",
        "--segment",
        "1ms:1x30",
        "--segment",
        ":2x2",
        "--workers",
        1,
        "--iterations",
        8,
        "--json",
    )
    answer = cli("reconstruct", recording, "--out", tmp_path / "v.zarr", "--lines", 200, *words)
    assert answer.code == 0, answer.err
    lengths = [part["end_substep"] - part["begin_substep"] for part in answer.json["segments"]]
    assert lengths[:2] == [80, 100]
    assert open_video(tmp_path / "v.zarr").attrs["provenance"]["segments"][1]["spatial_merge"] == 1


def test_the_ends_of_a_plan_file_are_overridden(cli: Cli, recording: Path, tmp_path: Path) -> None:
    (tmp_path / "plan.toml").write_text("[[segments]]\nspatial_merge = 2\ntemporal_merge = 8\n")
    words = ("--plan", tmp_path / "plan.toml", "--lines", 60, "--iterations", 2, "--json")
    shapes = [
        cli("reconstruct", recording, "--out", tmp_path / f"{ends}.zarr", "--ends", ends, *words).json[
            "shape"
        ]
        for ends in ("trusted", "whole")
    ]
    assert shapes[0][0] < shapes[1][0]


def test_a_proposed_plan_is_written_and_read_again(cli: Cli, recording: Path, tmp_path: Path) -> None:
    plan, words = tmp_path / "plan.toml", ("reconstruct", recording, "--lines", 60)
    answer = cli(*words, "--auto", "--save-plan", plan)
    assert answer.code == 0, answer.err
    assert "unseen samples are predicted" in answer.out
    again = cli(*words, "--plan", plan, "--iterations", 5, "--out", tmp_path / "v.zarr")
    assert again.code == 0, again.err


def test_a_proposed_plan_for_programs(cli: Cli, recording: Path) -> None:
    answer = cli("reconstruct", recording, "--auto", "--lines", 60, "--json")
    assert answer.code == 0, answer.err
    assert answer.json["plan"]["segments"][0]["temporal_merge"] >= 1


def test_nothing_slow_is_done_for_a_file_that_exists(cli: Cli, recording: Path, tmp_path: Path) -> None:
    """Neither the plan nor the video is overwritten, and no plan is left behind by a refused command."""
    taken, plan = tmp_path / "taken.zarr", tmp_path / "plan.toml"
    taken.touch()
    words = ("reconstruct", recording, "--lines", 150, "--segment", ":2x2")
    answer = cli(*words, "--save-plan", plan, "--out", taken)
    assert (answer.code, plan.exists()) == (2, False)
    assert "taken.zarr exists already" in answer.err
    answer = cli("reconstruct", recording, "--auto", "--save-plan", taken)
    assert answer.code == 2
    assert "looking for changes" not in answer.err


@pytest.mark.parametrize("plan", ["/proc/plan.toml", f"{'n' * 240}.toml"])
def test_nothing_slow_is_done_for_a_plan_that_cannot_be_written(
    cli: Cli, recording: Path, tmp_path: Path, plan: str
) -> None:
    """Permissions allow both; the work of minutes was lost, because only writing the plan failed."""
    answer = cli("reconstruct", recording, "--auto", "--save-plan", tmp_path / plan)
    assert (answer.code, "cannot be written" in answer.err) == (2, True)
    assert "looking for changes" not in answer.err
    assert not list(tmp_path.iterdir())


def test_plan_and_video_need_two_names(cli: Cli, recording: Path, tmp_path: Path) -> None:
    both = tmp_path / "both"
    words = ("--segment", ":2x2", "--save-plan", both, "--out", f"{tmp_path}/./both")
    answer = cli("reconstruct", recording, *words)
    assert answer.code == 2
    assert "a plan is a file and a video a directory" in answer.err
    assert not both.exists()


@pytest.mark.parametrize("name", ["v.mp4", "v.ome.tif", "v.NPZ"])
def test_the_name_of_a_file_is_refused(cli: Cli, recording: Path, tmp_path: Path, name: str) -> None:
    """It became a directory of this name, which no program would open."""
    answer = cli("reconstruct", recording, "--out", tmp_path / name)
    assert answer.code == 2
    assert "acquire export or acquire render" in answer.err
    assert not list(tmp_path.iterdir())


def test_a_range_that_ends_before_it_begins_is_named_as_such(
    cli: Cli, recording: Path, tmp_path: Path
) -> None:
    answer = cli("reconstruct", recording, "--out", tmp_path / "v.zarr", "--from", "500us", "--to", "200us")
    assert answer.code == 2
    assert "a range from 500us to 200us is empty" in answer.err


def test_the_same_voxels_twice_are_one_video(cli: Cli, recording: Path, tmp_path: Path) -> None:
    words = ("--lines", 60, "--voxels", "2x3", "--voxels", "2x3", "--iterations", 2)
    assert cli("reconstruct", recording, "--out", tmp_path / "v.zarr", *words).code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["v.zarr"]


def test_a_preview_is_coarse(cli: Cli, recording: Path, tmp_path: Path) -> None:
    answer = cli("reconstruct", recording, "--out", tmp_path / "v.zarr", "--preview", "--json")
    assert answer.code == 0, answer.err
    assert answer.json["shape"][1:] == [6, 6]


def test_a_preview_shows_all_of_a_long_recording(cli: Cli, tmp_path: Path) -> None:
    rig = load_rig("rig-demo", {"geometry.stages": 12, "geometry.substeps": 2})
    led = LedConfig(
        name="x", shape="square", row=0.5, column=0.5, size=0.5, drive=ConstantDrive(waveform="constant")
    )
    simulate(rig, LedSceneConfig(kind="leds", title="one LED", leds=(led,)), tmp_path / "long.zarr", 3000)
    answer = cli("reconstruct", tmp_path / "long.zarr", "--out", tmp_path / "v.zarr", "--preview", "--json")
    assert answer.code == 0, answer.err
    facts = answer.json
    assert facts["shape"] == [12, 6, 6]
    assert 12 * facts["temporal_merge"] > 0.95 * 2 * 3000
    assert sum(part["lines"] for part in facts["segments"]) < 600


def test_a_video_is_written_to_a_url_and_rendered_from_it(cli: Cli, recording: Path, tmp_path: Path) -> None:
    url = f"file://{tmp_path}/far/v.zarr"
    words = ("reconstruct", recording, "--out", url, "--lines", 60, "--iterations", 2)
    answer = cli(*words, "--voxels", "2x3", "--voxels", "1x66", "--json")
    assert answer.code == 0, answer.err
    places = [facts["path"] for facts in answer.json]
    assert places == [f"file://{tmp_path}/far/v-2x3.zarr", f"file://{tmp_path}/far/v-1x66.zarr"]
    assert open_video(places[0]).video.shape[1:] == (12, 12)
    again = cli(*words, "--voxels", "2x3", "--voxels", "1x66")
    assert again.code == 2
    assert "exists already" in again.err
    answer = cli("render", *places, "--out", tmp_path / "both.png", "--frames", 2)
    assert answer.code == 0, answer.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--lines", 10_000), "possible: lines 0 to 299"),
        (("--first-line", 10_000), "does not have line 10000"),
        (("--from", "soon"), "500ms"),
        (("--from", "1ms", "--to", "1s"), "1ms to 1s (sub-steps"),
        (("--voxels", "3"), "NMxTM"),
        (("--lines", 50, "--to", "1ms"), "--from and --to"),
        (("--segment", ":2x2", "--segment", "5:2x2"), "only the last segment"),
        (("--segment", "0:6x20"), "--segment: 1 error\n  segments.0.lines = 0"),
        (("--plan", "nothing.toml"), "does not exist"),
        (("--ends", "half"), "trusted, whole"),
        (("--lines", 5), "more than 12 lines"),
        (("--preset", "perfect"), "balanced"),
        (("--save-plan", "plan.toml"), "with --auto, --plan or --segment"),
        (("--workers", 0), "1 or more"),
        (("--dtype", "float16"), "float32, float64"),
        (("--device", "tpu"), "cpu, gpu"),
        (("--segment", ":2x2", "--voxels", "1x4"), "--voxels, --nm and --tm have no effect with --segment"),
        (("--auto", "--nm", 3), "have no effect with --auto"),
        (("--preview", "--tm", 1), "have no effect with --preview"),
        (("--preview", "--iterations", 5), "--preset and --iterations have no effect with --preview"),
        (("--voxels", "1x4", "--nm", 3), "--voxels and --nm or --tm exclude each other"),
        (("--dask", "tcp://127.0.0.1:9", "--workers", 2), "--workers has no effect with --dask"),
    ],
)
def test_impossible_requests_are_refused(
    cli: Cli, recording: Path, tmp_path: Path, words: Any, said: str
) -> None:
    answer = cli("reconstruct", recording, "--out", tmp_path / "v.zarr", *words)
    assert answer.code == 2
    assert said in answer.err.lower() or said in answer.err
    assert list(tmp_path.iterdir()) == []


def test_too_few_iterations_are_refused_before_anything_is_opened(cli: Cli, tmp_path: Path) -> None:
    """They were refused by the processes that solve, whose start takes seconds."""
    answer = cli("reconstruct", tmp_path / "none.zarr", "--out", tmp_path / "v.zarr", "--iterations", 0)
    assert "0 iterations are not possible" in answer.err


def test_a_budget_uses_the_learned_presets(
    cli: Cli, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    words = ("--voxels", "2x1", "--solver", "admm", "--lines", 60, "--repeats", 1, "--budget", 2, "--json")
    answer = cli("tradeoff", recording, "--out", tmp_path / "t", *words)
    assert answer.code == 0, answer.err
    assert {row["preset"] for row in answer.json["rows"]} == {"fast", "balanced"}
    assert (tmp_path / "t" / "index.html").exists()
    lessons = json.loads((tmp_path / "cache" / "acquire" / "tradeoff.json").read_text())["learned"]
    reconstructing = ("reconstruct", recording, "--nm", 2, "--lines", 60, "--budget", 3)
    answer = cli(*reconstructing, "--out", tmp_path / "one.zarr")
    assert "preset balanced: presets were tried on 1 scene (" in answer.err
    for lesson in lessons:
        lesson["seconds"] = 1.0 if lesson["preset"] == "fast" else 5000.0
    of_three = [lesson | {"scene": scene} for lesson in lessons for scene in ("a", "b", "c")]
    document = {"version": 2, "learned": of_three}
    (tmp_path / "cache" / "acquire" / "tradeoff.json").write_text(json.dumps(document))
    answer = cli(*reconstructing, "--out", tmp_path / "v.zarr", "--dtype", "float64", "--json")
    assert (answer.json["preset"], answer.json["dtype"]) == ("fast", "float64")
    assert answer.json["segments"][0]["parameters"]["dtype"] == "float64"


def test_a_cache_that_cannot_be_written_costs_no_page(
    cli: Cli, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cache").write_text("a file")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    words = ("--voxels", "2x1", "--solver", "admm", "--lines", 60, "--repeats", 1, "--budget", 2, "--json")
    answer = cli("tradeoff", recording, "--out", tmp_path / "t", *words)
    assert answer.code == 0, answer.err
    assert "not kept for --budget" in answer.err
    assert answer.json["learned"] is None
    assert (tmp_path / "t" / "index.html").exists()


def test_fig_9_from_scene_to_page(cli: Cli, tmp_path: Path) -> None:
    answer = cli("paper", "fig9", "--out", tmp_path / "p", "--budget", 2, "--json")
    assert answer.code == 0, answer.err
    (figure,) = answer.json["figures"]
    rows = {row["what"]: row["ours"] for row in figure["rows"]}
    assert rows["video"] == "64 × 64 × 598, 51.99 to 57.96 ms"
    assert figure["numbers"]["psnr_db"] > 12
    page = (tmp_path / "p" / "index.html").read_text()
    assert page.count("<picture>") == 3
    assert page.count("data:image/svg+xml") == 2 * 3  # for wide pages and for narrow ones
    assert figure["rows"][0]["verdict"] == "equal"
    assert 1 <= figure["host"]["least_share_percent"] <= figure["host"]["share_percent"] <= 100
    assert "data:image/webp" in page
    assert json.loads((tmp_path / "p" / "summary.json").read_text())["figures"][0]["rows"] == figure["rows"]


def test_an_unknown_figure_is_refused(cli: Cli, tmp_path: Path) -> None:
    answer = cli("paper", "fig12", "--out", tmp_path / "p")
    assert answer.code == 2
    assert "fig6, fig7, fig8, fig9, fig10, fig11" in answer.err
    assert not (tmp_path / "p").exists()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[str]:
    """A scheduler and two workers, processes of their own; its address."""
    file = tmp_path / "scheduler.json"
    common = ["--scheduler-file", str(file), "--no-dashboard"]
    commands = [["scheduler", "--host", "127.0.0.1", "--port", "0", *common]]
    commands += [
        ["worker", "--death-timeout", "30", "--nthreads", "1", "--no-nanny", "--host", "127.0.0.1", *common]
    ] * 2
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "dask", *command],
            cwd=tmp_path,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for command in commands
    ]
    try:
        deadline = time.monotonic() + 300
        while not file.exists() or not file.stat().st_size:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        yield json.loads(file.read_text())["address"]
    finally:
        for process in reversed(processes):  # workers first: they would look for their scheduler for long
            process.terminate()
            try:
                process.wait(timeout=300)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@pytest.mark.needs_dask
@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "foo"])
def test_an_unreachable_cluster(recording: Path, tmp_path: Path, address: str) -> None:
    words = ["reconstruct", str(recording), "--out", str(tmp_path / "v.zarr"), "--dask", address]
    ended = subprocess.run(
        [sys.executable, "-m", "acquire", *words], capture_output=True, text=True, timeout=300, check=False
    )
    assert ended.returncode == 2
    assert f"no Dask scheduler answers on {address}" in ended.stderr
    assert ended.stderr.splitlines()[-1].startswith("  possible:"), ended.stderr


@pytest.mark.needs_dask
def test_a_cluster_gives_the_same_result_as_this_machine(
    cluster: str, recording: Path, tmp_path: Path
) -> None:
    common = [
        sys.executable,
        "-m",
        "acquire",
        "reconstruct",
        str(recording),
        "--iterations",
        "8",
    ]
    words = ["--segment", "100:2x1", "--segment", ":2x1"]
    for name, where in (("here", ["--workers", "1"]), ("there", ["--dask", cluster])):
        ended = subprocess.run(
            [*common, *words, *where, "--out", str(tmp_path / f"{name}.zarr")],
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert ended.returncode == 0, ended.stderr
    here, there = (open_video(tmp_path / f"{name}.zarr").video[:] for name in ("here", "there"))
    np.testing.assert_allclose(here, there, atol=1e-2)  # sums in another order


@pytest.mark.parametrize("suffix", [".png", ".gif", ".webp", ".mp4", ".html"])
def test_a_disk_that_takes_no_more_ends_a_rendering_in_words(tmp_path: Path, suffix: str) -> None:
    video, out = noise_video(tmp_path / "v.zarr"), tmp_path / f"v{suffix}"
    done = run_with_small_files(3000, "render", video, "--out", out)
    assert (done.returncode, f"{out} cannot be written: " in done.stderr) == (5, True), done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["v.zarr"]
