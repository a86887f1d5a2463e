"""Drivers of other distributions that give back something else, or fail, are named."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from acquire.camera.base import CameraBlock, CameraIdentity
from acquire.camera.checked import checked_opener
from acquire.camera.variant import CameraVariant
from acquire.clock import ClockFit
from acquire.config import load_rig
from acquire.errors import CameraError, TriggerError, UsageError
from acquire.plugins import CAMERAS, TRIGGERS, Group
from acquire.rig import Rig
from acquire.sim.drivers import SimulatedTrigger
from acquire.stream.tag_feed import TagFeed
from acquire.trigger.base import TriggerIdentity
from acquire.trigger.checked import open_checked
from acquire.trigger.variant import TriggerVariant

WHOSE = "trigger driver 'bench-clock' of lab-clock 2.1"


class ItsTrigger:
    """Right in every answer."""

    def identify(self):
        return TriggerIdentity("clock", "1", "0", 10**6)

    def prepare(self, run):
        """Take any run."""

    def start(self):
        return ClockFit(10**6, 0, 1)

    def tags(self, timeout_s):
        return []

    def events(self):
        return []

    def stop(self):
        return 7

    def statistics(self):
        return {"pulses": 7, "tags": 0}

    def close(self):
        """Have nothing to close."""


class ItsDriver(TriggerVariant):
    def open(self, config, bench):
        return made.trigger


class ItsCameras(CameraVariant):
    def opener(self, config, arm, bench):
        return made.opener


made = SimpleNamespace(trigger=None, opener=None)


def its_trigger(**answers):
    made.trigger = ItsTrigger()
    for name, answer in answers.items():
        setattr(made.trigger, name, lambda *_, answer=answer: answer)
    return open_checked(WHOSE, ItsDriver(), None, None)


def test_a_trigger_that_answers_rightly_is_used_as_it_is():
    trigger = its_trigger()
    assert (trigger.stop(), trigger.tags(0.0), trigger.start().clock_hz) == (7, [], 10**6)
    assert trigger.identify().model == "clock"


@pytest.mark.parametrize("found", [None, 3, object()])
def test_a_driver_that_opens_no_trigger_is_named(found):
    made.trigger = found
    with pytest.raises(UsageError, match=f"{WHOSE} gave back .* from open") as refused:
        open_checked(WHOSE, ItsDriver(), None, None)
    assert "identify, prepare, start" in refused.value.possible
    assert refused.value.hint


@pytest.mark.parametrize(
    ("name", "answer", "wanted"),
    [
        ("identify", None, "a TriggerIdentity"),
        ("start", None, "a ClockFit"),
        ("start", 12, "a ClockFit"),
        ("tags", None, "a list of LineTag"),
        ("tags", [1], "a list of LineTag"),
        ("events", None, "a list of TagEvent"),
        ("stop", None, "the number of pulses"),
        ("statistics", None, "a dictionary"),
    ],
)
def test_a_trigger_that_gives_back_something_else_is_named(name, answer, wanted):
    call = getattr(its_trigger(**{name: answer}), name)
    with pytest.raises(UsageError, match=f"{WHOSE} gave back .* from {name}") as refused:
        call(*[0.0] * (name == "tags"))
    assert refused.value.possible.startswith(wanted)


def test_a_trigger_that_fails_is_named_and_its_own_refusals_stay():
    trigger = its_trigger()

    def fail():
        raise KeyError("port")

    def refuse():
        raise TriggerError("it does not lock", hint="wait")

    made.trigger.start, made.trigger.stop = fail, refuse
    with pytest.raises(TriggerError, match=f"{WHOSE} failed in start: KeyError: 'port'"):
        trigger.start()
    with pytest.raises(TriggerError, match=r"^it does not lock; try: wait$"):
        trigger.stop()


@pytest.mark.parametrize("name", ["tags", "events", "statistics"])
def test_a_wrong_answer_during_a_run_is_a_fault_that_ends_the_reading_of_tags(name):
    """The thread that supervises a run ended with it, and with that thread the recording's other guards."""
    faults = []
    ring = SimpleNamespace(shape=SimpleNamespace(rows=8))
    feed = TagFeed(its_trigger(**{name: None}), ring, {}, report=print, fail=faults.append)
    for _ in range(2):
        assert feed.take(0.0) == []
        feed.query(10.0)
    (fault,) = faults
    assert fault.startswith(f"trigger: {WHOSE} gave back None from {name}")


