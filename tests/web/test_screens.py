"""Every state as an operator sees it, in both themes and three widths: what the band says, and that all fits.

With ACQUIRE_SCREENSHOTS=DIRECTORY the pictures are kept, to be looked at.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from fake_run import FakeRun, rig_config
from page_server import PageServer
from served import api
from waiting import until
from wire import Wire

from acquire.client import Client
from acquire.daemon.endpoint import Endpoint
from acquire.daemon.messages import DiskStatus
from acquire.daemon.service import Service
from acquire.errors import CameraError
from acquire.logs import KeptEntry
from acquire.stream.ring import RingShape

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

pytestmark = pytest.mark.needs_chromium

WIDTHS = (1280, 1024, 400)
SEEN_MS = 60_000
SCREENSHOTS = os.environ.get("ACQUIRE_SCREENSHOTS")


class Instrument:
    """A service whose capture path is the test's, and its API on the socket that the page's process asks."""

    def __init__(self, home: Path, server: PageServer) -> None:
        self.run, self.server = FakeRun(), server
        self.service = Service(rig_config(home), lambda _: self.run)
        self._stack = contextlib.ExitStack()
        self.disk(seconds_to_full=1e6)
        socket = home / "c.sock"
        endpoint = self._stack.enter_context(contextlib.closing(Endpoint(socket)))
        self._stack.enter_context(api(self.service, endpoint))
        self.client = Client(socket)

    def see(self, **changes: Any) -> None:
        self.run.see(**changes)
        self.service.supervise()

    def disk(self, *, seconds_to_full: float, away: str | None = None) -> None:
        """What the disk under the test has left would be told as well."""
        left = DiskStatus(
            directory=Path("/d"),
            free_bytes=10**9,
            reserve_bytes=0,
            bytes_per_s=4e6,
            seconds_to_full=seconds_to_full,
        )

        class Disk:
            status = None if away else left
            trouble = away

            def check(self, *, recording: bool) -> None: ...
            def came_back(self) -> bool:
                return False

            def other(self) -> str:
                return ""

            def refuse(self, path: Path) -> None: ...
            def close(self) -> None: ...

        self.service._disk = Disk()  # type: ignore[assignment]
        self.service.supervise()

    def close(self) -> None:
        """Nobody answers any more."""
        self._stack.close()


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("page")


@pytest.fixture(scope="module")
def server(home: Path) -> Iterator[PageServer]:
    with contextlib.closing(PageServer(home / "c.sock", home)) as made:
        yield made


@pytest.fixture
def instrument(home: Path, server: PageServer) -> Iterator[Instrument]:
    """One daemon after the other, for one and the same page."""
    with contextlib.closing(Instrument(home, server)) as made:
        yield made


@pytest.fixture
def page(browser: Browser, instrument: Instrument) -> Iterator[Page]:
    context = browser.new_context(viewport={"width": 1280, "height": 900}, color_scheme="light")
    page = context.new_page()
    problems: list[str] = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.goto(instrument.server.link)
    page.wait_for_selector("#arm:enabled", timeout=SEEN_MS)  # who is there is known, and that it is idle
    yield page
    context.close()
    assert problems == []


def arm(instrument: Instrument) -> None:
    instrument.client.arm()
    instrument.service.supervise()


def record(instrument: Instrument) -> None:
    arm(instrument)
    instrument.client.start(Path("/d/x.zarr"), lines=1_000_000)
    instrument.see(recorded_lines=250_000, committed_lines=240_000)


def lose(instrument: Instrument) -> None:
    record(instrument)
    lines = {arm: {**counts, "lost": {"camera": 123}} for arm, counts in instrument.run.seen.lines.items()}
    instrument.see(lines=lines)


def fail(instrument: Instrument) -> None:
    arm(instrument)
    instrument.see(fault="camera b does not answer any more")


def fill_disk(instrument: Instrument) -> None:
    record(instrument)
    instrument.disk(seconds_to_full=240.0)


def lose_directory(instrument: Instrument) -> None:
    arm(instrument)
    text = "no recording can begin in /data/runs: its disk is not mounted on /data any more; mount it again"
    instrument.disk(seconds_to_full=0.0, away=text)


def go_silent(instrument: Instrument) -> None:
    arm(instrument)
    instrument.close()


STATES: dict[str, tuple[Callable[[Instrument], None], str, str, str]] = {
    "idle": (lambda _: None, "idle", "", "Nothing is armed"),
    "armed": (arm, "armed", "", "nothing is lost"),
    "recording": (record, "recording", "", "nothing is lost"),
    "lost": (lose, "lost", "lines lost", "246 lines were lost"),
    "faulted": (fail, "fault", "fault", "camera b does not answer"),
    "disk nearly full": (fill_disk, "degraded", "degraded", "the disk is full in 4 min"),
    "directory away": (lose_directory, "degraded", "degraded", "its disk is not mounted on /data any more"),
    "stale": (go_silent, "", "no contact", "cannot reach the daemon"),
}


@pytest.mark.parametrize("name", STATES)
def test_every_state_is_shown_in_words_and_fits(name: str, page: Page, instrument: Instrument) -> None:
    enter, level, word, sentence = STATES[name]
    enter(instrument)
    wanted = f"[data-level={level}]" if level else "[data-stale]"
    page.wait_for_selector(f"body{wanted}", timeout=SEEN_MS)
    page.locator("#sentence", has_text=sentence).wait_for(timeout=SEEN_MS)
    assert word in page.inner_text(".word").lower()
    if name == "stale":
        assert page.locator(".controls button:enabled").count() == page.locator("#aim-reset").count()
    every_width(page, name.replace(" ", "-"))


def test_one_of_a_thing_is_singular_and_a_fault_says_its_reason_once(
    page: Page, instrument: Instrument
) -> None:
    def lost(count: int) -> None:
        calm = instrument.run.seen.lines
        instrument.see(lines={**calm, "a": {**calm["a"], "lost": {"camera": count}}})

    def sentence(text: str) -> None:
        page.locator("#sentence", has_text=re.compile(f"^{text}$")).wait_for(timeout=SEEN_MS)

    counted = (
        "import('/static/words.js').then(({ counted }) => [0, 1, 2, 1000].map((n) => counted(n, 'line')))"
    )
    assert page.evaluate(counted) == ["0 lines", "1 line", "2 lines", "1\u202f000 lines"]
    arm(instrument)
    instrument.client.start(Path("/d/x.zarr"), lines=1)
    page.locator("#left", has_text=re.compile("^1 line$")).wait_for(timeout=SEEN_MS)
    lost(1)
    sentence("1 line was lost since the instrument was armed.")
    lost(2)
    sentence("2 lines were lost since the instrument was armed.")
    instrument.run.refuse["close"] = CameraError("camera b does not answer")
    instrument.see(fault="camera b does not answer")
    sentence("Fault: camera b does not answer; before that, 2 lines were lost.")
    page.locator("#arms .none", has_text="Disarm it, then arm it again").first.wait_for(timeout=SEEN_MS)
    instrument.client.disarm()
    sentence("2 lines were lost in the previous run.")
    assert "available now" not in page.inner_text("#now"), "there are no rings any more"


def test_a_loss_stays_until_it_is_acknowledged(page: Page, instrument: Instrument) -> None:
    lose(instrument)
    page.wait_for_selector("body[data-level=lost]", timeout=SEEN_MS)
    instrument.run.see(recording=False, done=True)
    instrument.client.stop()
    instrument.client.disarm()
    page.wait_for_selector("body[data-state=idle][data-level=lost]", timeout=SEEN_MS)
    assert page.inner_text("#lost") == "246"
    page.click("#acknowledge")
    page.wait_for_selector("body[data-state=idle][data-level=idle]", timeout=SEEN_MS)


def test_the_reason_why_there_is_no_picture_is_shown_in_its_place(
    page: Page, instrument: Instrument, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shape = RingShape(slots=8, rows=4, width=8, dtype="uint16")
    gone = {arm: (str(tmp_path / f"ring-{arm}"), shape) for arm in ("a", "b")}
    monkeypatch.setattr(instrument.run, "ring_places", lambda: gone)
    arm(instrument)
    page.wait_for_selector("#arms p.none:has-text('No picture: the lines cannot be read')", timeout=SEEN_MS)
    words = page.inner_text("#arms")
    assert words.count("ring-a: No such file or directory") == 2, "of both arms: they are read together"
    assert "run as the daemon's user" in words
    page.goto(page.url.partition("#")[0] + "#/aim")
    page.wait_for_selector("#aim-view p.none:has-text('No picture')", timeout=SEEN_MS)
    assert "brightest value of each pixel, in\u00a0% of white" in page.inner_text("#aim-view .axis")
    instrument.client.disarm()
    page.wait_for_selector("#aim-view p.none:has-text('No lines: arm the instrument')", timeout=SEEN_MS)


def test_health_has_latencies_and_the_end_of_the_log(
    page: Page, instrument: Instrument, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = {"info": "idle → armed (arm)", "warning": "the disk is <b>slow</b>", "error": "start: refused"}
    texts["debug"] = f"a viewer must not have {instrument.server.operator} of somebody's mark"
    now = datetime.now(UTC)
    entries = [KeptEntry(now, level, text) for level, text in texts.items()] * 12
    monkeypatch.setattr("acquire.daemon.local.latest_entries", lambda: entries)
    page.keyboard.press("4")
    page.locator("#log li", has_text="! warning the disk is <b>slow</b>").first.wait_for(timeout=SEEN_MS)
    assert page.locator("#log li", has_text="✗ error start: refused").count() == 12
    assert page.locator("#log li").first.inner_text().endswith("a viewer must not have … of somebody's mark")
    latencies = page.locator("#latencies")
    assert latencies.inner_text().count("– (not armed)") == 3
    record(instrument)
    instrument.see(
        trigger={"clock_hz": 1, "uncertainty_ns": 1, "pulses": 9, "silent_s": 0.4}, path="/d/x.zarr"
    )
    found = re.compile(r"none has come yet.*[\d.]+.m?s ago; 10.000 recorded lines .*0\.4.s ago", re.DOTALL)
    latencies.filter(has_text=found).wait_for(timeout=SEEN_MS)
    every_width(page, "health")


def every_width(page: Page, name: str) -> None:
    """Nothing reaches beyond the screen, in both themes."""
    for theme in ("light", "dark"):
        page.emulate_media(color_scheme=theme)  # type: ignore[arg-type]
        for width in WIDTHS:
            page.set_viewport_size({"width": width, "height": 900})
            wide = page.evaluate("document.documentElement.scrollWidth")
            assert wide <= width, f"{name} is {wide} px wide where {width} are to be had"
            assert page.is_visible("#left"), "what is left is read at a glance, on a telephone as well"
            if SCREENSHOTS:
                page.screenshot(path=Path(SCREENSHOTS) / f"{name}-{theme}-{width}.png", full_page=True)


def test_all_can_be_reached_and_done_by_key(page: Page, instrument: Instrument) -> None:
    page.keyboard.press("?")
    assert page.locator("#keys").is_visible()
    page.keyboard.press("Escape")
    for key, name in (("2", "aim"), ("3", "recordings"), ("4", "health"), ("5", "setup"), ("1", "watch")):
        page.keyboard.press(key)
        page.wait_for_selector(f"#{name}:not([hidden])")
    page.keyboard.press("a")
    page.wait_for_selector("#record:enabled", timeout=SEEN_MS)
    page.keyboard.press("r")
    page.wait_for_selector("#stop:enabled", timeout=SEEN_MS)
    page.keyboard.press("m")
    page.locator("#events", has_text="mark").wait_for(timeout=SEEN_MS)
    page.keyboard.press("s")  # a tap does not end a recording
    assert "stop" not in instrument.run.names
    page.wait_for_selector("#stop:enabled", timeout=SEEN_MS)
    page.keyboard.down("s")
    page.wait_for_selector("#disarm:enabled", timeout=SEEN_MS)
    page.keyboard.up("s")
    page.keyboard.press("d")
    page.wait_for_selector("body[data-state=idle]", timeout=SEEN_MS)


def test_keys_work_on_every_screen(page: Page, instrument: Instrument) -> None:
    """A recording is stopped from wherever one is."""
    record(instrument)
    page.focus("#glimpse-on")  # a box that was ticked keeps the focus, and takes no letters
    page.keyboard.press("3")
    page.wait_for_selector("#recordings:not([hidden])")
    page.wait_for_selector("#stop:enabled", state="attached", timeout=SEEN_MS)
    page.keyboard.down("s")
    until(lambda: "stop" in instrument.run.names)
    page.keyboard.up("s")


def test_a_wrong_clock_of_the_viewer_has_no_influence(browser: Browser, instrument: Instrument) -> None:
    with contextlib.closing(browser.new_context()) as context:
        context.add_init_script("const now = Date.now; Date.now = () => now() - 10800000;")
        page = context.new_page()
        page.goto(instrument.server.link)
        page.locator("#since", has_text="for ").wait_for(timeout=SEEN_MS)
        told = page.inner_text("#since").replace("\u202f", " ")
        assert re.fullmatch(r"for [\d.]+ (s|min)", told), told


def test_keyboard_focus_stays_in_place_when_a_list_changes(page: Page, instrument: Instrument) -> None:
    page.keyboard.press("4")
    page.focus("#measure")
    page.evaluate("window.held = document.activeElement")
    instrument.disk(seconds_to_full=5e5)
    until(lambda: not page.evaluate("window.held.isConnected"))
    assert page.evaluate("document.activeElement.id") == "measure"


def test_a_half_open_connection_is_replaced(browser: Browser, instrument: Instrument) -> None:
    """As after the viewer's computer has slept: it is not notified that the connection is gone."""
    with (
        contextlib.closing(Wire(instrument.server.address)) as wire,
        contextlib.closing(browser.new_context()) as context,
    ):
        page = context.new_page()
        page.goto(instrument.server.link.replace(instrument.server.address, wire.address))
        page.wait_for_selector("#arm:enabled", timeout=SEEN_MS)
        wire.cut()
        page.wait_for_selector("body[data-stale]", timeout=SEEN_MS)
        page.wait_for_selector("body:not([data-stale]) #arm:enabled", timeout=SEEN_MS)


