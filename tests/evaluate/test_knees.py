"""Repeats as a curve with a band, and sentences about it."""

from __future__ import annotations

import numpy as np
import pytest

from acquire.evaluate.knees import Band, band, knees, plain, sentences
from acquire.evaluate.tradeoff import Point, TradeoffRun
from acquire.recon.segments import Voxels


def run(*answers: tuple[float, float], ended: str = "converged", repeat: int = 0) -> TradeoffRun:
    points = tuple(
        Point(number, seconds, seconds / 2, psnr_db=value) for number, (seconds, value) in enumerate(answers)
    )
    return TradeoffRun("admm", Voxels(3, 1), "float32", 9, points, ended=ended, repeat=repeat)


def curve(*values: float) -> Band:
    times_s = 2.0 ** np.arange(len(values))
    middle = np.array(values)
    return Band(times_s, middle, middle, middle)


def test_a_band_spans_the_repeats_and_its_end_value_persists():
    found = band([run((1, 10), (4, 20)), run((2, 12), (4, 26), repeat=1)], "psnr_db")
    assert found.times_s[0] == 2  # from then on both have an answer
    assert (found.low[0], found.middle[0], found.high[0]) == (10, 11, 12)
    assert (found.low[-1], found.middle[-1], found.high[-1]) == (20, 23, 26)
    assert found.at(3.9) == 11
    by_processor = band([run((1, 10), (4, 20))], "psnr_db", "processor_s")
    assert by_processor.times_s[-1] == pytest.approx(2)
    assert band([run((1, 10))], "ssim") is None


def test_a_knee_is_where_doubling_the_time_stops_paying():
    (knee,) = knees(curve(10, 20, 30, 31, 31.5), ended=True)
    assert (knee.seconds, knee.value, knee.gain) == (4, 30, 1)
    first, second = knees(curve(10, 20, 20.5, 30, 31, 31), ended=True)
    assert (first.seconds, second.seconds) == (2, 8)
    assert knees(curve(10, 14, 18, 22), ended=False) == []


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (
            run((1, 10), (15, 42), (30, 47), (60, 47.2)),
            "admm, balanced: 30 s give 47 dB; the next 30 s add nothing",
        ),
        (run((1, 10), (15, 42), (40, 44)), "15 s give 42 dB; the next 15 s add nothing"),
        (run((1, 10), (15, 42), (26, 44)), "15 s give 42 dB; the rest, to 26 s, adds 2 dB"),
        (run((1, 10), (8, 42), (16, 48), ended="budget"), "cut by its time limit after 16 s with 48 dB; "),
        (run((1, 10), (8, 42), (16, 37)), "best after 8.0 s with 42 dB; continuing to 16 s loses 5 dB"),
    ],
)
def test_sentences_say_what_time_buys(made: TradeoffRun, said: str):
    assert any(said in sentence for sentence in sentences([made])), sentences([made])


def test_no_sentence_without_a_known_truth():
    points = (Point(1, 1.0), Point(2, 2.0))
    assert sentences([TradeoffRun("admm", Voxels(3, 1), "float32", 9, points)]) == []


def test_seconds_have_two_digits_and_no_exponent():
    assert [plain(each) for each in (0.0123, 0.85, 4.04, 15.4, 123.0, 4572.0)] == [
        "0.012",
        "0.85",
        "4.0",
        "15",
        "120",
        "4600",
    ]


def test_times_that_round_up_to_a_power_of_ten_have_two_digits_too():
    assert [plain(each) for each in (0.0996, 0.996, 9.96, 99.6)] == ["0.10", "1.0", "10", "100"]
