"""How a command refuses what it was asked."""

import pytest


def complaint(main, *args) -> str:
    """The one line that a command leaves on stderr, with exit code 1."""
    with pytest.raises(SystemExit) as stop:
        main([str(arg) for arg in args])
    assert isinstance(stop.value.code, str)  # printed on stderr, exit code 1
    assert "\n" not in stop.value.code
    return stop.value.code
