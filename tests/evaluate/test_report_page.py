"""The demo's page holds every number and text of its summary, and refers to nothing outside itself."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from PIL import Image

from acquire.errors import UsageError
from acquire.evaluate import figures, themed
from acquire.evaluate.page import NARROW_SPACE, hertz, number
from acquire.evaluate.report import DemoResult, evaluate_solver, render_page, write_report
from acquire.evaluate.summary import summarise

VOID = {"meta", "link", "img", "br", "input", "source"}
HIDDEN = {"style", "title", "script"}


class Page(HTMLParser):
    """Fails on tags that do not nest; collects the text that a reader sees, all attributes, all ids."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str | None]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []
        self.text = re.sub(r"[ \n]+", " ", " ".join(self.words))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value) for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not HIDDEN & set(self.open):
            self.words.append(data)

    @property
    def numbers(self) -> set[float]:
        plain = self.text.replace(NARROW_SPACE, "").replace("−", "-")
        return {float(match) for match in re.findall(r"-?\d+(?:\.\d+)?", plain)}


@pytest.fixture(scope="module")
def directory(result: DemoResult, tmp_path_factory: pytest.TempPathFactory):
    directory = tmp_path_factory.mktemp("report") / "made" / "by itself"
    assert write_report(result, directory) == directory / "index.html"
    return directory


