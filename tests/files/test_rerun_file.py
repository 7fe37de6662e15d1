"""Recordings of rerun: read back by its own SDK."""

import numpy as np
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

from jaxpose.files.rerun_file import write_rerun
from jaxpose.files.trajectories import Trajectory
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera

T0_NS, COUNT = 1_403_715_523_912_143_101, 5


def columns(path):
    """Every column of a file, by entity and name."""
    found = {}
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            found[chunk.entity_path, name] = column
    return found


def test_poses_camera_and_points_come_back(tmp_path):
    rng = np.random.default_rng(5)
    rotation = Rotation.from_rotvec(rng.normal(size=(COUNT, 3)))
    T = rigid.make(rotation.as_matrix(), rng.normal(size=(COUNT, 3)))
    points, rgb = rng.normal(size=(7, 3)), rng.integers(0, 256, (7, 3)).astype(np.uint8)
    camera = Camera(30.0, 31.0, 15.5, 11.5, 32, 24)
    file = tmp_path / "walk.rrd"
    write_rerun(file, Trajectory(np.arange(COUNT) / 10, T, T0_NS), camera, points=points, rgb=rgb)
    assert [path.name for path in tmp_path.iterdir()] == ["walk.rrd"]
    found = columns(file)
    flat = lambda entity, name: np.array(found[entity, name].to_pylist(), float)
    np.testing.assert_allclose(flat("/world/camera", "Transform3D:translation")[:, 0], T[:, :3, 3], atol=1e-6)
    turned = Rotation.from_quat(flat("/world/camera", "Transform3D:quaternion")[:, 0]) * rotation.inv()
    assert turned.magnitude().max() < 1e-6
    at = found["/world/camera", "time"].cast("int64").to_pylist()
    assert at == [T0_NS + k * 100_000_000 for k in range(COUNT)]
    K = flat("/world/camera", "Pinhole:image_from_camera").reshape(3, 3).T  # rerun's are column by column
    np.testing.assert_allclose(K, [[30, 0, 16], [0, 31, 12], [0, 0, 1]])
    np.testing.assert_allclose(flat("/world/points", "Points3D:positions")[0], points, atol=1e-6)
    np.testing.assert_allclose(flat("/world/path", "LineStrips3D:strips")[0, 0], T[:, :3, 3], atol=1e-6)
