"""Ways to damage a file: anywhere, and by its structure. Each makes other bytes of a file's."""

import io
import json
import re
import zipfile
import zlib
from collections.abc import Callable
from copy import deepcopy
from random import Random
from typing import Any

import numpy as np

# Words for numbers, that a reader has to bear.
NUMBERS = (
    "0", "-0.0", "-1", "1", "nan", "-inf", "inf", "1e400", "1e-400", "1e308", "-1e308", "1e200", "1e9", "2e9",
    "1e18", "9223372036854775807", "9223372036854775808", "-9223372036854775809", "4294967296", "65536",
    "0x10", "1_000", "1,5", "1e999999", "1e999999999", "9" * 5000, "true", "null", "", "\u0663", "1.5.2",
    "1970-01-01", "7258118400", "7258118400000000000", "1e-9", "0.5", "1.0000001", "--1", "+", "1j",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, "", "x", [], {}, -1, 0, 1, 0.5, 1e308, -1e308, 1e400, 10**30, 10**400, float("nan"), [[]],
    [0],     "nan", "../../x", "/etc/passwd", "\0", "\ud800", 2**31, 2**63, 1e10,
)  # fmt: skip
KINDS = ("f8", "f4", "f2", "i8", "i4", "u1", "u8", "bool", "complex128", "U3", "S2", "M8[s]", ">f8")


def anywhere(random: Random, content: bytes) -> bytes:
    """Bits turned, bytes left out, put in, repeated, cut off."""
    data = bytearray(content)
    for _ in range(random.choice((1, 1, 2, 8))):
        at = random.randrange(len(data) + 1)
        to = min(len(data), at + random.choice((1, 2, 4, 16, 256)))
        match random.randrange(7):
            case 0 if at < len(data):
                data[at] ^= 1 << random.randrange(8)
            case 1:
                del data[at:to]
            case 2:
                data[at:at] = random.randbytes(random.choice((1, 4, 64)))
            case 3:
                data[at:at] = data[at:to] * random.choice((1, 2, 50))
            case 4:
                data[at:to] = random.choice((b"\xff", b"\x00", b"\x7f", b"\x80")) * (to - at)
            case 5 if random.random() < 0.3:
                del data[at:]
            case 6:
                data[at:to] = random.choice(NUMBERS).encode("utf-8", "replace")
    return bytes(data)


LONGEST = 4_000_000  # bytes of a damaged text


def text(random: Random, content: bytes) -> bytes:
    """Numbers replaced by others, lines left out, repeated, exchanged, of other separators and lengths."""
    words = content.decode("utf-8", "surrogateescape")
    for _ in range(random.choice((1, 1, 2, 5))):
        lines = words.splitlines(keepends=True) or [""]
        row, other = random.randrange(len(lines)), random.randrange(len(lines))
        found = list(re.finditer(r"[-+.\w]+", words))
        match random.randrange(8):
            case 0 | 1 | 2 if found:
                at = random.choice(found)
                words = words[: at.start()] + random.choice(NUMBERS) + words[at.end() :]
                continue
            case 3:
                del lines[row]
            case 4:
                lines[row] = lines[row] * random.choice((2, 3, 200))
            case 5:
                lines[row], lines[other] = lines[other], lines[row]
            case 6:
                lines[row] = random.choice(
                    ("\n", "#\n", "\0\n", "\t\t\n", " " * 3000 + "\n", "[" * 3000, "\ufeff\n", "-\n", '"')
                )
            case 7:
                old, new = random.choice(
                    ((" ", ","), (",", " "), ("\n", "\r"), (".", ","), (":", " "), ("\n", ""))
                )
                lines[row] = lines[row].replace(old, new)
        if sum(map(len, lines)) > LONGEST:
            break
        words = "".join(lines)
    return words.encode("utf-8", "surrogateescape")


