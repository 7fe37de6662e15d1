"""Event files word by word, as the vendors document them, without the decoders of the package."""

import struct

import numpy as np


def evt3(events, *, every_us=None):
    """Words of EVT 3.0, event by event: whatever changes is stated; vectors where x goes on from the last.

    `events` are rows (t, x, y, p); with `every_us` the camera says its time that often, in pauses too, as
    real ones do.
    """
    words, high, low, y = [], None, None, None
    clock = int(events[0][0]) >> 12

    def say_time(t):
        nonlocal high, low
        if t >> 12 != high:
            high, low = t >> 12, None
            words.append(0x8000 | (high & 0xFFF))
        if t & 0xFFF != low:
            low = t & 0xFFF
            words.append(0x6000 | low)

    i = 0
    while i < len(events):
        t, x, row, p = map(int, events[i])
        if every_us:
            while (clock + 1) << 12 <= t:
                clock += max(every_us >> 12, 1)
                say_time(min(clock << 12, t))
        say_time(t)
        if row != y:
            y = row
            words.append(y)
        run = [x]
        while i + len(run) < len(events):
            t2, x2, y2, p2 = map(int, events[i + len(run)])
            if (t2, y2, p2) != (t, row, p) or not run[-1] < x2 < x + 32:
                break
            run.append(x2)
        if len(run) > 2:
            words.append(0x3000 | (p << 11) | x)
            mask = sum(1 << (value - x) for value in run)
            words += [0x4000 | (mask & 0xFFF), 0x4000 | ((mask >> 12) & 0xFFF), 0x5000 | (mask >> 24)]
            i += len(run)
        else:
            words.append(0x2000 | (p << 11) | x)
            i += 1
        if i % 97 == 0:
            words += [0xE014, 0xF123, 0x7005, 0xA100]  # a count of events and a trigger
    return np.array(words, "<u2").tobytes()


def evt2(events):
    """Words of EVT 2.0; the upper 28 bits of the clock are stated where they change."""
    words, high = [], None
    for t, x, y, p in events.tolist():
        if t >> 6 != high:
            high = t >> 6
            words.append((8 << 28) | (high & 0xFFFFFFF))
        words.append((p << 28) | ((t & 0x3F) << 22) | (x << 11) | y)
    return np.array(words, "<u4").tobytes()


def evt21(events, *, swapped):
    """Words of EVT 2.1, up to 32 events of a row and polarity each."""
    words, high, i = [], None, 0
    rows = events.tolist()
    while i < len(rows):
        t, x, y, p = rows[i]
        if t >> 6 != high:
            high = t >> 6
            words.append((8 << 60) | ((high & 0xFFFFFFF) << 32))
        base, mask = x & ~31, 0
        while i < len(rows) and rows[i][0] == t and rows[i][2:] == [y, p] and rows[i][1] & ~31 == base:
            if mask >> (rows[i][1] - base):
                break  # not in the order of the bits
            mask |= 1 << (rows[i][1] - base)
            i += 1
        words.append((p << 60) | ((t & 0x3F) << 54) | (base << 43) | (y << 32) | mask)
    if swapped:
        words = [((word & 0xFFFFFFFF) << 32) | (word >> 32) for word in words]
    return np.array(words, "<u8").tobytes()


def dat(events):
    """The body of a DAT file, timestamps modulo 2^32."""
    return b"\x0c\x08" + b"".join(
        struct.pack("<II", t & 0xFFFFFFFF, x | (y << 14) | (p << 28)) for t, x, y, p in events.tolist()
    )


def es(events, size):
    """A whole Event Stream file of version 2; rows count from below in it."""
    content = [b"Event Stream", bytes([2, 0, 0, 1]), struct.pack("<HH", *size)]
    last = 0
    for t, x, y, p in events.tolist():
        overflows, rest = divmod(t - last, 127)
        content.append(b"\xff" * overflows + struct.pack("<BHH", (rest << 1) | p, x, size[1] - 1 - y))
        last = t
    return b"".join(content)