def test_a_driver_without_a_transport_is_named():
    class Lost(SimulatedTrigger):
        def transport(self, config, bench):
            return None

    config = load_rig("rig-demo.toml")
    with pytest.raises(UsageError, match=r"trigger driver 'simulated' gave back None from transport"):
        Lost().open(config, None)


CAMERA = "camera driver 'bench-eye' of lab-eye 0.2"
GOOD = CameraBlock(0, np.zeros((2, 3), np.uint8), np.zeros(2, np.uint16))


class ItsCamera:
    """One that answers as it is told."""

    def __init__(self, **answers):
        for name in ("identify", "settings", "next_block", "statistics", "arm", "release", "disarm", "close"):
            setattr(self, name, partial(self._answer, answers.get(name)))

    @staticmethod
    def _answer(answer, *_):
        return answer


def opened(**answers):
    made.opener = lambda: ItsCamera(**answers)
    return checked_opener(CAMERA, ItsCameras(), None, "a", None)()


@pytest.mark.parametrize(
    ("name", "answer", "wanted"),
    [
        ("identify", None, "a CameraIdentity"),
        ("settings", [], "a dictionary"),
        ("next_block", b"lines", "None, or a CameraBlock"),
        ("next_block", replace(GOOD, pixels=[[1, 2, 3]]), "None, or a CameraBlock"),
        ("next_block", replace(GOOD, first_line=None), "None, or a CameraBlock"),
        ("next_block", replace(GOOD, losses=(3,)), "None, or a CameraBlock"),
        ("statistics", None, "a dictionary"),
    ],
)
def test_a_camera_that_gives_back_something_else_is_named(name, answer, wanted):
    with pytest.raises(UsageError, match=f"{CAMERA} gave back .* from {name}") as refused:
        getattr(opened(**{name: answer}), name)(*[0.1] * (name == "next_block"))
    assert refused.value.possible.startswith(wanted)


def test_a_camera_that_answers_rightly_is_used_as_it_is():
    identity = CameraIdentity("lab", "eye", "1", "0")
    camera = opened(identify=identity, next_block=GOOD)
    assert camera.identify() is identity
    assert camera.next_block(0.1) is GOOD
    assert camera.release(GOOD) is None
    assert opened().next_block(0.1) is None


def test_a_driver_that_opens_no_camera_is_named():
    made.opener = None
    with pytest.raises(UsageError, match=f"{CAMERA} gave back None from opener"):
        checked_opener(CAMERA, ItsCameras(), None, "a", None)
    made.opener = dict
    with pytest.raises(UsageError, match=rf"{CAMERA} gave back {{}} from its opener") as refused:
        checked_opener(CAMERA, ItsCameras(), None, "a", None)()
    assert "next_block" in refused.value.possible
    made.opener = lambda: 1 // 0
    with pytest.raises(CameraError, match=f"{CAMERA} failed in its opener: ZeroDivisionError"):
        checked_opener(CAMERA, ItsCameras(), None, "a", None)()


def test_its_opener_can_be_given_to_another_process():
    made.opener = dict
    found = checked_opener(CAMERA, ItsCameras(), None, "a", None)
    assert pickle.loads(pickle.dumps(found)) == found


def test_a_rig_asks_drivers_of_others_and_not_ours(monkeypatch):
    config = load_rig("rig-demo.toml")
    assert (TRIGGERS.whose("simulated"), CAMERAS.whose("simulated")) == ("", "")
    monkeypatch.setattr(Group, "whose", lambda group, name: f"{group.what} {name!r} of lab 1")
    with Rig(config) as rig:
        assert {opener.whose for opener in rig.openers().values()} == {"camera driver 'simulated' of lab 1"}
        rig.openers()["a"]().close()