def tree(random: Random, content: bytes) -> bytes:
    """JSON with entries replaced, left out and repeated."""
    try:
        value = json.loads(content)
    except ValueError:
        return text(random, content)
    for _ in range(random.choice((1, 1, 2, 4))):
        places: list[tuple[Any, Any]] = []
        queue = [value]
        while queue and len(places) < 10_000:
            node = queue.pop()
            keys = (
                list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
            )
            places += [(node, key) for key in keys]
            queue += [node[key] for key in keys]
        if not places:
            break
        node, key = random.choice(places)
        match random.randrange(5):
            case 0:
                del node[key]
            case 1 if isinstance(node, list):
                node[key:key] = deepcopy([node[key]] * random.choice((1, 30)))
            case 2:
                other, place = random.choice(places)
                node[key] = json.loads(json.dumps(other[place])) if _there(other, place) else None
            case _:
                node[key] = deepcopy(random.choice(VALUES))  # a case changes none of another
    try:
        found = json.dumps(value)
    except (ValueError, RecursionError):
        return content
    for word, deep in (("1", "[" * 5000), ("0", '{"a":' * 3000)):
        if random.random() < 0.01:
            found = found.replace(word, deep, 1)
    return found.encode("utf-8", "surrogatepass")


def _there(node: Any, key: Any) -> bool:
    return key in node if isinstance(node, dict) else isinstance(key, int) and key < len(node)


def array(random: Random, value: np.ndarray) -> np.ndarray:
    """An array of other numbers, shape or type."""
    value = np.array(value)
    match random.randrange(6):
        case 0:
            try:
                return value.astype(random.choice(KINDS))
            except (ValueError, TypeError):
                return value
        case 1 if value.ndim:
            rows = random.choice((0, 1, max(len(value) - 1, 0)))
            return value[:rows]
        case 2:
            return value.reshape(-1) if random.random() < 0.5 else value[None]
        case 3 if value.ndim:
            return np.concatenate([value] * random.choice((2, 3)))
        case 4 if value.dtype.kind in "iuf" and value.size:
            with np.errstate(all="ignore"):
                return value * np.asarray(random.choice((0, -1, 2))).astype(value.dtype)
    if value.size and value.dtype.kind in "iufb":
        flat = value.reshape(-1)
        bad = random.choice((np.nan, np.inf, -np.inf, 0, -1, 1, 1e9, 1e18, 1e200, -1e300, 255, 65535, 0.5))
        with np.errstate(all="ignore"):
            rows = random.choice((slice(None), random.randrange(value.size)))
            flat[rows] = np.asarray(bad).astype(value.dtype)
        return flat.reshape(value.shape)
    return np.array(random.choice(("", "x", "é" * 9)))


def npy(random: Random, content: bytes) -> bytes:
    """An array with a header that lies, or an array of others."""
    stream = io.BytesIO()
    if random.random() < 0.5:
        try:
            np.save(stream, array(random, np.load(io.BytesIO(content))), allow_pickle=False)
            return stream.getvalue()
        except Exception:  # its header lies already
            pass
    return _header(random, content)


def members_of(content: bytes) -> dict[str, bytes] | None:
    """The files of an archive by their names; None for one that is damaged already."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return {name: archive.read(name) for name in archive.namelist()}
    except Exception:
        return None


def _archive(random: Random, members: dict[str, bytes], compression: int) -> bytes:
    """An archive of files, itself damaged now and then."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as archive:
        for name, value in members.items():
            archive.writestr(name, value)
    return stream.getvalue() if random.random() < 0.9 else anywhere(random, stream.getvalue())


def npz(random: Random, content: bytes) -> bytes:
    """Arrays replaced, left out, renamed, with headers that lie; pickled, stored or deflated."""
    members = members_of(content)
    if members is None:
        return anywhere(random, content)
    for _ in range(random.choice((1, 1, 2))):
        if not members:
            break
        name = random.choice(list(members))
        match random.randrange(8):
            case 0:
                del members[name]
            case 1:
                members[random.choice(("x.npy", "0.kind.npy", "../x.npy", "x"))] = members.pop(name)
            case 2:
                members[name] = members[random.choice(list(members))]
            case 3:
                members[name] = anywhere(random, members[name])
            case 4:
                stream = io.BytesIO()
                np.save(stream, np.array([{"a": 1}]), allow_pickle=True)
                members[name] = stream.getvalue()
            case _:
                members[name] = npy(random, members[name])
    return _archive(random, members, random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))


