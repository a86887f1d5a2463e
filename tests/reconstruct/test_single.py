"""A reconstruction in memory is written with the same origin as a stitched video."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from acquire.recon import reconstruct
from acquire.recon.denoisers import HaarShrink
from acquire.recon.segments import Voxels
from acquire.reconstruct import Options, Watcher, by_lines, combine, in_voxels, open_pool, save_reconstruction
from acquire.store import open_recording, open_video

if TYPE_CHECKING:
    from pathlib import Path

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


def test_a_stitched_video_records_them_by_the_same_names(recording_path: Path, tmp_path: Path) -> None:
    recording = open_recording(recording_path)
    request = in_voxels(by_lines(recording, 0, LINES), Voxels(*MERGES))
    options, watcher = Options(iterations=3, denoiser="haar", check=False, error=False), Watcher(1)
    with open_pool(1, 1, watch=watcher) as pool:
        combine(recording, request, tmp_path / "v.zarr", options=options, pool=pool, watcher=watcher)
    provenance = open_video(tmp_path / "v.zarr").attrs["provenance"]
    assert (provenance["solver"], provenance["denoiser"], provenance["plugins"]) == ("admm", "haar", [])
