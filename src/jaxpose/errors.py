"""The one exception of our own."""


class DataError(Exception):
    """Input that cannot be used; the message is one line: where, what was expected, what was found."""
