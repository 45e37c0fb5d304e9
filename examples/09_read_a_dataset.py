"""Train on a dataset whose layout polarguide does not know: Stokes vectors and camera matrices as NumPy files.

python examples/09_read_a_dataset.py src/polarguide/data/demo runs/dataset 400
"""

import sys
from pathlib import Path

import numpy as np

import polarguide

ANGLES = np.deg2rad([0, 45, 90, 135])


def read_dataset(folder):
    """Return a scene from ``stokes/NAME.npy`` [3, H, W, 3], ``cameras.npz`` and ``points.npy`` [M, 3].

    ``cameras.npz`` has ``K`` [3, 3] in pixels, and for each view a matrix ``NAME`` [4, 4] from world to camera, with
    the axes right, down, forward.
    """
    matrices = np.load(folder / "cameras.npz")
    pictures, cameras = {}, {}
    for file in sorted((folder / "stokes").glob("*.npy")):
        s0, s1, s2 = np.load(file)
        behind_filter = [(s0 + s1 * np.cos(2 * a) + s2 * np.sin(2 * a)) / 2 for a in ANGLES]
        pictures[file.stem] = np.clip(behind_filter, 0, 1).astype(np.float32)
        height, width = s0.shape[:2]
        cameras[file.stem] = polarguide.Camera.from_matrices(
            matrices["K"], matrices[file.stem], width, height
        )
    points = np.load(folder / "points.npy")
    return polarguide.Scene.from_arrays(pictures, cameras, points=points, name=folder.name)


def write_sample(scene, folder):
    """Write a scene in the layout above, so that this example has a dataset to read."""
    (folder / "stokes").mkdir(parents=True, exist_ok=True)
    matrices = {"K": scene.views[0].camera.intrinsics.numpy()}
    for view in scene.views:
        np.save(folder / "stokes" / f"{view.name}.npy", view.stokes().numpy())
        matrices[view.name] = view.camera.world_to_camera.numpy()
    np.savez(folder / "cameras.npz", **matrices)
    np.save(folder / "points.npy", scene.points.numpy())


if __name__ == "__main__":
    sample = Path(f"{sys.argv[2]}-dataset")
    write_sample(polarguide.load_scene(sys.argv[1], downscale=4), sample)
    scene = read_dataset(sample)
    settings = polarguide.TrainSettings(steps=int(sys.argv[3]))
    run = polarguide.train(scene, sys.argv[2], settings=settings)
    print(f"{len(scene.views)} views, PSNR {run.evaluate()['psnr']:.1f} dB")
