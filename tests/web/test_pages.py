"""The pages that are made of results, as people see them: at three widths, in both themes, on paper, offline.

With ACQUIRE_SCREENSHOTS=DIRECTORY the pictures are kept, to be looked at.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import matplotlib as mpl
import numpy as np
import pytest
from demo_result import make_result
from PIL import Image

from acquire.evaluate import tradeoff_page
from acquire.evaluate.host import Busyness
from acquire.evaluate.paper import page as paper_page
from acquire.evaluate.paper.comparison import Row, captured, faster, finer, same, statement
from acquire.evaluate.paper.drawing import strip
from acquire.evaluate.paper.studio import PaperFigure, Picture, Studio
from acquire.evaluate.rendering import Appearance, Panel, render
from acquire.evaluate.report import write_report
from acquire.evaluate.themed import SOLVER_COLOURS, STYLE, THEORY, canvas
from acquire.evaluate.tradeoff import Point, TradeoffRun
from acquire.recon.segments import Voxels
from acquire.store import open_video
from acquire.store.video_layout import VideoGrid
from acquire.store.video_writer import VideoWriter

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

pytestmark = pytest.mark.needs_chromium

WIDTHS = (400, 1024, 1280)
THEMES: tuple[Literal["light", "dark"], ...] = ("light", "dark")
CARDS = {"light": (255, 255, 255), "dark": (27, 34, 43)}
BUSY = Busyness(cores=2, load=3.2, share=0.55, least_share=0.31)
VOXELS = Voxels(3, 1)
WHEN = datetime(2026, 5, 4, 3, 2, tzinfo=UTC)
START_NS = 1_780_000_000_000_000_000
SOLVED = {
    "first_line": 100,
    "lines": 90,
    "solver": "admm",
    "preset": "balanced",
    "seconds": 14.5,
    "segments": [
        {
            "name": "",
            "first_line": first,
            "lines": 50,
            "spatial_merge": 3,
            "temporal_merge": 1,
            "iterations": 120,
            "seconds": 7.5,
            "processor_s": 3.5,
            "quality": {"misfit": 0.0123, "prediction": None},
            "trusted": first > 100,
            "warnings": ["the sub-segment was broken off"] if first == 100 else [],
        }
        for first in (100, 140)
    ],
}
SCREENSHOTS = os.environ.get("ACQUIRE_SCREENSHOTS")

OUT_OF_SIGHT = """() => [...document.body.querySelectorAll("*")].filter((each) => {
  const box = each.getBoundingClientRect();
  return box.width && !each.closest(".hidden") && (box.right > innerWidth + 0.5 || box.left < -0.5)
    && !each.parentElement.closest(".scroll, pre");
}).map((each) => `${each.tagName} ${each.className} ${each.textContent.slice(0, 40)}`)"""
"""Elements that reach beyond the page, but for what can be pushed into sight within a box of its own."""


def blob(frames: int, size: int) -> np.ndarray:
    """A square that wanders over a grey ground and glows, most in the middle, above a pointer to the time."""
    video = np.full((frames, size, size), 0.2, np.float32)
    for number in range(frames):
        at = number * (size - 6) // frames
        video[number, at : at + 6, 4:12] = 0.9 - 0.4 * abs(2 * number / frames - 1)
        video[number, -1, number * size // frames] = 0.5 if number % 2 else 0.3
    return video


def demo(directory: Path) -> Path:
    return write_report(make_result(), directory)


def tradeoff(directory: Path) -> Path:
    truth, rng = blob(9, 24)[4], np.random.default_rng(3)

    def run(solver: str, slow: float, repeat: int, *, cut: bool = False) -> TradeoffRun:
        points = tuple(
            Point(
                number,
                slow * 1.4**number,
                1.7 * slow * 1.4**number,
                psnr_db=38 - 30 * 0.6**number + repeat,
                ssim=1 - 0.8 * 0.7**number,
                amplitude_error=0.7**number,
                frame=truth + np.float32(0.7**number) * rng.normal(0, 0.3, truth.shape).astype(np.float32),
            )
            for number in range(9)
        )
        ended = "budget" if cut else "done"
        return TradeoffRun(
            solver, VOXELS, "float32", 9, points, case="a <square>", repeat=repeat, ended=ended, mean_db=17
        )

    runs = [run("admm", 0.3, 0), run("admm", 0.31, 1), run("twist-band", 2.0, 0, cut=True)]
    heading = {
        "title": "a square",
        "command": "acquire tradeoff",
        "notes": ["Two repeats."],
        "host": BUSY.facts(),
    }
    return tradeoff_page.write_page(
        runs, {("a <square>", VOXELS): truth}, None, directory=directory, heading=heading, when=WHEN
    )


def paper(directory: Path) -> Path:
    video, times = blob(40, 24), np.linspace(52, 58, 400)
    with mpl.rc_context(STYLE):
        drawing = canvas(2.6)
        ax = drawing.subplots()
        ax.plot(times, np.sin(times * 9), color=THEORY, lw=3, label="theory")
        ax.plot(times, 0.9 * np.sin(times * 9), color=SOLVER_COLOURS[0], label="ours")
        ax.set(xlabel="time (ms)", ylabel="light")
        ax.legend()
        stamps = [f"{number:.2f} ms" for number in range(6)]
        frames = strip("frames", "(b) frames.", (("ours", video[:6]), ("truth", video[:6])), stamps)
    rows = (
        finer("resolves", "group 3, element 5", "group 3, element 6", 1),
        same("video", "64 × 64 × 598", "64 × 64 × 598", equal=True),
        faster(
            "time", "“ten more minutes”", "900 s", seconds=900.0, paper_s=600.0, where="on another processor"
        ),
        captured(
            "300 kHz pulses, intra-line; true picture, camera noise", "captured with high fidelity", 0.98
        ),
        statement("bars", "#B significantly better", "none", "#B 1 element coarser", hold=False),
        Row("accuracy", "–", "39.8 dB, SSIM 0.98 in 33.3 s"),
    )
    figure = PaperFigure(
        "fig9",
        "Scene #1: four LEDs",
        "263 lines of both cameras.",
        (frames, Picture("curves", drawing, "(c) light over time.")),
        rows,
        {"Scene #1": 33.3},
        movie={"ours": video, "truth": video},
        movie_ms=0.02,
    )
    still = PaperFigure("fig6", "Resolution", "At rest.", (), rows[:1], {"static": 1.5})
    drawn = [paper_page.draw(each, directory, BUSY) for each in (still, figure)]
    # The command writes the page after every figure, at first without a video.
    paper_page.write_page(drawn[:1], Studio(directory), "acquire paper fig6 fig9", WHEN)
    return paper_page.write_page(drawn, Studio(directory), "acquire paper fig6 fig9", WHEN)


def video(directory: Path) -> Path:
    """Two videos on one clock, one of them in sub-segments that are not all trusted."""
    panels = []
    for name, frames, size in (("fine", 20, 30), ("fast <x>", 40, 10)):
        interval_ns = 4_000_000 // frames
        grid = VideoGrid((interval_ns * 1e-9, 1.0, 1.0), (0.0, 0.0, 0.0), None)
        made = directory / f"{name}.zarr"
        with VideoWriter(made, (size, size), np.dtype("f4"), grid, quality=True) as writer:
            times = START_NS + interval_ns * np.arange(frames)
            writer.append(blob(frames, size), times, np.linspace(0.3, 0.01, frames, dtype=np.float32))
            writer.finish({"trusted": [4, frames], "recording": "run.zarr", **SOLVED})
        panels.append(Panel(name, open_video(made)))
    page = directory / "index.html"
    render(panels, page, Appearance(), 300)
    return page


PAGES: dict[str, Callable[[Path], Path]] = {
    "demo": demo,
    "paper": paper,
    "tradeoff": tradeoff,
    "video": video,
}


@pytest.fixture(scope="module", params=PAGES)
def place(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    directory = tmp_path_factory.mktemp(request.param)
    return PAGES[request.param](directory).as_uri()


@pytest.fixture
def opened(browser: Browser, place: str) -> Iterator[Callable[..., Page]]:
    """Opens the page without a network and with motion unwanted; nothing outside it may be asked for."""
    asked: list[str] = []
    problems: list[str] = []
    contexts = []

    def make(width: int = 1024, theme: Literal["light", "dark"] = "light", **options: Any) -> Page:
        context = browser.new_context(
            viewport={"width": width, "height": 900},
            color_scheme=theme,
            **{"reduced_motion": "reduce", "offline": True} | options,
        )
        contexts.append(context)
        page = context.new_page()
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.goto(place)
        page.wait_for_function("() => [...document.images].every((each) => each.complete)")
        return page

    yield make
    for context in contexts:
        context.close()
    assert problems == []
    assert {url for url in asked if not url.startswith("data:")} <= {place}


def pixels(shown: Locator) -> np.ndarray:
    with Image.open(BytesIO(shown.screenshot())) as image:
        return np.asarray(image.convert("RGB"), int)


@pytest.mark.parametrize("theme", THEMES)
@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_is_cut(opened: Callable[..., Page], place: str, width: int, theme: str) -> None:
    page = opened(width, theme)
    if SCREENSHOTS:
        name = Path(place).parent.name.rstrip("0")
        page.screenshot(path=f"{SCREENSHOTS}/{name}-{width}-{theme}.png", full_page=True)
    assert page.evaluate(OUT_OF_SIGHT) == []
    assert page.evaluate("() => document.documentElement.scrollWidth") <= width


def test_the_picture_comes_first_and_all_have_words(opened: Callable[..., Page]) -> None:
    page = opened(400)
    top = page.locator("main img").first.bounding_box()
    assert top is not None
    assert top["y"] < 500, "the first picture is not on the first screen"
    for image in page.locator("img").all():
        assert len(image.get_attribute("alt") or "") > 5
        assert image.evaluate("(each) => each.naturalWidth") > 0


def test_drawings_lie_on_the_page_in_both_themes(opened: Callable[..., Page]) -> None:
    """Without a background of their own, and with ink that stands out from it."""
    found = {}
    for theme in THEMES:
        shown = pixels(opened(1024, theme).locator("picture img:visible").last)
        assert tuple(shown[1, 1]) == CARDS[theme]
        found[theme] = shown
        apart = np.abs(shown - CARDS[theme]).max(axis=2)
        assert (apart > 120).mean() > 0.002, "nothing to be seen"
    assert found["light"].shape == found["dark"].shape
    assert np.abs(found["light"] - found["dark"]).mean() > 100


def test_narrow_pages_have_drawings_of_their_own_whose_letters_can_be_read(
    opened: Callable[..., Page],
) -> None:
    sizes = """() => [...document.querySelectorAll("picture img")].filter((each) => each.offsetWidth)
      .map((each) => each.offsetWidth / each.naturalWidth)"""
    for width in (400, 1024):  # one CSS pixel is 1/96 inch: letters of 7.5 pt and more are scaled by this
        assert min(opened(width).evaluate(sizes)) > 0.7


def test_the_player_steps_by_key(opened: Callable[..., Page]) -> None:
    page = opened()
    player = page.locator("figure.player").first
    image, slider = player.locator("img"), player.locator("input")
    seen = [image.get_attribute("src")]
    slider.focus()
    for key in ("ArrowRight", "ArrowRight", "ArrowLeft", "End", "Home"):
        page.keyboard.press(key)
        seen.append(image.get_attribute("src"))
    first, second, third = seen[:3]
    assert len({first, second, third, seen[4]}) == 4
    assert seen[3] == second
    assert slider.input_value() == "0"


def test_it_moves_only_where_motion_is_wanted(opened: Callable[..., Page], place: str) -> None:
    still, moving = opened(), opened(reduced_motion="no-preference")
    start = still.locator("figure.player").first.get_attribute("data-start")
    glows = "/paper" in place or "/video" in place
    assert int(start or 0) == pytest.approx(20 if glows else 0, abs=1)
    moving.wait_for_function("(start) => document.querySelector('input').value !== start", arg=start)
    assert still.locator("input").first.input_value() == start


def test_on_paper_it_is_light_and_whole(opened: Callable[..., Page]) -> None:
    pages = {theme: opened(700, theme) for theme in THEMES}
    for theme, each in pages.items():
        each.emulate_media(media="print", color_scheme=theme, reduced_motion="reduce")
    light, dark = (pixels(each.locator("picture img:visible").last) for each in pages.values())
    assert np.array_equal(light, dark)
    assert tuple(light[1, 1]) == CARDS["light"]
    page = pages["dark"]
    assert page.evaluate(OUT_OF_SIGHT) == []
    assert page.evaluate("() => getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert page.locator(".controls:visible").count() == 0
    assert page.evaluate(
        "() => [...document.querySelectorAll('.scroll')].every((e) => e.scrollWidth <= e.offsetWidth)"
    )


@pytest.mark.parametrize("place", ["demo", "paper", "tradeoff"], indirect=True)
def test_the_page_says_how_busy_the_machine_was(opened: Callable[..., Page], place: str) -> None:
    share = 63 if "/demo" in place else 55
    assert f"a busy thread got {share} % of a core" in opened().inner_text("main")


@pytest.mark.parametrize("place", ["paper"], indirect=True)
def test_reached_is_not_better(opened: Callable[..., Page]) -> None:
    page = opened()
    cells = [each.inner_text().split("\n") for each in page.locator("#fig9 td[data-label='verdict']").all()]
    assert cells == [
        ["▲ better", "1 element finer, × 1.12"],
        ["= equal"],
        ["▼ worse", "× 1.5 slower, on another processor"],
        ["✓ holds", "r ≥ 0.9"],
        ["✗ does not hold", "#B 1 element coarser"],
        ["no number"],
    ]
    tiles = [each.inner_text().split("\n")[:2] for each in page.locator(".tile").all()]
    assert tiles[0] == ["▲ better", "2"]
    assert len(tiles) == 6


@pytest.mark.parametrize("place", ["video"], indirect=True)
def test_a_video_s_page_marks_what_is_not_trusted(opened: Callable[..., Page]) -> None:
    page = opened()
    slider, label = page.locator("input").first, page.locator("output")
    slider.focus()
    page.keyboard.press("Home")
    assert label.inner_text() == "0.000 ms · not trusted: fine, fast <x>"
    page.keyboard.press("End")
    assert label.inner_text() == "3.900 ms"
    rows = page.locator("section").nth(1).locator("tbody tr")
    assert rows.nth(0).inner_text().split("\t") == [
        "1",
        "100 … 149",
        "3 × 1",
        "120",
        "7.5",
        "3.5",
        "1.23",
        "–",
        "no",
    ]
    assert rows.nth(1).locator("td").last.inner_text() == "yes"
    assert page.get_by_text("the sub-segment was broken off").count() == 2
    assert page.locator("picture").count() == 2