def test_every_element_has_an_accessible_name(page: Page) -> None:
    unnamed = page.evaluate(
        """[...document.querySelectorAll("button, input, select, a, canvas, section, dialog")].filter((one) =>
           !(one.getAttribute("aria-label") || one.getAttribute("aria-labelledby") ||
             one.textContent.trim() || one.labels?.length)).map((one) => one.outerHTML)"""
    )
    assert unnamed == []
    assert page.get_attribute("#error", "role") == "alert"
    assert page.get_attribute("#told", "aria-live") == "polite"


def test_a_refusal_is_shown_with_the_daemons_message(page: Page, instrument: Instrument) -> None:
    instrument.run.refuse["arm"] = CameraError("camera b is not plugged in", hint="plug it in")
    page.keyboard.press("a")
    page.locator("#error", has_text="camera b is not plugged in").wait_for(timeout=SEEN_MS)
    assert "try: plug it in" in page.inner_text("#error")
    refused = page.request.get(f"{instrument.server.address}api/nothing").json()
    assert refused["message"].startswith("the page's server cannot answer GET /api/nothing: ")
    assert refused["possible"] == "/api/openapi.json"


def test_a_key_without_effect_is_explained(browser: Browser, instrument: Instrument) -> None:
    """Before the page is connected, in another state, while the daemon is busy, and without a daemon."""
    error = "#error:not([hidden])"
    with contextlib.closing(browser.new_context()) as context:
        page = context.new_page()
        held: list[Route] = []
        page.route("**/api/session", lambda route: held.append(route))  # noqa: PLW0108 - it is wrapped
        page.goto(instrument.server.link)
        assert page.locator(".controls button[aria-keyshortcuts]:enabled").count() == 0
        page.keyboard.press("a")
        page.locator(error, has_text="cannot arm: the page is still connecting").wait_for(timeout=SEEN_MS)
        held[0].continue_()
        page.wait_for_selector("#arm:enabled", timeout=SEEN_MS)
        assert page.is_hidden("#error")  # out of date
        page.keyboard.press("m")
        page.locator(error, has_text="cannot mark while idle; possible: arm").wait_for(timeout=SEEN_MS)
        instrument.run.may_arm.clear()
        page.keyboard.press("a")
        page.locator("#since", has_text="arm").wait_for(timeout=SEEN_MS)
        page.keyboard.press("d")
        page.locator(error, has_text="cannot disarm while the daemon is busy: arm").wait_for(timeout=SEEN_MS)
        instrument.run.may_arm.set()
        page.wait_for_selector("#record:enabled", timeout=SEEN_MS)
        instrument.close()
        page.wait_for_selector("body[data-stale]", timeout=SEEN_MS)
        page.keyboard.press("s")
        page.locator(error, has_text="cannot stop: The page's server cannot reach the daemon").wait_for(
            timeout=SEEN_MS
        )
    assert instrument.run.names == ["arm"]


