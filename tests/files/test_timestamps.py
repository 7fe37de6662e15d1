"""Timestamps as files write them, against exact fractions."""

from fractions import Fraction

import pytest

from jaxpose.files.tables import read_numbers, read_stamped
from jaxpose.files.timestamps import to_stamps

WORDS = [
    "0", "-1.5", "1403636580.863555584", "1403636580.8635555840001", ".5", "7.", "+3", "1e3", "2.5E-7",
    "0.0000000005", "0.0000000015", "-0.0000000015", "12_3.5", "5e-324", "9999999999999999999", "\u0663.25",
]  # fmt: skip


@pytest.mark.parametrize("words", [[word] for word in WORDS] + [WORDS, WORDS[:3], ["1.25", "1.5", "2"]])
@pytest.mark.parametrize(("unit", "per_second"), [("s", 1), ("ms", 10**3), ("us", 10**6), ("ns", 10**9)])
def test_timestamps_are_exact(words, unit, per_second):
    stamps, t0_ns = to_stamps(words), 1403636580863555584
    exact = [Fraction(word.replace("_", "").replace("\u0663", "3").removesuffix(".")) for word in words]
    assert [Fraction(number, 10**stamps.digits) for number in stamps.whole] == exact
    assert stamps.ns(unit) == [round(number * 10**9 / per_second) for number in exact]
    assert stamps.since(t0_ns, unit).tolist() == [
        float(number / per_second - Fraction(t0_ns, 10**9)) for number in exact
    ]


@pytest.mark.parametrize("word", ["", "nan", "inf", "x", "1.5.2", "--1", "1e19", "-1e19", "9" * 5000])
def test_what_no_clock_shows_is_no_timestamp(word):
    with pytest.raises(ValueError):
        to_stamps(["1.5", word])


def test_lines_that_need_a_look_of_their_own_give_the_same_numbers(tmp_path):
    rows = "1 0.5 -2e3\n2 inf 1\n3 7 8\n" + "".join(f"{k} {k} {k}\n" for k in range(4, 100))
    (tmp_path / "a.txt").write_text(rows)
    (tmp_path / "b.txt").write_text(rows.replace("3 7 8", "3 7 0_8 ", 1))  # a number to Python only
    for read in (
        lambda file: read_numbers(file, "3 numbers", (3,), finite=False)[1].tolist(),
        lambda file: read_stamped(file, "3 numbers", 3, unit="s"),
    ):
        a, b = read(tmp_path / "a.txt"), read(tmp_path / "b.txt")
        assert str(a) == str(b)
    assert b.lines[:2] == [1, 3] and b.missing == (2,) and b.values[:2].tolist() == [[0.5, -2000], [7, 8]]
