"""Compare base color and roughness of exported models with the ground truth.

    python benchmarks/accuracy/base_color.py RUN MODEL.glb [MODEL.glb ...] >> benchmarks/records/base-color.md

RUN's scene is rendered by ``polarguide synth`` with ``albedo`` in its ground truth. The models are exports of RUN in
the scene's own units, each in a folder that is named by its base color. Prints Markdown tables: the PSNR of sRGB values
of each model, on dielectrics in held-out views, and for each object of the first model the PSNR and the median of
glTF's roughness next to the true one. Rays from the test views look up the texture in the file, as a viewer does. Each
model has one fitted factor for all channels, because the brightness of base color is ambiguous. Valid pixels are in the
foreground, two pixels away from outlines. Needs trimesh and embreex.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter

from polarguide import Run, open_run
from polarguide.geometry.camera import Camera
from polarguide.optics.color import srgb_decode_array, srgb_encode_array

OUTLINE = 5
"""Side of the window in pixels that must show a single object."""
FEWEST = 20
"""Fewest pixels of an object with a row."""


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


def compared(run: Run, path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Compare a model with the ground truth of all test views, pixel by pixel.

    Returns:
        base colors of the model [N, 3] and of the ground truth [N, 3], roughness of both [N, 2], and objects [N].
    """
    axes = run.frame.panorama_axes().numpy()
    dielectrics = [thing.id for thing in run.scene.objects if thing.foreground]
    mesh = trimesh.load(path, process=False).to_geometry()
    model, true, rough, which = [], [], [], []
    for view in run.scene.test_views:
        with np.load(run.scene.root / "gt" / f"{view.name}.npz") as truth:
            albedo, objects, metal, alpha = (
                truth[name] for name in ("albedo", "objid", "metalness", "roughness")
            )
        assert objects.shape == (view.camera.height, view.camera.width), "train without --downscale"
        inner = (minimum_filter(objects, OUTLINE) == objects) & (maximum_filter(objects, OUTLINE) == objects)
        color = looked_up(mesh, view.camera, axes)
        counts = inner & (metal == 0) & np.isin(objects, dielectrics) & np.isfinite(color).all(axis=-1)
        model.append(color[counts, :3])
        true.append(albedo[counts].astype(float))
        rough.append(np.stack([color[counts, 3], np.sqrt(alpha[counts])], axis=1))
        which.append(objects[counts])
    return np.concatenate(model), np.concatenate(true), np.concatenate(rough), np.concatenate(which)


def object_rows(
    run: Run, colors: np.ndarray, expected: np.ndarray, roughness: np.ndarray, which: np.ndarray
) -> Iterator[str]:
    """Yield the rows of objects with enough pixels: name, PSNR, roughness and true roughness."""
    names = {thing.id: thing.name for thing in run.scene.objects}
    for number in np.unique(which):
        here = which == number
        if here.sum() >= FEWEST:
            found, true = np.median(roughness[here], axis=0)
            score = psnr(colors[here], expected[here])
            yield f"| {names[number]} | {score:.1f} | {found:.2f} | {true:.2f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("models", type=Path, nargs="+")
    arguments = parser.parse_args()
    run = open_run(arguments.run)
    scene = run.scene.root.name
    objects: list[str] = []
    print(f"| model of `{scene}` | PSNR | PSNR without a factor | factor |\n|---|---:|---:|---:|")
    for path in arguments.models:
        colors, expected, roughness, which = compared(run, path)
        factor = float((colors * expected).sum() / (colors * colors).sum())
        scores = f"{psnr(factor * colors, expected):.1f} | {psnr(colors, expected):.1f} | {factor:.2f}"
        print(f"| `{path.parent.name}` | {scores} |", flush=True)
        objects = objects or [*object_rows(run, factor * colors, expected, roughness, which)]
    print(f"\n| object of `{scene}` | PSNR | roughness | true roughness |\n|---|---:|---:|---:|")
    print("\n".join(objects) + "\n")


if __name__ == "__main__":
    main()