def test_a_viewer_may_look_and_a_stranger_must_log_in(browser: Browser, instrument: Instrument) -> None:
    with contextlib.closing(browser.new_context()) as context:
        page = context.new_page()
        page.goto(instrument.server.address)
        page.wait_for_selector("#enter[open]", timeout=SEEN_MS)
        page.fill("#token", "wrong")
        page.keyboard.press("Enter")
        page.locator("#enter-error", has_text="token is wrong").wait_for(timeout=SEEN_MS)
        page.fill("#token", instrument.server.viewer)
        page.keyboard.press("Enter")
        page.wait_for_selector("#enter:not([open])", state="attached", timeout=SEEN_MS)
        page.wait_for_selector("body[data-state=idle]", timeout=SEEN_MS)
        assert page.is_disabled("#arm")
        assert page.is_disabled("#examine")
        page.keyboard.press("a")
        page.locator("#error", has_text="logged in as a viewer").wait_for(timeout=SEEN_MS)
        assert instrument.server.viewer not in page.url
        (cookie,) = context.cookies()
        assert (cookie["httpOnly"], cookie["sameSite"]) == (True, "Strict")
        assert instrument.server.viewer not in str(cookie)
    log = instrument.server.log.read_text()
    assert "logged in from 127.0.0.1" in log
    assert instrument.server.viewer not in log


