"""Recordings whose pixels a codec of another distribution packs: with it, without it, and if it fails."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import zarr
from hypothesis import given
from hypothesis import strategies as st
from store_helpers import check_rows, fill, make_spec

from acquire import plugins
from acquire.config import load_rig
from acquire.errors import ConfigError, DataError, UsageError
from acquire.plugins import CODECS
from acquire.store import RecordingWriter, RunCondition, open_recording, recover, verify
from acquire.store.codecs import checked_size, configured_codec
from acquire.store.plugin_codecs import as_plugin, prove, variant_of
from acquire.store.shape import PluginCodec, crc32c

MODULE = """
import zlib
from pathlib import Path
from typing import ClassVar
from acquire.store.variant import CodecVariant

class Deflate(CodecVariant):
    '''zlib.'''
    zarr_name: ClassVar[str] = "lab.deflate"
    level: int = 1

    def encode(self, data):
        if Path("{fails}").exists():
            raise RuntimeError("out of cheese")
        return zlib.compress(data, self.level)

    def decode(self, data, size):
        return zlib.decompress(data, bufsize=size)
"""


class Site:
    """A place where Python finds a distribution with a codec, until that is uninstalled."""

    def __init__(self, place: Path) -> None:
        self.place, self.fails = place, place / "fails"

    def install(self, source: str | None = None) -> None:
        about = self.place / "lab_codecs-1.5.dist-info"
        about.mkdir(parents=True)
        (about / "METADATA").write_text("Metadata-Version: 2.1\nName: lab-codecs\nVersion: 1.5\n")
        (about / "entry_points.txt").write_text("[acquire.codecs]\ndeflate = lab_codecs:Deflate\n")
        (self.place / "lab_codecs.py").write_text(source or MODULE.format(fails=self.fails))
        self.forget()

    def uninstall(self) -> None:
        for file in (self.place / "lab_codecs-1.5.dist-info").iterdir():
            file.unlink()
        (self.place / "lab_codecs-1.5.dist-info").rmdir()
        self.forget()

    def forget(self) -> None:
        sys.modules.pop("lab_codecs", None)
        plugins.forget()
        variant_of.cache_clear()


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    place = Site(tmp_path / "site")
    monkeypatch.syspath_prepend(str(place.place))
    place.install()
    # In a process of its own zarr finds it by its entry point (tests/plugins/test_distribution.py).
    zarr.registry.register_codec("lab.deflate", CODECS.load("deflate").zarr_codec)
    yield place
    monkeypatch.undo()
    place.forget()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "r.zarr"


def deflate(level: int = 3) -> PluginCodec:
    return as_plugin("deflate", CODECS.load("deflate")(level=level), 16, 2)


def go_on(writer: RecordingWriter) -> None:
    fill(writer, 500)
    writer.commit()


def recorded(path: Path, lines: int = 150) -> None:
    with RecordingWriter.create(path, make_spec(codec=deflate(), tag_chunks=2)) as writer:
        fill(writer, lines)
        writer.seal(RunCondition.GOOD, "done", {})


def test_its_pixels_are_read_by_us_and_by_zarr_and_everything_else_is_ours(site: Site, path: Path) -> None:
    recorded(path)
    check_rows(zarr.open_group(path, mode="r"), make_spec(), 150)
    recording = open_recording(path)
    assert verify(path).intact
    assert not verify(path).notes
    assert recording.cut(1000, 100).mask.all()
    arrays = recording.document["consolidated_metadata"]["metadata"]
    packers = {
        name: document["codecs"][0]["configuration"]["codecs"][1]
        for name, document in arrays.items()
        if name.startswith("a/")
    }
    assert packers.pop("a/lines") == {"name": "lab.deflate", "configuration": {"level": 3}}
    assert {packer["configuration"]["cname"] for packer in packers.values()} == {"lz4"}
    origin = {"name": "deflate", "distribution": "lab-codecs", "version": "1.5"}
    assert arrays["a/lines"]["attributes"]["codec"] == origin
    assert (recording.info()["codec"], recording.info()["codec_missing"]) == ("deflate", None)


def test_without_it_all_but_the_pixels_is_there_and_it_is_said_what_to_install(
    site: Site, path: Path
) -> None:
    recorded(path)
    site.uninstall()
    recording = open_recording(path)
    assert recording.lines == 150
    assert recording.camera("a").read("flags", 0, 150).shape == (150,)
    what = "codec 'deflate' of lab-codecs 1.5, which cannot be used here: codec 'deflate' is not known"
    assert what in recording.info()["codec_missing"]
    for ask in (lambda: recording.cut(1000, 100), lambda: recording.camera("a").lines):
        with pytest.raises(UsageError, match=r"try: pip install 'lab-codecs==1\.5'") as refused:
            ask()
        assert what in str(refused.value)
    done = verify(path)
    assert done.intact
    assert len(done.notes) == 1
    assert done.notes[0].startswith("chunks of pixels were verified by their checksums alone")
    assert "pip install 'lab-codecs==1.5'" in done.notes[0]


def test_damage_is_found_without_it(site: Site, path: Path) -> None:
    recorded(path)
    site.uninstall()
    reader = open_recording(path).camera("b").reader("lines")
    offset, _ = reader.entry(2)
    file = path / reader.file(2)
    content = bytearray(file.read_bytes())
    content[offset + 3] ^= 1
    file.write_bytes(content)
    (damage,) = verify(path).damage
    assert (damage.arm, damage.array, damage.first_line, damage.count) == ("b", "lines", 1032, 16)


def test_no_more_is_lost_at_a_kill_than_is_stated_and_recovery_does_without_it(
    site: Site, path: Path
) -> None:
    """Lines behind the last commit are found by their checksums: what others pack states no length."""
    spec = make_spec(codec=deflate(), chunk_lines=16, commit_lines=96, tag_chunks=2)
    with RecordingWriter.create(path, spec) as writer:
        for _ in range(1, 21):
            fill(writer, 7, block_lines=7)
        told, committed = writer.next_line("a") - 1000, writer.committed_lines
    site.uninstall()
    kept = recover(path).lines
    assert told - kept < spec.durability.kill_lines
    assert kept > committed
    site.install()
    check_rows(zarr.open_group(path, mode="r"), spec, kept)


def test_one_that_fails_ends_the_recording_with_what_is_on_disk(site: Site, path: Path) -> None:
    with RecordingWriter.create(path, make_spec(codec=deflate(), encoders=1)) as writer:
        fill(writer, 64)
        writer.commit()
        site.fails.touch()
        with pytest.raises(
            DataError, match=r"the codec failed while .*RuntimeError: out of cheese"
        ) as failed:
            go_on(writer)
        assert failed.value.hint == "another recording.codec: lz4 and zstd are ours"
        writer.seal(RunCondition.ABORTED, "codec", {})
    assert verify(path).intact
    check_rows(zarr.open_group(path, mode="r"), make_spec(), 64)


@pytest.mark.parametrize(
    ("packed", "why"),
    [("b''", "256 bytes were packed into 0"), ("bytes(9999)", "were packed into 9999"), ("7", "TypeError")],
)
def test_what_no_reader_would_accept_is_not_written(site: Site, path: Path, packed: str, why: str) -> None:
    codec = deflate()
    site.uninstall()
    source = MODULE.replace("return zlib.compress(data, self.level)", f"return {packed}")
    site.install(source.format(fails=site.fails))
    with (
        RecordingWriter.create(path, make_spec(codec=codec)) as writer,
        pytest.raises(DataError, match=f"codec 'deflate' of lab-codecs failed: .*{why}"),
    ):
        go_on(writer)


@pytest.mark.parametrize(
    ("unpacked", "why"),
    [("data", r"has unpacked \d+ bytes in place of 256"), ("1 // 0", "failed: ZeroDivisionError")],
)
def test_chunks_that_it_cannot_unpack_are_damaged(site: Site, path: Path, unpacked: str, why: str) -> None:
    recorded(path)
    site.uninstall()
    source = MODULE.replace("return zlib.decompress(data, bufsize=size)", f"return {unpacked}")
    site.install(source.format(fails=site.fails))
    with pytest.raises(DataError, match=f"lines 1000 to 1009 cannot be read: codec 'deflate' {why}"):
        open_recording(path).camera("a").read("lines", 0, 10)


@pytest.mark.parametrize(
    ("packs", "unpacks", "why"),
    [
        ("bytes(len(data))", "data", "codec 'deflate' has unpacked other bytes than it was given"),
        ("None", "data", "codec 'deflate' of lab-codecs failed: TypeError"),
        ("data", "1 // 0", "codec 'deflate' failed: ZeroDivisionError"),
        ("data", "data[1:]", "codec 'deflate' has unpacked 511 bytes in place of 512"),
    ],
)
def test_one_that_does_not_give_lines_back_is_refused_before_it_records(
    site: Site, packs: str, unpacks: str, why: str
) -> None:
    """Its recordings were GOOD until somebody read them."""
    prove(np.arange(256, dtype="<u2").reshape(-1, 8), deflate())
    source = MODULE.format(fails=site.fails).replace("zlib.compress(data, self.level)", packs)
    site.uninstall()
    site.install(source.replace("zlib.decompress(data, bufsize=size)", unpacks))
    with pytest.raises(ConfigError, match=re.escape(why)):
        prove(np.arange(256, dtype="<u2").reshape(-1, 8), deflate())


def test_one_that_is_fitted_to_nothing_is_refused(site: Site) -> None:
    lost = SimpleNamespace(fitted=lambda line_bytes, item_bytes: None)
    with pytest.raises(ConfigError, match=r"codec 'deflate': fitted\(\) gave back None"):
        as_plugin("deflate", lost, 16, 2)


def test_another_codec_of_that_name_does_not_unpack_its_lines(site: Site, path: Path) -> None:
    recorded(path)
    site.uninstall()
    site.install(MODULE.format(fails=site.fails).replace("lab.deflate", "other.deflate"))
    why = "the installed codec of that name is 'other.deflate' in Zarr, and not 'lab.deflate'"
    with pytest.raises(UsageError, match=why):
        open_recording(path).cut(1000, 100)
    site.uninstall()
    site.install(
        MODULE.format(fails=site.fails).replace("level: int", "strength: int").replace(".level", ".strength")
    )
    with pytest.raises(UsageError, match="Extra inputs are not permitted"):
        open_recording(path).cut(1000, 100)


def test_a_rig_names_it_with_its_options(site: Site) -> None:
    rig = load_rig("rig-demo", {"recording.codec": "deflate", "recording.codec_options": {"level": 7}})
    codec = configured_codec(rig, auto="none")
    assert (str(codec), codec.configuration) == ("deflate", '{"level": 7}')
    assert configured_codec(load_rig("rig-demo", {"recording.codec": "auto"}), auto="zstd") == "zstd"
    assert configured_codec(load_rig("rig-demo", {"recording.codec": "lz4"}), auto="none") == "lz4"
    assert rig.model_dump(mode="json")["recording"]["codec_options"] == {"level": 7}


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"recording.codec": "deflat"}, r"recording.codec = 'deflat': .* did you mean 'deflate'"),
        ({"recording.codec": "deflat"}, r"possible: auto, none, lz4, zstd, deflate \(lab-codecs 1\.5\)"),
        ({"recording.codec": "deflate", "recording.codec_options": {"level": "9"}}, "codec_options.level"),
        ({"recording.codec": "lz4", "recording.codec_options": {"level": 9}}, "codec 'lz4' has no options"),
    ],
)
def test_mistakes_in_a_rig_are_named(site: Site, settings: dict[str, object], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        load_rig("rig-demo", settings)


def test_one_without_a_name_in_zarr_is_left_out(site: Site) -> None:
    site.uninstall()
    site.install(MODULE.format(fails=site.fails).replace('zarr_name: ClassVar[str] = "lab.deflate"', ""))
    assert "deflate" not in CODECS.working()
    with pytest.raises(ConfigError, match="lab_codecs:Deflate needs zarr_name, its name in the metadata"):
        CODECS.load("deflate")


@given(
    chunk=st.one_of(st.binary(min_size=1, max_size=9000), st.integers(4080, 4100).map(lambda n: b"\7" * n)),
    zeros=st.integers(0, 30),
    behind=st.sampled_from(["nothing", "another", "page"]),
)
def test_a_chunk_is_found_by_its_checksum(chunk: bytes, zeros: int, behind: str) -> None:
    payload = chunk + bytes(zeros)
    whole = payload + crc32c(payload)
    page = whole + bytes(-len(whole) % 4096)
    follows = {"nothing": b"", "another": page, "page": bytes(np.arange(4096, dtype=np.uint16))}[behind]
    assert checked_size(page + follows) == len(whole)
    flipped = bytearray(page)
    flipped[len(chunk) // 2] ^= 16
    assert checked_size(bytes(flipped)) == 0


def test_a_spec_without_its_plug_in_can_be_copied(site: Site) -> None:
    """It is sent to the recorder's process, which looks the plug-in up by itself."""
    assert replace(make_spec(codec=deflate())).codec == deflate()
    with pytest.raises(UsageError, match="codec = 'deflate'"):
        make_spec(codec="deflate")
