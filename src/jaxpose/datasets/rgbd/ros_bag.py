"""Bags of ROS 1 and ROS 2 (sqlite3, MCAP) through the package `rosbags`: topics and their messages."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from jaxpose.datasets.images import found, only
from jaxpose.errors import DataError
from jaxpose.files.opening import BoundedFile, check_file, open_file, read_bytes

_MAGIC = {b"#ROSBAG V2.0": ".bag", b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3"}
_METADATA = "metadata.yaml"
_KINDS = "a ROS bag: .bag, .mcap, .db3, or a folder with metadata.yaml"
EXTRA = 'pip install -e ".[ros]"'


class _ClampedPath(type(Path())):
    """A path whose binary files are such; `rosbags` takes paths of any kind."""

    def open(self, mode: str = "r", *args: Any, **options: Any) -> Any:
        return BoundedFile(self) if mode == "rb" else super().open(mode, *args, **options)


class Topic(NamedTuple):
    """A topic of a bag."""

    name: str
    kind: str  # type of its messages, without package: Image
    count: int  # of messages


def bag_file(path: Path) -> Path | None:
    """The bag that a path is or holds; None where there is none.

    Args:
        path: A file, known by its first bytes, a folder with the `metadata.yaml` of ROS 2, or one with a
            single bag in it.

    Returns:
        What `Bag` opens.
    """
    if path.is_dir():
        if (path / _METADATA).is_file() and b"rosbag2_bagfile" in read_bytes(path / _METADATA)[:4096]:
            return path
        files = [file for suffix in _MAGIC.values() for file in sorted(path.glob(f"[!.]*{suffix}"))]
        bags = [file for file in files if bag_file(file)]
        return only(bags, path, f"one {_KINDS}", "bags") if bags else None
    if not path.is_file():
        return None
    with open_file(path) as stream:
        head = stream.read(16)
    return path if any(head.startswith(magic) for magic in _MAGIC) else None


class Bag:
    """An open bag. Messages are read in the order of their topic, most cheaply one after the other.

    Args:
        path: What `bag_file` found.

    Raises:
        DataError: For what is no bag, or damaged, and where the package is not installed.
    """

    def __init__(self, path: Path):
        self.path, self._at = path, dict[str, tuple[int, Iterator[Any]]]()
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise DataError(f"{path}: a ROS bag needs the package rosbags: {EXTRA}") from None
        for file in path.iterdir() if path.is_dir() else ():
            check_file(file)
        try:
            # Bags of ROS 2 before Iron do not hold the definitions of their types.
            store = get_typestore(Stores.ROS2_HUMBLE)
            self._reader = AnyReader([_ClampedPath(path)], default_typestore=store)
            self._reader.open()
            self.topics = {
                name: Topic(name, (info.msgtype or "").rsplit("/", 1)[-1], info.msgcount)
                for name, info in self._reader.topics.items()
                if info.msgcount
            }
        except Exception as error:  # each storage raises its own kinds on damaged files
            raise self._damaged(error) from None
        if not self.topics:
            raise DataError(f"{path}: expected messages in the bag, got none")

    def messages(self, *topics: str) -> Iterator[tuple[str, int, Any]]:
        """Topic, time of recording [ns] and content of all messages of some topics, in order of time."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:
            return
        try:
            for connection, ns, raw in self._reader.messages(connections):
                yield connection.topic, ns, self._reader.deserialize(raw, connection.msgtype)
        except DataError:
            raise
        except Exception as error:
            raise self._damaged(error) from None

    def raw(self, topic: str) -> Iterator[tuple[int, bytes, bool]]:
        """Time of recording [ns] and bytes of all messages of a topic, and whether they are CDR of ROS 2."""
        connections = [c for c in self._reader.connections if c.topic == topic]
        try:
            for _, ns, raw in self._reader.messages(connections):
                yield ns, raw, self._reader.is2
        except Exception as error:
            raise self._damaged(error) from None

    def first(self, topic: str) -> Any:
        """The first message of a topic."""
        for _, _, message in self.messages(topic):
            return message
        raise DataError(f"{self.path}: expected messages of {topic}, got none")

    def message(self, topic: str, recorded_ns: list[int], i: int) -> Any:
        """Message i of a topic, given when all of them were recorded [ns, not decreasing]."""
        at, rows = self._at.get(topic, (-1, iter(())))
        connections = [c for c in self._reader.connections if c.topic == topic]
        try:
            if at != i:
                start = recorded_ns[i]
                rows = self._reader.messages(connections, start=start)
                for _ in range(i - recorded_ns.index(start)):
                    next(rows)
            connection, _, raw = next(rows)
            self._at[topic] = (i + 1, rows)
            return self._reader.deserialize(raw, connection.msgtype)
        except Exception as error:
            raise self._damaged(error) from None

    def _damaged(self, error: Exception) -> DataError:
        words = " ".join(str(error).split()) or type(error).__name__
        hint = " (rosbag reindex repairs a bag that was not closed)" if "index" in words.lower() else ""
        return DataError(f"{self.path}: expected {_KINDS}, got a damaged one: {words[:200]}{hint}")


def open_bag(path: Path | str) -> Bag:
    """Open the bag that a path is or holds.

    Args:
        path: As for `bag_file`.

    Returns:
        The bag.

    Raises:
        DataError: Where there is none, and as `Bag`.
    """
    file = bag_file(Path(path))
    if file is None:
        raise DataError(f"{path}: expected {_KINDS}, got {found(Path(path))}")
    return Bag(file)
