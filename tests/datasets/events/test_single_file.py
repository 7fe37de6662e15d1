"""Files of event cameras against writers of the vendors' layouts and kept packages, over hours."""

import importlib.util

import dv_processing as dv
import numpy as np
import pytest
from helpers import event_writers

from jaxpose.cli.check import command as check
from jaxpose.datasets.events import registry, single_file
from jaxpose.datasets.events.evt import Evt2, Evt3, Evt21, Evt21Swapped
from jaxpose.datasets.events.stream import BLOCK
from jaxpose.errors import DataError

SIZE = (640, 480)
HOUR = 3_600_000_000  # [us]


def events(count=3000, *, seed=0, pauses=(), start=0, size=SIZE, most=400):
    """Rows (t, x, y, p), runs of neighbours in a row among them; pauses as (event, us)."""
    rng = np.random.default_rng(seed)
    t = start + np.cumsum(rng.integers(0, most, count) * (rng.random(count) < 0.4))
    for event, pause in pauses:
        t[event:] += pause
    x, y = rng.integers(0, size[0] - 40, count), rng.integers(0, size[1], count)
    p = rng.integers(0, 2, count)
    for i in range(1, count):  # a run goes on in its row, and most at its time
        if rng.random() < 0.5 and t[i] == t[i - 1]:
            y[i], p[i], x[i] = y[i - 1], p[i - 1], min(x[i - 1] + rng.integers(1, 4), size[0] - 1)
    return np.column_stack([t, x, y, p]).astype(np.int64)


HEADERS = {
    "evt3": b"% camera_integrator_name Prophesee\n% evt 3.0\n% geometry 640x480\n% end\n",
    "evt2": b"% Date 2014-02-28\n% evt 2.0\n% format EVT2;height=480;width=640\n% end\n",
    "evt21": b"% evt 2.1\n% format EVT21;endianness=little;height=480;width=640\n% end\n",
    "swapped": b"% evt 2.1\n% format EVT21;endianness=legacy;height=480;width=640\n% end\n",
    "unsaid": b"% evt 2.1\n% geometry 640x480\n% end\n",
    "unsaid swapped": b"% evt 2.1\n% geometry 640x480\n% end\n",
    "dat": b"% Data file containing CD events.\n% Version 2\n% Height 480\n% Width 640\n",
    "es": b"",
}


def body(form, rows):
    if "evt3" in form:
        return event_writers.evt3(rows, every_us=4096 if rows[-1, 0] - rows[0, 0] > 1 << 22 else None)
    writers = {"evt2": event_writers.evt2, "dat": event_writers.dat}
    if form in writers:
        return writers[form](rows)
    if form == "es":
        return event_writers.es(rows, SIZE)
    return event_writers.evt21(rows, swapped="swapped" in form)


def write(folder, form, rows):
    suffix = {"dat": "dat", "es": "es"}.get(form, "raw")
    file = folder / f"recording.{suffix}"
    file.write_bytes(HEADERS[form] + body(form, rows))
    return file


