"""The one exception of our own."""

import re

_LONGEST = 1000  # characters of a message
_NO_LINE = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029]")  # what ends a line or does not show


class DataError(Exception):
    """Input that cannot be used; the message is one line: where, what was expected, what was found.

    What it quotes of files may be anything: control characters are escaped, and what is long is cut.

    >>> print(DataError("a.json: expected a name, got 'b\\nc'"))
    a.json: expected a name, got 'b\\nc'
    """

    def __init__(self, message: str):
        line = _NO_LINE.sub(lambda found: ascii(found[0])[1:-1], message)
        super().__init__(line if len(line) <= _LONGEST else f"{line[:_LONGEST]} ...")