@pytest.fixture(scope="module")
def source(directory) -> str:
    return (directory / "index.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(source) -> Page:
    return Page(source)


def leaves(value: Any, key: str = "") -> list[tuple[str, Any]]:
    if isinstance(value, dict):
        return [leaf for name, inner in value.items() for leaf in leaves(inner, name)]
    if isinstance(value, list):
        return [leaf for inner in value for leaf in leaves(inner, key)]
    return [(key, value)]


def test_every_number_of_the_summary_is_on_the_page(directory, page: Page) -> None:
    summary = json.loads((directory / "summary.json").read_text())
    found = [(key, value) for key, value in leaves(summary) if type(value) in {int, float}]
    assert len(found) > 80
    scale = {"set_hz": 1e-3}  # 5000 Hz is shown as 5 kHz
    absent = [(key, value) for key, value in found if value * scale.get(key, 1) not in page.numbers]
    assert absent == []


def test_every_text_of_the_summary_is_on_the_page(result: DemoResult, page: Page) -> None:
    shown_otherwise = {"when", "recording"}
    texts = [v for k, v in leaves(summarise(result)) if isinstance(v, str) and k not in shown_otherwise]
    assert len(texts) > 15
    assert [text for text in texts if text not in page.text] == []
    assert "2025-06-07 08:09 UTC" in page.text


def test_losses_are_listed_with_their_causes(page: Page) -> None:
    assert "lost: camera 0 2 lost: ring full 0 14" in page.text
    assert "discarded while armed 7 11" in page.text


def test_the_load_of_the_machine_is_reported(page: Page) -> None:
    assert "a busy thread got 63 % of a core, and at worst 41 %" in page.text
    assert "The machine was busy; on an idle machine, this takes less time." in page.text


def test_a_solver_that_its_budget_stopped_is_not_shown_as_if_it_had_finished(page: Page) -> None:
    assert "207 of 451 (stopped by its time limit of 31.5 s)" in page.text
    assert re.search(r"TwIST [\d.]+ dB, stopped by its time limit", page.text)
    assert "118 of" not in page.text


def test_the_page_refers_to_nothing_outside_itself(source: str, page: Page) -> None:
    assert not re.search(r"https?://|//[a-z]+\.|@import|url\(|<script[^>]*src|<iframe", source)
    references = [
        value for _, name, value in page.attributes if name in {"src", "href", "srcset", "action", "data"}
    ]
    assert len(references) == 10  # the icon, the player's first frame, and each drawing for two widths
    assert all(value.startswith("data:") for value in references)


def test_pictures_have_alternative_texts_and_are_the_files_next_to_the_page(directory, page: Page) -> None:
    images = [value for tag, name, value in page.attributes if (tag, name) == ("img", "src")]
    texts = [value for tag, name, value in page.attributes if (tag, name) == ("img", "alt")]
    assert len(images) == len(texts) == 5
    assert all(text and len(text) > 20 for text in texts)
    names = {path.name for path in directory.iterdir()}
    assert names == {
        "index.html", "summary.json", "animation.webp",
        *(f"{name}.{kind}" for name in ("lines", "frames", "curves", "psnr") for kind in ("png", "svg")),
    }  # fmt: skip


def test_text_is_escaped(source: str, page: Page) -> None:
    assert "Scene #1: <four> LEDs" in page.text
    assert "<four>" not in source


def test_the_three_lines_open_this_recording(result: DemoResult, page: Page) -> None:
    code = re.search(r"from acquire\.store .*?cut\(.*?\)", page.text)
    assert code
    assert f"open_recording({str(result.capture.recording)!r})" in code[0]
    assert "cut(1733, 51)" in code[0]


@pytest.mark.parametrize("name", ["lines", "frames", "curves", "psnr"])
def test_figures_are_pictures_of_the_page_width(directory, name: str) -> None:
    with Image.open(directory / f"{name}.png") as image:
        pixels = np.asarray(image.convert("L"))
    assert pixels.shape[1] == themed.DPI * themed.WIDTH_IN
    assert pixels.std() > 10, "an empty figure"


def test_masked_samples_stand_out(directory) -> None:
    with Image.open(directory / "lines.png") as image:
        red, green, blue = np.asarray(image.convert("RGB"), int).transpose(2, 0, 1)
    orange = (red == 0xD5) & (green == 0x5E) & (blue == 0)
    assert orange.sum(axis=1).max() > 400, "no bar across one of the two pictures"


def test_extremes_one_perfect_solver_nothing_to_follow_no_stage_time(result: DemoResult, tmp_path) -> None:
    perfect = evaluate_solver(
        "exact", result.truth, result.truth, (), 1e-5, seconds=0.0, iterations=0, requested_iterations=0
    )
    bare = replace(result, solvers=(perfect,), regions=(), stages=())
    (tmp_path / "index.html").write_text("of an earlier run")
    page = Page(write_report(bare, tmp_path).read_text(encoding="utf-8"))
    assert "PSNR – dB" in page.text
    assert "Intensity over time" not in page.text
    assert not (tmp_path / "curves.png").exists()


def test_a_run_without_losses_says_so(result: DemoResult, directory) -> None:
    arms = dict.fromkeys("ab", result.capture.arms["a"])
    calm = replace(result, capture=replace(result.capture, arms=arms, condition="GOOD"))
    drawings = dict.fromkeys(("lines", "frames", "curves", "psnr"), themed.Drawing("<svg/>", "<svg/>"))
    summary = json.loads((directory / "summary.json").read_text()) | summarise(calm)
    text = render_page(summary, drawings, directory / "animation.webp")
    assert 'class="badge good">GOOD' in text
    assert 'class="warn"' not in text
    assert "Lines lost 0 GOOD" in Page(text).text


def test_a_directory_that_cannot_be_made_is_refused(result: DemoResult, tmp_path) -> None:
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(UsageError, match="taken"):
        write_report(result, tmp_path / "taken")


def test_frames_are_picked_within_one_period_of_the_slowest_region(result: DemoResult) -> None:
    picks = figures.representative_frames(result)
    assert picks.tolist() == [65, 71, 78, 85, 91, 98]  # 2.5 kHz: 40 frames, from the middle of 130


def test_frames_are_picked_over_everything_where_nothing_swings(result: DemoResult) -> None:
    steady = tuple(replace(solver, curves=solver.curves[2:]) for solver in result.solvers)
    still = replace(result, solvers=steady, regions=result.regions[2:])
    assert figures.representative_frames(still, 3).tolist() == [0, 64, 129]


def test_only_the_figures_pay_for_matplotlib() -> None:
    code = "import sys, acquire.evaluate.report; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=300).returncode == 0


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (None, None, "–"),
        (20003, None, "20\u202f003"),
        (10.0, None, "10"),
        (7.62, None, "7.62"),
        (7.0, 2, "7.00"),
        (-0.92, 1, "−0.9"),
        (1234567.5, 1, "1\u202f234\u202f567.5"),
    ],
)
def test_numbers_are_set_for_reading(value, digits, text) -> None:
    assert number(value, digits) == text


def test_signs_and_frequencies() -> None:
    assert [number(x, 1, signed=True) for x in (0.5, -0.5, 0.0)] == ["+0.5", "−0.5", "0.0"]
    assert [hertz(x) for x in (5000.0, 2500.0, 30.0, None)] == [
        "5\u202fkHz", "2.5\u202fkHz", "30\u202fHz", "constant"
    ]  # fmt: skip