def assert_same(recording, rows):
    read = recording.events
    np.testing.assert_allclose(read.t, (rows[:, 0] - rows[0, 0]) / 1e6, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(read.x, rows[:, 1])
    np.testing.assert_array_equal(read.y, rows[:, 2])
    np.testing.assert_array_equal(read.polarity, 2 * rows[:, 3] - 1)


@pytest.mark.parametrize("form", HEADERS)
def test_every_event_comes_back(tmp_path, form):
    rows = events(start=0 if form == "es" else 5_000_000)
    recording = registry.load_events(write(tmp_path, form, rows))
    assert_same(recording, rows)
    assert (recording.camera.width, recording.camera.height) == SIZE
    assert not any("left out" in note or "read as" in note for note in recording.notes)
    assert registry.find_format(tmp_path) == "file"


@pytest.mark.parametrize(
    "form, pauses",
    [
        ("evt3", [(500, 41_000_000), (2000, 20_000_000)]),  # turns of 16.8 s within pauses
        ("evt2", [(500, 3 * HOUR), (1500, HOUR), (2500, HOUR)]),  # 4.8 hours
        ("evt21", [(500, 3 * HOUR), (1500, HOUR), (2500, HOUR)]),
        ("dat", [(500, HOUR), (1500, HOUR), (2500, HOUR)]),  # 72 minutes
        ("es", [(500, HOUR // 360)]),
    ],
)
def test_clocks_that_turn_over(tmp_path, form, pauses):
    rows = events(start=0 if form == "es" else 1_000_000, pauses=pauses)
    assert_same(registry.load_events(write(tmp_path, form, rows)), rows)


def decoded(decoder, content, piece):
    """All that a decoder makes of content, given in pieces of words."""
    words = np.frombuffer(content, decoder.kind)
    blocks = [decoder.decode(words[k : k + piece]) for k in range(0, len(words), piece)]
    columns = [np.concatenate(column) for column in zip(*blocks, strict=True)]
    return np.column_stack(columns).astype(np.int64)


@pytest.mark.parametrize("piece", [1, 7, 1000])
@pytest.mark.parametrize(
    "decoder, form", [(Evt3, "evt3"), (Evt2, "evt2"), (Evt21, "evt21"), (Evt21Swapped, "swapped")]
)
def test_pieces_are_decoded_as_the_whole(decoder, form, piece):
    rows = events(300, start=16_000_000, most=9000)  # through a turn of EVT 3.0
    np.testing.assert_array_equal(decoded(decoder(), body(form, rows), piece), rows)


def test_an_hour_of_evt3_that_turns_over_every_17_seconds():
    """214 turns; the camera states its time in pauses, as cameras do."""
    rows = events(800, most=23_000_000, start=123)
    assert rows[-1, 0] > 0.9 * HOUR
    np.testing.assert_array_equal(decoded(Evt3(), body("evt3", rows), 1 << 16), rows)


def test_words_before_the_first_time_are_left_out_and_counted(tmp_path):
    rows = events(1000, start=7_000_000)
    content = np.frombuffer(body("evt3", rows), "<u2")
    early = np.array([0x6005, 0x0010, 0x2020, 0x3005, 0x4003], "<u2")  # three events without a time
    file = tmp_path / "a.raw"
    file.write_bytes(HEADERS["evt3"] + early.tobytes() + content.tobytes() + b"\x01")  # and half a word
    recording = registry.load_events(file)
    assert "3 events left out, before the first time or row of the file" in recording.notes
    assert_same(recording, rows)


@pytest.mark.parametrize("size", [None, SIZE])
def test_size_of_the_sensor(tmp_path, size):
    file = write(tmp_path, "evt2", events())
    assert single_file.find(file, size=size).camera.width == 640
    with pytest.raises(DataError, match="recording.raw: expected a sensor of 346x260, got 640x480"):
        single_file.find(file, size=(346, 260))


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("a.raw", b"% evt 4.0\n% end\n", "a.raw: expected a header with evt 2.0, 2.1 or 3.0, got evt 4.0"),
        (
            "a.raw",
            b"% evt 2.0\n% geometry " + b"9" * 5000 + b"x480\n% end\n",
            "a.raw: expected width and height of a sensor, got 99999999999999999999 x 480",
        ),
        ("a.csv", b"%geometry:0,480\n1,1,0,5\n", "a.csv: expected width and height of a sensor, got 0 x 480"),
        ("a.raw", b"", "a.raw: expected a header with evt 2.0, 2.1 or 3.0, got none"),
        ("a.raw", HEADERS["evt3"], "a.raw: expected events, got none"),
        ("a.raw", b"%" * 70000, "a.raw: expected a header of lines that begin with %"),
        ("a.dat", HEADERS["dat"] + b"\x0e\x08", r"a.dat: expected a DAT file, .*got \[14, 8\]"),
        ("a.dat", HEADERS["dat"], "a.dat: expected a DAT file, .*, got its end"),
        ("a.es", b"Event Stream\x02\x00\x00\x02", "a.es: expected .*, got version 2 of type 2"),
        ("a.es", b"Event Stream\x02", "a.es: expected an Event Stream file, .* got its end"),
        ("a.aedat", b"#!AER-DAT2.0\r\n", "a.aedat: expected AEDAT 4, got AEDAT 2.0: DV or dv-processing"),
        ("a.aedat4", b"#!AER-DAT4.0\r\n\x00\x00", "a.aedat4: expected an AEDAT 4 file, got"),
    ],
)  # fmt: skip
def test_what_cannot_be_read(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=message) as error:
        registry.load_events(tmp_path / name)
    assert "\n" not in str(error.value)


def test_memory_is_bounded_by_blocks(tmp_path):
    """However long a file, no more than a piece of it is held."""
    rows = events(2000)
    repeated = np.concatenate([rows + [k * rows[-1, 0], 0, 0, 0] for k in range(150)])
    file = tmp_path / "a.dat"
    words = [repeated[:, 0], repeated[:, 1] | (repeated[:, 2] << 14) | (repeated[:, 3] << 28)]
    file.write_bytes(HEADERS["dat"] + b"\x0c\x08" + np.column_stack(words).astype("<u4").tobytes())
    lengths = [len(block.t) for block in single_file.find(file).stream.blocks()]
    assert sum(lengths) == len(repeated) and max(lengths) <= BLOCK and len(lengths) > 2


def test_check_tells_of_a_raw_file(tmp_path):
    result = check.run(check.Config(write(tmp_path, "evt3", events())))
    assert result.format == "file of events (recording.raw)"
    assert any(fact.name == "events" and "of 640x480" in fact.text for fact in result.facts)


# --- packages that are right where they were tried ------------------------------------------------------


def test_aedat4_by_its_makers_writer(tmp_path):
    rows = events(5000, start=1_700_000_000_000_000, pauses=[(3000, 5 * HOUR)], size=(346, 260))
    file = tmp_path / "a.aedat4"
    writer = dv.io.MonoCameraWriter(str(file), dv.io.MonoCameraWriter.EventOnlyConfig("DAVIS", (346, 260)))
    store = dv.EventStore()
    for t, x, y, p in rows.tolist():
        store.push_back(t, x, y, bool(p))
    writer.writeEvents(store)
    del writer
    recording = registry.load_events(file)
    assert_same(recording, rows)
    assert (recording.camera.width, recording.camera.height) == (346, 260)
    content = file.read_bytes()
    for length in (len(content) // 2, 200, 40):
        file.write_bytes(content[:length])
        try:
            assert len(registry.load_events(file).events.t) < 5000
        except DataError as error:
            assert "a.aedat4: expected" in str(error) and "\n" not in str(error)
    file.write_bytes(content.replace(b"</node>", b"</nodf>", 1))
    with pytest.raises(DataError, match="a.aedat4: expected an AEDAT 4 file, got mismatched tag"):
        registry.load_events(file)


@pytest.mark.skipif(importlib.util.find_spec("event_stream") is None, reason="the format's own package")
def test_es_by_its_own_package(tmp_path):
    import event_stream

    rows = events(5000, pauses=[(1000, 60_000_000)])
    table = np.zeros(len(rows), event_stream.dvs_dtype)
    for name, column in zip(("t", "x", "y", "on"), rows.T, strict=True):
        table[name] = column
    table["y"] = SIZE[1] - 1 - rows[:, 2]  # the package counts rows as the file does
    with event_stream.Encoder(tmp_path / "a.es", "dvs", *SIZE) as encoder:
        encoder.write(table)
    assert_same(registry.load_events(tmp_path / "a.es"), rows)


# --- text -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "header, separator, order, scale",
    [
        ("timestamp,x,y,polarity\n", ",", "txyp", 1),
        ("x,y,polarity,timestamp [us]\n", ",", "xypt", 1),
        ("# t x y p\n", " ", "txyp", 1),
        ('"t_ns";"x";"y";"on"\n', ";", "txyp", 1000),
        ("%geometry:640,480\n", ",", "xypt", 1),
        ("", ",", "xypt", 1),
        ("", ",", "txyp", 1),
        ("frame,t,x,y,p\n", ",", "0txyp", 1),
    ],
)
def test_csv(tmp_path, header, separator, order, scale):
    rows = events(2000, start=1_000_000)
    columns = dict(zip("txyp", rows.T, strict=True)) | {"0": np.zeros(len(rows), int)}
    columns["t"] = columns["t"] * scale
    lines = [separator.join(str(columns[name][k]) for name in order) for k in range(len(rows))]
    (tmp_path / "e.csv").write_text(header + "\n".join(lines) + "\n")
    recording = registry.load_events(tmp_path / "e.csv", size=SIZE)
    assert_same(recording, rows)


def test_csv_that_cannot_be_read(tmp_path):
    file = tmp_path / "e.csv"
    for text, message in (
        ("t,x,y,p\n1,2,3,0\n2,3,4\n", "e.csv:3: expected 4 numbers .t x y p., got 3"),
        ("1,2,3,0\n2,3,4,one\n", "e.csv:2: expected 4 numbers .t x y p., got '2,3,4,one'"),
        ("a,b\n", "e.csv:1: expected 4 numbers"),
        ("t,a,x,y,p\n1,2,3,0\n", "e.csv:2: expected 4 numbers .t x y p., got '1,2,3,0'"),
        ("t,x,y,p\n", "e.csv: expected events, got none"),
        ("t,x,y,p\n1,2,3,7\n", "e.csv:2: expected polarities 0 and 1"),
    ):
        file.write_text(text)
        with pytest.raises(DataError, match=message):
            registry.load_events(file, size=SIZE)


def test_a_packet_of_aedat4_is_no_longer_than_its_file(tmp_path):
    """The package allots what a length asks for, and panics, which is no Exception, where text is none."""
    options = dv.io.MonoCameraWriter.EventOnlyConfig("DAVIS", (346, 260))
    writer, store = dv.io.MonoCameraWriter(str(tmp_path / "a.aedat4"), options), dv.EventStore()
    for t, x, y, p in events(50, start=1_700_000_000_000_000, size=(346, 260)).tolist():
        store.push_back(t, x, y, bool(p))
    writer.writeEvents(store)
    del writer
    content = (tmp_path / "a.aedat4").read_bytes()
    at = 14 + 4 + int.from_bytes(content[14:18], "little") + 4  # the length of the first packet
    damaged = content[:at] + b"\xff\xff\xff\x7f" + content[at + 4 :]
    middle = content.index(b"<")
    place = 18 + int.from_bytes(content[18:22], "little") + 12  # of where packets end
    packets_end = int.from_bytes(content[place : place + 8], "little")
    assert at < packets_end < len(content)
    ends = [content[:place] + n.to_bytes(8, "little") + content[place + 8 :] for n in (46, packets_end - 3)]
    for k, bad in enumerate((damaged, content[:middle] + b"\xff" + content[middle + 1 :], *ends)):
        (tmp_path / f"{k}.aedat4").write_bytes(bad)
        with pytest.raises(DataError, match=f"{k}.aedat4: expected an AEDAT 4 file, got") as error:
            registry.load_events(tmp_path / f"{k}.aedat4")
        assert "\n" not in str(error.value)


def test_the_layout_of_evt21_is_found_in_a_file_that_ends_within_a_word(tmp_path):
    file = write(tmp_path, "unsaid", events(50))
    file.write_bytes(file.read_bytes()[:-3])
    assert len(registry.load_events(file, size=SIZE).events.t) >= 40
