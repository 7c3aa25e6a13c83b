"""Numbers as screens and pages write them: an estimate never has digits that its uncertainty makes meaningless."""

import re

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mwdcal.presentation.numbers import contribution, estimate


def value_of(text):
    """The number that a text stands for."""
    mantissa, _, power = text.replace("−", "-").partition("×10")
    raised = dict(zip("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789", strict=True))
    return float(mantissa) * 10.0 ** int("".join(raised[c] for c in power) or 0)


@given(
    st.floats(-1e5, 1e5).map(lambda v: v if abs(v) > 1e-30 else 0.0),
    st.integers(-12, 4),
    st.floats(1.0, 9.9),
)
def test_an_estimate_is_rounded_to_two_digits_of_its_uncertainty(value, power, mantissa):
    sd = mantissa * 10.0**power
    first, second = (value_of(each) for each in estimate(value, sd).split(" ± "))
    assert abs(first - value) <= 0.051 * sd + 1e-12 * abs(value)
    assert abs(second - sd) <= 0.051 * sd
    assert "e" not in estimate(value, sd)


def test_rounding_residue_of_a_fit_is_printed_as_zero():
    assert re.fullmatch(r"0\.0+ ± 0\.000020 g", estimate(-4.5e-21, 2e-5, "g"))
    assert estimate(-9e-14, 30.0, "nT") == "0 ± 30 nT"


@given(st.floats(1e-6, 1e3), st.floats(1e-20, 1.0))
def test_a_contribution_below_a_thousandth_is_zero(combined, share):
    text = contribution(share * combined, combined)
    if share < 0.999e-3:
        assert text == "0"
    elif share > 1.001e-3:
        np.testing.assert_allclose(value_of(text), share * combined, rtol=0.051)


def test_many_degrees_of_freedom_are_no_power_of_ten():
    from types import SimpleNamespace

    from mwdcal.presentation.verification import freedom

    for value, shown in (
        (2961.4, "2960"),
        (7.0, "7"),
        (139.2, "139"),
        (60.24, "60.2"),
        (None, "∞"),
    ):
        assert freedom(SimpleNamespace(uncertainty=1.0, degrees_of_freedom=value)) == shown
