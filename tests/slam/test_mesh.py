"""The map as a mesh and a point cloud: a sphere of known size, seen by cameras at known places."""

import importlib.util
import sys

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers.blocks import filled, node_positions, over_box

from jaxpose.files.ply import read_points, write_ply
from jaxpose.geometry.camera import Camera
from jaxpose.scenes.voxel_blocks import BlockConfig
from jaxpose.slam.keyframes import Keyframe
from jaxpose.slam.map.mesh import mesh, point_cloud
from jaxpose.slam.observation import Image

RADIUS = 0.5  # m
CAMERA = Camera(fx=60.0, fy=60.0, cx=39.5, cy=29.5, width=80, height=60)
CONFIG, BOX = BlockConfig(0.04, 0.12), ((-0.8, -0.8, -0.8), (0.8, 0.8, 0.8))


def looking_at_the_sphere(index, T_world_cam):
    """A keyframe with the exact depth of the sphere, coloured by the point's place."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    ray = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1)
    ray_world = ray @ T_world_cam[:3, :3].T
    origin = T_world_cam[:3, 3]
    a, b = (ray_world**2).sum(-1), ray_world @ origin
    root = b**2 - a * (origin @ origin - RADIUS**2)
    depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)
    rgb = colour(origin + depth[..., None] * ray_world)
    return Keyframe(index, Image(jnp.asarray(rgb), jnp.asarray(depth, jnp.float32)), T_world_cam)


def colour(points):
    return np.round(255 * np.clip(0.5 + points, 0, 1)).astype(np.uint8)


@pytest.fixture(scope="module")
def keyframes():
    """Two cameras, at x = -2 and y = -2, which look at the middle."""
    along_x, along_y = np.eye(4), np.eye(4)
    along_x[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    along_x[:3, 3] = [-2, 0, 0]
    along_y[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    along_y[:3, 3] = [0, -2, 0]
    return [looking_at_the_sphere(k, T) for k, T in enumerate((along_x, along_y))]


def sphere(nodes):
    """The sphere's signed distance and colour."""
    distance = np.clip(np.linalg.norm(nodes, axis=-1) - RADIUS, -0.12, 0.12)
    return np.concatenate([distance[..., None], 0.5 + nodes], axis=-1)


@pytest.fixture(scope="module")
def blocks():
    return filled(CONFIG, *BOX, sphere)


def test_the_mesh_is_the_sphere_where_it_was_seen(blocks, keyframes):
    surface = mesh(CONFIG, blocks, keyframes, CAMERA)
    radius = np.linalg.norm(surface.points, axis=1)
    assert np.abs(radius - RADIUS).max() < 0.04**2 / RADIUS  # the sagitta of a cell
    towards = -surface.points[:, :2].min(axis=1)
    assert towards.min() > 0.06  # beyond a camera's horizon at 0.5 / 2 the depth is not within the band
    seen_by_x = np.linalg.norm(surface.points - [-RADIUS, 0, 0], axis=1).min()
    assert seen_by_x < 0.03
    assert np.abs(surface.rgb.astype(int) - colour(surface.points)).max() <= 2
    corners = surface.points[surface.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ni,ni->n", normal, corners.mean(1)) > 0).all()  # outwards, where it is free
    assert surface.faces.max() == len(surface.points) - 1  # nothing but what triangles use


def test_a_whole_sphere_is_closed(blocks, keyframes):
    turned = [np.diag([1.0, -1, -1, 1]), np.diag([-1.0, 1, -1, 1]), np.diag([-1.0, -1, 1, 1])]
    views = [k._replace(T_world_cam=T @ k.T_world_cam) for k in keyframes for T in turned] + keyframes
    down = np.eye(4)
    down[2, 3] = -2
    views += [looking_at_the_sphere(8, down), looking_at_the_sphere(9, np.diag([1.0, -1, -1, 1]) @ down)]
    views = [looking_at_the_sphere(k.index, k.T_world_cam) for k in views]
    surface = mesh(CONFIG, blocks, views, CAMERA)
    solid = trimesh.Trimesh(surface.points, surface.faces, process=False)
    assert solid.is_watertight
    assert solid.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.02)


def test_where_measuring_ends_behind_a_surface_there_is_none(blocks, keyframes):
    """Integration leaves nodes far behind a surface as free as they were: their sign changes once more."""
    values, nodes = np.array(blocks.values), node_positions(CONFIG, blocks)
    values[1 : len(nodes) + 1][np.linalg.norm(nodes, axis=-1) < RADIUS - 0.06] = values[0, 0, 0, 0]
    hollow = mesh(CONFIG, blocks._replace(values=jnp.asarray(values)), keyframes, CAMERA)
    assert len(hollow.points) == len(mesh(CONFIG, blocks, keyframes, CAMERA).points) > 500
    assert np.linalg.norm(hollow.points, axis=1).min() > RADIUS - 0.04**2 / RADIUS


def test_nothing_seen_is_an_empty_mesh(blocks, keyframes):
    assert len(mesh(CONFIG, over_box(CONFIG, *BOX), keyframes, CAMERA).faces) == 0
    assert len(mesh(CONFIG, blocks, [], CAMERA).faces) == 0


def test_the_cloud_has_one_measured_point_in_each_cube(keyframes):
    points, rgb, faces = point_cloud(keyframes, CAMERA, 0.05)
    assert len(faces) == 0 and len(points) > 200
    assert np.abs(np.linalg.norm(points, axis=1) - RADIUS).max() < 1e-5
    assert len(np.unique(np.floor(points / 0.05), axis=0)) == len(points)
    assert np.abs(rgb.astype(int) - colour(points)).max() <= 1
    assert len(point_cloud(keyframes[:1], CAMERA, 0.05).points) < len(points)


def test_written_meshes_open_in_another_program(blocks, keyframes, tmp_path):
    surface = mesh(CONFIG, blocks, keyframes, CAMERA)
    write_ply(tmp_path / "mesh.ply", surface.points, surface.rgb, surface.faces)
    opened = trimesh.load(tmp_path / "mesh.ply", process=False)
    np.testing.assert_allclose(opened.vertices, surface.points, atol=1e-6)
    np.testing.assert_array_equal(opened.faces, surface.faces)
    np.testing.assert_array_equal(opened.visual.vertex_colors[:, :3], surface.rgb)
    write_ply(tmp_path / "points.ply", surface.points, surface.rgb)
    np.testing.assert_allclose(trimesh.load(tmp_path / "points.ply").vertices, surface.points, atol=1e-6)
    np.testing.assert_allclose(read_points(tmp_path / "points.ply"), surface.points, atol=1e-6)


def test_without_the_extra_marching_cubes_says_so(blocks, keyframes, monkeypatch):
    assert importlib.util.find_spec("skimage") is not None
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    with pytest.raises(ImportError):
        mesh(CONFIG, blocks, keyframes, CAMERA)
