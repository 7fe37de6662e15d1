"""The table of formats: of every registry, and the page that shows it is what the command prints."""

from pathlib import Path
from typing import get_args

import pytest
from helpers.refused import complaint

from jaxpose.cli import convert, export
from jaxpose.cli.check.command import main
from jaxpose.datasets.events import registry as event_registry
from jaxpose.datasets.photos import registry as photo_registry
from jaxpose.datasets.rgbd import registry as rgbd_registry

PAGE = Path(__file__).parents[2] / "experiments" / "formats.md"


@pytest.fixture
def table(capsys):
    main(["--formats"])
    return capsys.readouterr().out.strip()


def test_the_page_is_what_the_command_prints(table):
    assert table in PAGE.read_text(), "jaxpose check --formats prints another table than the page has"


def test_every_format_is_in_the_table(table):
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]
    assert all(len(row) == 6 for row in rows)
    by_kind = {}
    for kind, _, files, *_ in rows:
        by_kind.setdefault(kind, []).append(files.partition(":")[0])
    for kind, registry in (
        ("RGB-D", rgbd_registry),
        ("photographs", photo_registry),
        ("events", event_registry),
    ):
        assert by_kind[kind] == list(get_args(registry.Format))
    written = " ".join(row[4] for row in rows)
    for name in {*get_args(export.Format), *get_args(convert.Target)} - {"same"}:
        assert f"{name}`" in written, name
    for _, title, _, read, writer, opened in rows:
        assert read or writer, title
        assert bool(writer) == bool(opened), title
    assert "expected DATA to check, or --formats" in complaint(main)
