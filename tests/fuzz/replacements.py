"""What may lie in a file's place: none, a folder, a link, another file, the same in another encoding."""

import io
import os
import random as randoms
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
from mutations import members_of

ENCODINGS = ("utf-16", "utf-16-le", "utf-32", "utf-8-sig", "latin-1", "cp1252", "utf-7", "cp037")
LINE_ENDS = ("\r\n", "\r", "\x85", "\u2028", "\x0b", "\n\n", "\x1c")
KINDS = ("1", "L", "P", "LA", "RGBA", "CMYK", "I;16", "I", "F", "YCbCr")
FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "GIF", "WEBP", "PPM", "JPEG2000")
_BOMB = 1 << 34  # bytes that a file of some kB says it unpacks to


def put(random: randoms.Random, file: Path, others: list[Path]) -> None:
    """Put something else in the place of a file.

    Args:
        random: What.
        file: The file.
        others: The files beside it.
    """
    content = file.read_bytes()
    match random.randrange(10):
        case 0:
            file.unlink()
        case 1:
            _no_file(random, file, others)
        case 2 | 3:
            file.write_bytes(random.choice(others).read_bytes())
        case 4 if len(others) > 1:
            other = random.choice(others)
            file.write_bytes(other.read_bytes())
            other.write_bytes(content)
        case 5 | 6 if file.suffix in (".png", ".jpg"):
            file.write_bytes(_picture(random, content))
        case 7:
            file.write_bytes(_bomb(random, file.suffix, content))
        case 8:
            names = [path for path in others if path.parent == file.parent and path != file]
            name = random.choice(("x", "\udcff", file.name.upper(), "0" * 200, f"{file.stem} 1{file.suffix}"))
            file.rename(random.choice(names) if names and random.random() < 0.5 else file.parent / name)
        case _:
            file.write_bytes(_encoded(random, content))


def _no_file(random: randoms.Random, file: Path, others: list[Path]) -> None:
    """A folder, a link that leads nowhere, to itself or to another file, or a pipe that nobody writes to."""
    file.unlink()
    match random.randrange(5):
        case 0:
            file.mkdir()
        case 1:
            file.symlink_to(file.name)
        case 2:
            file.symlink_to("not-there")
        case 3:
            file.symlink_to(random.choice(others))
        case _:
            os.mkfifo(file)


def _encoded(random: randoms.Random, content: bytes) -> bytes:
    """Text in another encoding, of other line ends or digits."""
    text = content.decode("utf-8", "replace")
    match random.randrange(4):
        case 0:
            return text.encode(random.choice(ENCODINGS), "replace")
        case 1:
            return text.replace("\n", random.choice(LINE_ENDS)).encode()
        case 2:
            return text.translate({48 + k: chr(0x660 + k) for k in range(10)}).encode()
    pairs = (("\n", "\n#\n"), (" ", "\u00a0"), (" ", "\t"), ("-", "\u2212"), (",", ", "))
    return text.replace(*random.choice(pairs)).encode()


def _picture(random: randoms.Random, content: bytes) -> bytes:
    """A picture in another kind of pixels and another format, or with less of it."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(content)) as opened:
            picture = opened.copy()
        if random.random() < 0.3:
            picture = picture.resize(random.choice(((1, 1), (1, 300), (64, 2), (2000, 3))))
        if random.random() < 0.7:
            picture = picture.convert(random.choice(KINDS))
        stream = io.BytesIO()
        options = random.choice(({}, {"progressive": True}, {"interlace": True}, {"save_all": True}))
        picture.save(stream, random.choice(FORMATS), **options)
        return stream.getvalue()
    except Exception:  # no such kind in this format
        return content[: len(content) // 2]


def _bomb(random: randoms.Random, suffix: str, content: bytes) -> bytes:
    """A small file that says, or is, far more when it is unpacked."""
    match suffix:
        case ".png":
            chunk = b"zTXtComment\0\0" + zlib.compress(bytes(1 << 24), 9)
            text = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
            return content[:33] + text * random.choice((1, 60)) + content[33:]
        case ".npz":
            stream, head = io.BytesIO(), io.BytesIO()
            rows = 1 << random.choice((10, 20, 24))
            shape = {"descr": "<f8", "fortran_order": False, "shape": (rows,)}
            np.lib.format.write_array_header_1_0(head, shape)
            names = list(members_of(content) or ("a.npy",))
            with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
                for name in names:
                    with archive.open(name, "w") as member:
                        member.write(head.getvalue())
                        for _ in range(rows >> 10):
                            member.write(bytes(1 << 13))
            return stream.getvalue()
        case ".h5":
            return _large_set(random, content)
        case ".json":
            return content.replace(b"[", b"[" + b"0," * random.choice((10, 10**6)), 1)
        case ".yaml":
            bomb = "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9) or 0}]\n" for k in range(9))
            return bomb.encode().replace(b"*a-1", b"0") + content
    return content + random.choice((b"\n" * 10**6, b" " * 10**6, b"#" * 10**6, content[-200:] * 5000))


def _large_set(random: randoms.Random, content: bytes) -> bytes:
    """An HDF5 file of which one data set is said to be long; nothing of it is stored."""
    import h5py

    stream = io.BytesIO(content)
    with h5py.File(stream, "r+") as file:
        names: list[str] = []
        file.visititems(lambda name, at: names.append(name) if isinstance(at, h5py.Dataset) else None)
        name = random.choice(names)
        kind = file[name].dtype
        del file[name]
        file.create_dataset(name, (_BOMB,), kind, chunks=(1 << 16,), compression="gzip")
    return stream.getvalue()
