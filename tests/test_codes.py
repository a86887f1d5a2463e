"""The exposure code against the shift register bit by bit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acquire.codes import TAPS, ConstantCode, ListedCode, PrbsCode, code_from_attrs, mix_seed, prbs
from acquire.config import PrbsConfig
from acquire.errors import UsageError


def register(degree: int, seed: int, length: int) -> np.ndarray:
    """The Galois register, one clock at a time."""
    mask = sum(1 << (tap - 1) for tap in TAPS[degree])
    state, bits = seed, []
    for _ in range(length):
        bit = state & 1
        bits.append(bit)
        state >>= 1
        if bit:
            state ^= mask
    return np.array(bits, np.uint8)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(sorted(TAPS)), st.integers(0, 2**70), st.integers(0, 3000), st.integers(0, 2000))
def test_any_stretch_equals_the_register(degree: int, number: int, start: int, length: int) -> None:
    seed = mix_seed(number, degree)
    np.testing.assert_array_equal(
        prbs(degree, seed, start, length), register(degree, seed, start + length)[start:]
    )


@pytest.mark.parametrize("degree", range(3, 17))
def test_period_is_maximal(degree: int) -> None:
    period = 2**degree - 1
    bits = prbs(degree, 1, 0, 2 * period)
    np.testing.assert_array_equal(bits[:period], bits[period:])
    assert bits[:period].sum() == 2 ** (degree - 1)
    windows = np.lib.stride_tricks.sliding_window_view(bits[: period + degree - 1], degree)
    assert len(np.unique(windows @ (1 << np.arange(degree)))) == period


@pytest.mark.parametrize("degree", [d for d in TAPS if d > 16])
def test_jump_lands_where_a_full_period_ends(degree: int) -> None:
    seed, period = mix_seed(5, degree), 2**degree - 1
    np.testing.assert_array_equal(prbs(degree, seed, period, 200), prbs(degree, seed, 0, 200))
    far = 10**11
    np.testing.assert_array_equal(prbs(degree, seed, far, 300)[100:], prbs(degree, seed, far + 100, 200))


@given(st.integers(0, 10**6), st.sampled_from(sorted(TAPS)))
def test_mixed_seeds_are_states(number: int, degree: int) -> None:
    assert 0 < mix_seed(number, degree) < 1 << degree


def test_small_numbers_give_balanced_codes() -> None:
    for number in range(20):
        assert 0.35 < prbs(64, mix_seed(number, 64), 0, 300).mean() < 0.65


def test_light_is_off_before_the_run() -> None:
    code = PrbsCode(15, 77)
    np.testing.assert_array_equal(code.bits(-5, 12), np.r_[np.zeros(5), prbs(15, 77, 0, 7)])
    np.testing.assert_array_equal(ConstantCode(1).bits(-2, 4), [0, 0, 1, 1])
    np.testing.assert_array_equal(code.bits(-9, 4), np.zeros(4))


@pytest.mark.parametrize("code", [PrbsCode(64, 2**64 - 3), PrbsCode(7, 1), ConstantCode(0), ConstantCode(1)])
def test_attributes_regenerate_the_code(code: PrbsCode | ConstantCode) -> None:
    assert code_from_attrs(code.to_attrs()) == code


def test_a_recorded_seed_is_the_number_that_was_given() -> None:
    attrs = PrbsConfig(seed=7).build().to_attrs()
    assert attrs["seed"] == 7
    assert PrbsConfig(seed=attrs["seed"]).build() == code_from_attrs(attrs)
    assert code_from_attrs(attrs).to_attrs() == attrs


def test_a_state_of_format_1_is_read_although_it_was_called_seed() -> None:
    attrs = PrbsConfig(seed=7).build().to_attrs()
    old = {name: attrs[name] for name in ("kind", "degree", "taps", "start")} | {"seed": attrs["state"]}
    found = code_from_attrs(old)
    assert found == code_from_attrs(attrs)
    assert "seed" not in found.to_attrs()


def test_refusals() -> None:
    with pytest.raises(UsageError, match="degree 40"):
        prbs(40, 1, 0, 10)
    with pytest.raises(UsageError, match="state"):
        prbs(7, 128, 0, 10)
    with pytest.raises(UsageError, match="state"):
        prbs(7, 0, 0, 10)
    with pytest.raises(UsageError, match="0 or more"):
        prbs(7, 1, -1, 10)
    with pytest.raises(UsageError, match="0 or 1"):
        ConstantCode(2)
    with pytest.raises(UsageError, match="kind 'gold'"):
        code_from_attrs({"kind": "gold"})
    with pytest.raises(UsageError, match="taps"):
        code_from_attrs({"kind": "prbs", "degree": 7, "taps": [7, 1], "seed": "1"})


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 1), min_size=1, max_size=40), st.booleans(), st.integers(-50, 100))
def test_listed_bits_come_back_one_by_one(listed: list[int], repeats: bool, start: int) -> None:
    code = code_from_attrs(ListedCode.of(np.array(listed, np.uint8), repeats=repeats).to_attrs())
    n = len(listed)
    expected = [listed[i % n] if i >= 0 and (repeats or i < n) else 0 for i in range(start, start + 60)]
    np.testing.assert_array_equal(code.bits(start, 60), expected)


@pytest.mark.parametrize(("digits", "length"), [("", 0), ("a", 4), ("ag", 8), ("abcd", 8), ("AB", 8)])
def test_impossible_listed_bits_are_refused(digits: str, length: int) -> None:
    with pytest.raises(UsageError, match="code"):
        ListedCode(digits, length)
