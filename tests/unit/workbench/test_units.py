import pytest
from hypothesis import given
from hypothesis import strategies as st

from workbench.errors import InputError
from workbench.units import cm, duration_s, exposure_text, length_mm, seconds_text


@pytest.mark.parametrize(
    ("text", "mm"),
    [("60cm", 600.0), ("0.6 m", 600.0), ("4.3um", 0.0043), ("4.3 µm", 0.0043), ("7mm", 7.0), (" 1e3 mm ", 1000.0)],
)
def test_lengths_are_read_with_their_unit(text: str, mm: float) -> None:
    assert length_mm(text) == pytest.approx(mm)


def test_a_bare_number_takes_the_default_unit_or_is_refused() -> None:
    assert length_mm("60", default_unit="cm") == 600.0
    with pytest.raises(InputError, match="no unit"):
        length_mm("60")


@pytest.mark.parametrize("text", ["", "cm", "60 parsec", "6 0cm", "1,5cm", True, None, [1], "nan cm", "inf"])
def test_what_is_no_length_is_refused_by_name(text: object) -> None:
    with pytest.raises(InputError):
        length_mm(text, default_unit="cm")


def test_times_are_read_as_photographers_write_them() -> None:
    assert duration_s("1/125 s") == pytest.approx(0.008)
    assert duration_s("20ms") == pytest.approx(0.02)
    with pytest.raises(InputError):
        duration_s("1/0 s")


@given(st.floats(min_value=1, max_value=1e5))
def test_centimetres_read_back_as_written(depth_mm: float) -> None:
    assert length_mm(cm(depth_mm, 4)) == pytest.approx(depth_mm, abs=1e-3)


def test_texts_for_people() -> None:
    assert exposure_text(0.008) == "1/125 s"
    assert exposure_text(2.5) == "2.5 s"
    assert seconds_text(75) == "1 min 15 s"
    assert cm(float("nan")) == "-"