def hdf5(random: Random, content: bytes) -> bytes:
    """Data sets replaced, left out, renamed."""
    import h5py

    stream = io.BytesIO(content)
    try:
        with h5py.File(stream, "r+") as file:
            names: list[str] = []
            file.visit(names.append)
            name = random.choice([name for name in names if isinstance(file[name], h5py.Dataset)])
            value = file[name][()]
            del file[name]
            match random.randrange(5):
                case 0:
                    pass
                case 1:
                    file[random.choice(("x", "events/ts", "data"))] = value
                case 2:
                    file.create_dataset(name, random.choice(((10**12,), (3, 4), ())), "f8", chunks=None)
                case _:
                    new = array(random, value)
                    file[name] = new if new.dtype.kind not in "UM" else [b"x"]
    except Exception:  # damaged already
        return anywhere(random, content)
    return stream.getvalue()


def zipped(random: Random, content: bytes) -> bytes:
    """Members of an archive damaged, left out, renamed."""
    members = members_of(content)
    if members is None:
        return anywhere(random, content)
    name = random.choice(list(members)) if random.random() < 0.5 else min(members)
    match random.randrange(6):
        case 0:
            del members[name]
        case 1:
            members[random.choice(("x", "../x", "rgbd/9.jpg"))] = members.pop(name)
        case 2:
            members[name] = members[random.choice(list(members))]
        case _:
            members[name] = (tree if members[name].startswith(b"{") else anywhere)(random, members[name])
    return _archive(random, members, zipfile.ZIP_STORED)


def _header(random: Random, content: bytes) -> bytes:
    """An array's header with another shape or type."""
    shape = random.choice(
        (b"(10000000000,)", b"(-1,)", b"()", b"(3, 99999999)", b"(0, 8888888888)", b"((((1,),),),)")
    )
    kind = random.choice(
        (b"'|O'", b"'<f8'", b"'<U900000000'", b"'|V0'", b"'<f2'", b"[('a', '<f8')]", b"'<c16'", b"'>i8'")
    )
    new = re.sub(rb"\([\d, ]*\)", lambda _: shape, content, count=1) if random.random() < 0.6 else content
    return re.sub(rb"'[<>|=]\w+'", lambda _: kind, new, count=1) if random.random() < 0.6 else new


def png(random: Random, content: bytes) -> bytes:
    """A picture of another size, depth or kind, its checksums right."""
    data = bytearray(content)
    if data[:4] != b"\x89PNG" or len(data) < 40:
        return anywhere(random, content)
    at, value = (
        random.choice(((16, 4), (20, 4), (24, 1), (25, 1), (28, 1))),
        random.choice((0, 1, 2, 3, 4, 6, 8, 16, 255)),
    )
    place, size = at
    number = random.choice((value, value, 9000, 100_000, 2**31 - 1)) if size == 4 else value
    data[place : place + size] = number.to_bytes(size, "big")
    data[29:33] = zlib.crc32(bytes(data[12:29])).to_bytes(4, "big")
    return bytes(data)


BY_SUFFIX: dict[str, tuple[Callable[[Random, bytes], bytes], ...]] = {
    ".npz": (npz, npz, npz, anywhere),
    ".npy": (npy, npy, anywhere),
    ".json": (tree, tree, tree, text, anywhere),
    ".png": (png, anywhere),
    ".jpg": (anywhere,),
    ".h5": (hdf5, hdf5, anywhere),
    ".r3d": (zipped, zipped, anywhere),
    **dict.fromkeys((".bin", ".bag", ".db3", ".mcap", ".raw", ".dat", ".es", ".aedat4", ".mp4"), (anywhere,)),
    ".ply": (text, anywhere),
}


def mutated(random: Random, suffix: str, content: bytes) -> bytes:
    """A damaged copy of a file, in a way that fits its kind or in one that fits all."""
    if random.random() < 0.02:
        return random.choice((b"", b"\n", b"\0", random.randbytes(64)))
    return random.choice(BY_SUFFIX.get(suffix, (text, text, text, anywhere)))(random, content)
