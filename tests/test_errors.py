"""What is said of bad input is one line, whatever it quotes."""

from jaxpose.errors import DataError


def test_a_message_is_one_line_of_bounded_length():
    assert str(DataError("a.txt: expected 'x', got 'y'")) == "a.txt: expected 'x', got 'y'"
    assert str(DataError("got \n\x1b[2J\u2028 é")) == r"got \n\x1b[2J\u2028 é"
    long = str(DataError("a.txt: got " + "9" * 5000))
    assert long.startswith("a.txt: got 99") and len(long) < 1100
