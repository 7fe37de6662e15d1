"""What a check of data says: facts, findings, and the notes of loaders."""

from collections.abc import Iterable, Mapping
from typing import Literal, NamedTuple

Severity = Literal["ok", "warning", "error"]


class Fact(NamedTuple):
    """Something measured: in words, and as numbers for programs."""

    name: str
    text: str
    numbers: Mapping[str, float | str]


class Finding(NamedTuple):
    """The outcome of a test; unless it is ok, with what was expected and what mends it."""

    severity: Severity
    test: str
    found: str
    expected: str = ""
    fix: str = ""

    def __str__(self) -> str:
        if self.severity == "ok":
            return self.found
        return f"expected {self.expected}, got {self.found}" + (f"; {self.fix}" if self.fix else "")


class Checked(NamedTuple):
    """All that was found about a set of data, or about a part of it."""

    facts: tuple[Fact, ...] = ()
    findings: tuple[Finding, ...] = ()
    notes: tuple[str, ...] = ()


def join(parts: Iterable[Checked]) -> Checked:
    """Everything that the parts say, in their order."""
    parts = tuple(parts)
    return Checked(
        tuple(fact for part in parts for fact in part.facts),
        tuple(finding for part in parts for finding in part.findings),
        tuple(note for part in parts for note in part.notes),
    )


def unusable(error: Exception) -> Checked:
    """A loader's refusal, which says itself what it expected, as a finding."""
    where, _, rest = " ".join(str(error).split()).partition(": expected ")
    expected, _, found = rest.partition(", got ")
    if not found:
        return Checked((), (Finding("error", "reading", where, "data that can be read"),))
    return Checked((), (Finding("error", "reading", f"{found} ({where})", expected),))
