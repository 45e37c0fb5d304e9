"""Compare base color and roughness of exported models with the ground truth.

    python benchmarks/accuracy/base_color.py RUN MODEL.glb [MODEL.glb ...]

Prints the PSNR of sRGB values on dielectrics in held-out views, and the median of glTF's roughness next to the true
one. RUN's scene is rendered by ``polarguide synth`` with ``albedo`` in its ground truth. The models are exports of RUN
in the scene's own units. Rays from the test views look up the texture in the file, as a viewer does. Each model has
one fitted factor for all channels, because the brightness of base color is ambiguous. Valid pixels are in the
foreground, two pixels away from outlines. Needs trimesh and embreex.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter

from polarguide import open_run
from polarguide.geometry.camera import Camera
from polarguide.optics.color import srgb_decode_array, srgb_encode_array

OUTLINE = 5
"""Side of the window in pixels that must show a single object."""


def looked_up(mesh: trimesh.Trimesh, camera: Camera, axes: np.ndarray) -> np.ndarray:
    """Return linear base color and roughness [H, W, 4] of a model from a camera of the scene, NaN without a surface."""
    rays = camera.world_rays(dtype=torch.float64).reshape(-1, 3).numpy() @ axes
    starts = np.broadcast_to(camera.center.numpy() @ axes, rays.shape)
    places, ray, face = mesh.ray.intersects_location(starts, rays, multiple_hits=False)
    shares = trimesh.triangles.points_to_barycentric(mesh.triangles[face], places)
    uv = (mesh.visual.uv[mesh.faces[face]] * shares[..., None]).sum(axis=1)
    material = mesh.visual.material
    color, surface = (
        np.array(t) / 255 for t in (material.baseColorTexture, material.metallicRoughnessTexture)
    )
    image = np.concatenate([srgb_decode_array(color[..., :3]), surface[..., 1:2]], axis=-1)
    size = image.shape[0]
    places_in_texture = (
        np.stack([(1 - uv[:, 1]) * size, uv[:, 0] * size]) - 0.5
    )  # trimesh counts v from the bottom
    colors = np.full((len(rays), 4), np.nan)
    for channel in range(4):
        colors[ray, channel] = map_coordinates(
            image[..., channel], places_in_texture, order=1, mode="nearest"
        )
    return colors.reshape(camera.height, camera.width, 4)


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    """Return the PSNR of linear colors in dB, in sRGB."""
    shown = [srgb_encode_array(np.clip(values, 0, 1)) for values in (first, second)]
    return float(-10 * np.log10(np.mean((shown[0] - shown[1]) ** 2)))


def main() -> None:
    """Print a table of each model and its objects."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("models", type=Path, nargs="+")
    arguments = parser.parse_args()
    run = open_run(arguments.run)
    axes = run.frame.panorama_axes().numpy()
    names = {thing.id: thing.name for thing in run.scene.objects if thing.foreground}
    print(f"{'model':32} {'factor 1':>9} {'best':>9} {'factor':>7}  objects with that factor")
    for path in arguments.models:
        mesh = trimesh.load(path, process=False).to_geometry()
        model, true, which, rough = [], [], [], []
        for view in run.scene.test_views:
            with np.load(run.scene.root / "gt" / f"{view.name}.npz") as truth:
                albedo, objects, metal, alpha = (
                    truth[name] for name in ("albedo", "objid", "metalness", "roughness")
                )
            assert objects.shape == (view.camera.height, view.camera.width), "train without --downscale"
            inner = (minimum_filter(objects, OUTLINE) == objects) & (
                maximum_filter(objects, OUTLINE) == objects
            )
            color = looked_up(mesh, view.camera, axes)
            counts = inner & (metal == 0) & np.isin(objects, [*names]) & np.isfinite(color).all(axis=-1)
            model.append(color[counts, :3])
            rough.append(np.stack([color[counts, 3], np.sqrt(alpha[counts])], axis=1))
            true.append(albedo[counts].astype(float))
            which.append(objects[counts])
        colors, expected, objects, roughness = (
            np.concatenate(parts) for parts in (model, true, which, rough)
        )
        factor = float((colors * expected).sum() / (colors * colors).sum())
        each = [
            "{} {:.1f} (roughness {:.2f}, true {:.2f})".format(
                names[number],
                psnr(factor * colors[here], expected[here]),
                *np.median(roughness[here], axis=0),
            )
            for number in np.unique(objects)
            if (here := objects == number).sum() >= 20
        ]
        scores = f"{psnr(colors, expected):9.2f} {psnr(factor * colors, expected):9.2f} {factor:7.2f}"
        print(f"{path.parent.name + '/' + path.name:32} {scores}  {', '.join(each)}")


if __name__ == "__main__":
    main()