def test_a_logged_in_user_is_not_asked_again(browser: Browser, instrument: Instrument) -> None:
    """The answer to a request from before the log-in arrives after it."""
    with contextlib.closing(browser.new_context()) as context:
        page = context.new_page()
        held: list[Route] = []
        page.goto(instrument.server.address)
        page.wait_for_selector("#enter[open]", timeout=SEEN_MS)
        with page.expect_request("**/api/live*", timeout=SEEN_MS):
            page.route("**/api/live*", lambda route: held.append(route), times=1)  # noqa: PLW0108 - wrapped
        page.fill("#token", instrument.server.operator)
        page.keyboard.press("Enter")
        page.wait_for_selector("#enter:not([open])", state="attached", timeout=SEEN_MS)
        with page.expect_request("**/api/live*", timeout=SEEN_MS):
            held[0].fulfill(status=401)
        page.wait_for_selector("#enter:not([open])", state="attached", timeout=SEEN_MS)
        page.wait_for_selector("#arm:enabled", timeout=SEEN_MS)


def test_nothing_is_loaded_from_elsewhere(browser: Browser, instrument: Instrument) -> None:
    asked: list[str] = []
    with contextlib.closing(browser.new_context()) as context:
        page = context.new_page()
        page.on("request", lambda request: asked.append(request.url))
        page.goto(instrument.server.link)
        page.wait_for_selector("body[data-state=idle]", timeout=SEEN_MS)
        for key in "2345":
            page.keyboard.press(key)
    assert len(asked) > 10
    assert [url for url in asked if not url.startswith((instrument.server.address, "data:"))] == []


