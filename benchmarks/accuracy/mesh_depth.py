"""Compare the depth of an exported mesh on test views with the ground truth.

    python benchmarks/accuracy/mesh_depth.py RUN MESH.ply > benchmarks/records/mesh-depth.md

Needs trimesh with a ray engine (``pip install embreex``). Errors are in percent of the scene's extent, which is 1.1
times the largest distance of a camera from the cameras' mean. "rendered" is the depth of the surface that ``polarguide
render`` draws. A mesh with an up axis or a scale in its file is converted to the scene's axes and units.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch
import trimesh
from plyfile import PlyData

from polarguide import open_run
from polarguide.gaussians.initialize import scene_extent
from polarguide.visualization import figures


def scene_mesh(path: Path) -> trimesh.Trimesh:
    """Return the mesh of a PLY file of ``polarguide export``, in the axes and units of its scene."""
    mesh = trimesh.load(path, process=False)
    file = PlyData.read(path)
    lines = [*file.comments, *(line for element in file.elements for line in element.comments)]
    about = dict(line.split(" ", 1) for line in lines if " " in line)
    turn = np.array(about.get("rotation_of_scene", "1 0 0 0 1 0 0 0 1").split(), np.float64).reshape(3, 3)
    back = np.eye(4)
    # File = scale * rotation @ scene, see polarguide.results.export.placement.
    back[:3, :3] = turn.T / float(about.get("meters_per_unit_of_scene", "1"))
    return mesh.apply_transform(back)


def mesh_depth(mesh: trimesh.Trimesh, camera, step: int) -> np.ndarray:
    """Return the camera depth of the first hit of each ``step``-th pixel's ray with the mesh, NaN for a miss."""
    rays = camera.rays(dtype=torch.float64)[::step, ::step]
    ways = camera.to_world(rays).reshape(-1, 3).numpy()
    start = np.broadcast_to(camera.center.numpy(), ways.shape)
    found, which, _ = mesh.ray.intersects_location(start, ways, multiple_hits=False)
    depth = np.full(len(ways), np.nan)
    depth[which] = (found - start[which]) @ camera.rotation[2].numpy()
    return depth.reshape(rays.shape[:2])


def pictures(mesh: trimesh.Trimesh, camera) -> np.ndarray:
    """Render colors and normals of the mesh from a camera, side by side, uint8 RGB."""
    ways = camera.to_world(camera.rays(dtype=torch.float64)).reshape(-1, 3).numpy()
    start = np.broadcast_to(camera.center.numpy(), ways.shape)
    places, which, faces = mesh.ray.intersects_location(start, ways, multiple_hits=False)
    shares = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], places)[..., None]
    colors, normals = np.zeros((len(ways), 3)), np.zeros((len(ways), 3))
    colors[which] = (mesh.visual.vertex_colors[mesh.faces[faces], :3] * shares).sum(axis=1)
    normals[which] = (mesh.vertex_normals[mesh.faces[faces]] * shares).sum(axis=1)
    shape = (camera.height, camera.width, 3)
    shown = figures.normal_to_rgb(torch.from_numpy(normals.reshape(shape)), camera)
    return np.concatenate((colors.reshape(shape).round().astype(np.uint8), shown), axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--step", type=int, default=2)
    parser.add_argument("--picture", type=Path, help="JPEG or PNG to write of the first test view")
    arguments = parser.parse_args()
    opened = open_run(arguments.run)
    extent = scene_extent(torch.stack([camera.center for camera in opened.cameras.values()]))
    mesh = scene_mesh(arguments.mesh)
    if arguments.picture:
        shown = pictures(mesh, opened.scene.test_views[0].camera)
        cv2.imwrite(str(arguments.picture), cv2.resize(shown, None, fx=2, fy=2)[..., ::-1])
    errors: dict[str, list[np.ndarray]] = {"mesh": [], "rendered": []}
    missing = []
    for view in opened.scene.test_views:
        assert view.ground_truth is not None
        true = view.ground_truth.depth[:: arguments.step, :: arguments.step].numpy()
        known = view.ground_truth.mask[:: arguments.step, :: arguments.step].numpy() & (true > 0)
        rendered = opened.render(view.camera, layers=["depth"])["depth"].cpu()
        rendered = rendered[:: arguments.step, :: arguments.step].numpy()
        ours = mesh_depth(mesh, view.camera, arguments.step)
        for depths, depth in zip(errors.values(), (ours, rendered), strict=True):
            hit = known & np.isfinite(depth)
            depths.append(np.abs(depth - true)[hit] * 100 / extent)
        missing.append(100 * float((known & np.isnan(ours)).sum() / known.sum()))
    print("| depth | median error | 90th percentile | foreground without a surface |\n|---|---|---|---|")
    gaps = {"mesh": f"{min(missing):.1f} to {max(missing):.1f} %"}
    for name, depths in errors.items():
        joined = np.concatenate(depths)
        median, large = np.quantile(joined, [0.5, 0.9])
        print(f"| {name} | {median:.2f} % | {large:.2f} % | {gaps.get(name, '')} |")


if __name__ == "__main__":
    main()
