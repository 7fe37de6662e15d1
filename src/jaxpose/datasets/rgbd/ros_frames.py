"""Frames of reference in a bag: what /tf and /tf_static say of where each is in its parent."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxpose.datasets.ground_truth import poses_at
from jaxpose.datasets.rgbd.ros_bag import Bag
from jaxpose.files.tables import seconds
from jaxpose.files.trajectories import Trajectory
from jaxpose.geometry import rigid

_STILL = 1e-9  # entries of a transform that does not move


class Edge(NamedTuple):
    """Where a frame is in its parent, at each of some times."""

    parent: str
    ns: list[int]  # increasing
    T_parent_child: Float[np.ndarray, "n 4 4"]

    @property
    def moves(self) -> bool:
        """Whether it is not the same at all times."""
        return bool(np.abs(self.T_parent_child - self.T_parent_child[0]).max() > _STILL)


class Tree(NamedTuple):
    """The frames of a bag by their children's names."""

    edges: dict[str, Edge]

    def chain(self, frame: str) -> list[str]:
        """The frame, its parent, and so on to the root."""
        names = [frame]
        while names[-1] in self.edges and self.edges[names[-1]].parent not in names:
            names.append(self.edges[names[-1]].parent)
        return names

    def static(self, a: str, b: str) -> Float[np.ndarray, "4 4"] | None:
        """T_a_b, where nothing between the two moves; None where they are not joined, or something does."""
        up_a, up_b = self.chain(a), self.chain(b)
        common = next((name for name in up_a if name in up_b), None)
        if common is None:
            return None
        T_a, T_b = (self._static(up[: up.index(common)]) for up in (up_a, up_b))
        return None if T_a is None or T_b is None else rigid.inverse(T_a) @ T_b

    def at(self, frame: str, ns: list[int]) -> Float[np.ndarray, "n 4 4"] | None:
        """T_root_frame at times [ns], NaN where a moving part is not known; None where nothing moves."""
        edges = [self.edges[name] for name in self.chain(frame)[:-1]]
        if not any(edge.moves for edge in edges):
            return None
        T = np.tile(np.eye(4), (len(ns), 1, 1))
        for edge in edges:
            if edge.moves:
                known = Trajectory(seconds(edge.ns, ns[0]), edge.T_parent_child)
                T = poses_at(known, seconds(ns, ns[0])) @ T
            else:
                T = edge.T_parent_child[0] @ T
        return T

    def _static(self, names: list[str]) -> Float[np.ndarray, "4 4"] | None:
        """The product from the last one's parent down to the first."""
        T = np.eye(4)
        for name in names:
            if self.edges[name].moves:
                return None
            T = self.edges[name].T_parent_child[0] @ T
        return T


def read_tree(bag: Bag) -> Tree:
    """Read all transforms of a bag; of those with one timestamp the first counts."""
    topics = [topic.name for topic in bag.topics.values() if topic.kind in ("TFMessage", "tfMessage")]
    found: dict[str, tuple[str, dict[int, np.ndarray]]] = {}
    for _, recorded_ns, message in bag.messages(*topics):
        for transform in message.transforms:
            parent, child = frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)
            T = pose_matrix(transform.transform.translation, transform.transform.rotation)
            if child != parent and np.isfinite(T).all():
                at = stamp_ns(transform.header) or recorded_ns
                found.setdefault(child, (parent, {}))[1].setdefault(at, T)
    edges = {}
    for child, (parent, by_ns) in found.items():
        ns = sorted(by_ns)
        edges[child] = Edge(parent, ns, np.stack([by_ns[at] for at in ns]))
    return Tree(edges)


def frame_name(name: str) -> str:
    """A frame's name without the leading / of ROS 1's first years."""
    return str(name).lstrip("/")


def stamp_ns(header: Any) -> int:
    """The timestamp of a header [ns], 0 where it was not set."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def pose_matrix(position: Any, orientation: Any) -> Float[np.ndarray, "4 4"]:
    """A pose of ROS as a matrix, NaN for a quaternion that is none."""
    q = np.array([orientation.x, orientation.y, orientation.z, orientation.w], np.float64)
    if not 1e-6 < np.linalg.norm(q) < 1e6:
        return np.full((4, 4), np.nan)
    return rigid.make(
        Rotation.from_quat(q).as_matrix(), np.array([position.x, position.y, position.z], float)
    )
