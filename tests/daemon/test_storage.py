"""From the rig's configuration to what the store is told."""

from __future__ import annotations

import errno
import os

import pytest

from acquire.config import load_rig
from acquire.daemon.proof import Proof
from acquire.daemon.storage import choose_for, shot_noise, storage_settings
from acquire.errors import AcquireError, ConfigError, PlaceError, StoreError


def test_settings_follow_the_line_rate(tmp_path):
    rig = load_rig(
        "rig-demo",
        {
            "recording.chunk_lines": 4096,
            "recording.commit_s": 1.0,
            "recording.reserve_gb": 2,
            "recording.retention.max_gb": 50,
            "recording.retention.max_age_s": 3600,
            "recording.retention.segment_lines": 300,
        },
    )
    settings = storage_settings(rig)
    assert settings["commit_lines"] == 9 * 4096  # 33 333 lines, in whole chunks
    assert settings["reserve_bytes"] == 2 * 10**9
    kept = settings["retention"]
    assert (kept.max_bytes, kept.max_age_lines) == (50 * 10**9, pytest.approx(120_000_000))
    assert kept.margin_lines >= rig.geometry.stages // rig.geometry.substeps + 300
    assert kept.hold_events == ("mark",)
    assert storage_settings(load_rig("rig-demo"))["retention"] is None


@pytest.mark.parametrize("key", ["max_gb", "max_age_s", "segment_lines"])
def test_retention_of_nothing_is_refused(key):
    with pytest.raises(ConfigError, match=key):
        load_rig("rig-demo", {f"recording.retention.{key}": 0})


def test_a_codec_is_chosen_for_the_rig(tmp_path):
    rig = load_rig("rig-demo", {"recording.codec": "auto", "recording.directory": str(tmp_path)})
    sample = shot_noise(rig)
    assert (sample.dtype, sample.shape[1]) == ("uint16", rig.geometry.stages)
    choice = choose_for(rig)
    assert choice.codec in ("none", "lz4", "zstd")
    assert choice.needed_megabytes_per_s == pytest.approx(1.5 * 2 * 33333.3 * 64 * 2 / 1e6, rel=1e-3)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("number", "kind"), [(errno.ENOSPC, StoreError), (errno.EIO, StoreError), (errno.EACCES, PlaceError)]
)
def test_a_disk_that_cannot_be_measured_is_no_loss_of_data(tmp_path, monkeypatch, number, kind):
    """It was DataError, and the exit code said that lines were lost."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("acquire.store.files._nameless", refuse)
    rig = load_rig("rig-demo", {"recording.codec": "auto", "recording.directory": str(tmp_path)})
    with pytest.raises(AcquireError, match="cannot be measured") as refused:
        choose_for(rig)
    assert type(refused.value) is kind
    assert "another [recording] directory" in refused.value.hint
    assert "not measured" in str(Proof(rig)(force=False).warning)


@pytest.mark.parametrize(
    ("stages", "substep_ticks", "block_lines", "chunk_lines", "tag_chunks"),
    [
        (96, 300, 1024, 8192, 1),  # 100 kHz: a tenth of a second
        (4096, 300, 1024, 256, 16),  # 16 bit: 2 MiB; tags of 4096 lines
        (4096, 300, 200, 200, 20),  # a block of such a size is written as it lies in the ring
        (4096, 3000, 1024, 256, 3),  # 10 kHz: tags of a tenth of a second at most
        (54, 90_000, 256, 32, 1),  # 333 Hz
    ],
)
def test_chunks_suit_width_and_rate(stages, substep_ticks, block_lines, chunk_lines, tag_chunks):
    changes = {
        "geometry.stages": stages,
        "trigger.substep_ticks": substep_ticks,
        "stream.block_lines": block_lines,
    }
    rig = load_rig("rig-demo", changes)
    assert (rig.chunk_lines, rig.tag_chunks) == (chunk_lines, tag_chunks)
    assert storage_settings(rig)["commit_lines"] % (chunk_lines * tag_chunks) == 0
    assert load_rig("rig-demo", changes | {"recording.shard_chunks": 7}).tag_chunks in (1, 7)
    hurried = load_rig("rig-demo", changes | {"recording.commit_s": 0.002})
    assert hurried.tag_chunks * chunk_lines <= max(chunk_lines, 0.002 * rig.line_rate_hz)
    assert load_rig("rig-demo", changes | {"recording.chunk_lines": 48}).chunk_lines == 48
