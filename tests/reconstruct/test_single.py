"""A reconstruction in memory is written with the same origin as a stitched video."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from acquire.recon import reconstruct
from acquire.recon.denoisers import HaarShrink
from acquire.recon.segments import Voxels
from acquire.reconstruct import Monitor, Options, by_lines, combine, in_voxels, open_pool, save_reconstruction
from acquire.store import open_recording, open_video

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.arrays import Dtype
    from acquire.recon.denoisers import Denoiser

LINES, MERGES = 40, (3, 4)


@pytest.mark.parametrize(
    ("denoiser", "name"),
    [("haar", "haar"), (HaarShrink(2), "HaarShrink"), (None, None)],
    ids=["by name", "object", "none"],
)
def test_the_denoiser_is_recorded_with_the_solver(
    recording_path: Path, tmp_path: Path, denoiser: Denoiser | str | None, name: str | None
) -> None:
    recording = open_recording(recording_path)
    segment = recording.cut(0, LINES)
    result = reconstruct(segment, *MERGES, iterations=3, denoiser=denoiser, check=False, error=False)
    save_reconstruction(tmp_path / "v.zarr", result, recording, segment, MERGES[0])
    provenance = open_video(tmp_path / "v.zarr").attrs["provenance"]
    assert (provenance["solver"], provenance["denoiser"]) == ("admm", name)


def test_no_frame_is_trusted_if_the_lines_contradict_their_description(
    recording_path: Path, tmp_path: Path
) -> None:
    """The geometry alone was asked, as if nothing had been found; stitched videos had none."""
    recording = open_recording(recording_path)
    segment = recording.cut(0, LINES)
    result = reconstruct(segment, *MERGES, iterations=3, check=False, error=False)
    for believed, frames in ((True, len(result.video[result.trusted])), (False, 0)):
        path = tmp_path / f"{believed}.zarr"
        save_reconstruction(path, replace(result, believed=believed), recording, segment, MERGES[0])
        trusted = open_video(path).trusted
        assert trusted is not None
        assert len(trusted) == frames


@pytest.mark.parametrize(
    ("ended", "misfit", "trusted", "words"),
    [
        ("stopped", 0.01, False, "and leaves a misfit of 1%"),
        ("budget", 0.5, False, "and leaves a misfit of 50%"),
        ("budget", 0.05, True, ""),
        ("done", 0.5, True, ""),
    ],
)
def test_no_frame_is_trusted_of_a_run_that_was_stopped_or_is_too_short(
    recording_path: Path, tmp_path: Path, ended: str, misfit: float, trusted: bool, words: str
) -> None:
    """A video saved from Python claimed frames as trusted that the command's video did not."""
    recording = open_recording(recording_path)
    segment = recording.cut(0, LINES)
    result = reconstruct(segment, *MERGES, iterations=3, check=False, error=False)
    quality = replace(result.quality, misfit=misfit, prediction=float("nan"))
    cut = replace(result, ended=ended, quality=quality)
    save_reconstruction(tmp_path / "v.zarr", cut, recording, segment, MERGES[0])
    video = open_video(tmp_path / "v.zarr")
    assert video.trusted is not None
    assert bool(video.trusted) is trusted
    provenance = video.attrs["provenance"]
    assert provenance["ended"] == ended
    assert provenance["state"] == ("interrupted" if ended == "stopped" else "complete")
    assert words in " ".join(provenance["warnings"])
    assert (f"the video of lines 0 to {LINES - 1} was" in " ".join(provenance["warnings"])) is not trusted


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_every_frame_has_its_residual_and_its_error_beside_it(
    recording_path: Path, tmp_path: Path, dtype: Dtype
) -> None:
    """Only videos of the command had them, and a result in float64 was refused."""
    recording = open_recording(recording_path)
    segment = recording.cut(0, 100)
    result = reconstruct(segment, *MERGES, iterations=20, check=False)
    result = replace(result, video=result.video.astype(dtype))
    assert not isinstance(result.error, str), result.error
    save_reconstruction(tmp_path / "v.zarr", result, recording, segment, MERGES[0])
    video = open_video(tmp_path / "v.zarr")
    assert video.quality is not None
    np.testing.assert_array_equal(video.quality, result.frame_error)
    np.testing.assert_array_equal(video.errors(0, len(result.video)), result.error.regions)
    np.testing.assert_array_equal(video.frames(0, len(result.video)), result.video.astype(np.float32))
    assert video.attrs["provenance"]["error"]["rms"] == pytest.approx(result.error.rms)


def test_an_unknown_error_is_nan_as_in_stitched_videos(recording_path: Path, tmp_path: Path) -> None:
    recording = open_recording(recording_path)
    segment = recording.cut(0, LINES)
    result = reconstruct(segment, *MERGES, iterations=3, check=False, error=False)
    save_reconstruction(tmp_path / "v.zarr", result, recording, segment, MERGES[0])
    errors = open_video(tmp_path / "v.zarr").errors(0, len(result.video))
    assert errors is not None
    assert np.isnan(errors).all()


def test_a_stitched_video_records_them_by_the_same_names(recording_path: Path, tmp_path: Path) -> None:
    recording = open_recording(recording_path)
    request = in_voxels(by_lines(recording, 0, LINES), Voxels(*MERGES))
    options, monitor = Options(iterations=3, denoiser="haar", check=False, error=False), Monitor(1)
    with open_pool(1, 1, watch=monitor) as pool:
        combine(recording, request, tmp_path / "v.zarr", options=options, pool=pool, monitor=monitor)
    provenance = open_video(tmp_path / "v.zarr").attrs["provenance"]
    assert (provenance["solver"], provenance["denoiser"], provenance["plugins"]) == ("admm", "haar", [])