HIDDEN = """
let state = "hidden";
Object.defineProperty(document, "visibilityState", { get: () => state });
window.show = () => { state = "visible"; document.dispatchEvent(new Event("visibilitychange")); };
"""
"""A browser without a window shows all its tabs: what it would say of those that are behind others."""
TABS = 10


def test_ten_tabs_are_served_and_each_is_live_once_it_is_seen(
    browser: Browser, instrument: Instrument
) -> None:
    context = browser.new_context()
    first = context.new_page()
    first.goto(instrument.server.link)
    first.wait_for_selector("#arm:enabled", timeout=SEEN_MS)
    tabs = [context.new_page() for _ in range(TABS - 1)]
    refused: list[str] = []
    for tab in tabs:
        tab.add_init_script(HIDDEN)
        tab.on("response", lambda one: one.status == 429 and refused.append(one.url))
        tab.goto(instrument.server.address, wait_until="commit")  # all at once, as a session is restored
    for tab in tabs:
        tab.wait_for_selector("#arm:enabled", timeout=SEEN_MS)
    arm(instrument)
    for tab in [first, *tabs]:
        until(lambda tab=tab: tab.title().startswith("ARMED"))
    with tabs[-1].expect_request(lambda one: "pictures=true" in one.url, timeout=SEEN_MS):
        tabs[-1].evaluate("window.show()")
    tabs[-1].click("#disarm")
    until(lambda: first.title().startswith("IDLE"))
    context.close()
    assert refused == []
