"""Render from new cameras: a turn around the scene, written as PNG files.

python examples/02_cameras_of_your_own.py runs/demo turn
"""

import sys
from pathlib import Path

import polarguide
from polarguide.geometry.camera_path import orbit
from polarguide.visualization.figures import normal_to_rgb, radiance_to_rgb, write_png

run, out = polarguide.open_run(sys.argv[1]), Path(sys.argv[2])
out.mkdir(parents=True, exist_ok=True)
for number, camera in enumerate(orbit(list(run.cameras.values()), frames=8)):
    layers = run.render(camera, layers=["final", "normal"])
    write_png(out / f"final_{number}.png", radiance_to_rgb(layers["final"]))
    write_png(out / f"normal_{number}.png", normal_to_rgb(layers["normal"], camera))
print(f"8 pictures of each layer in {out}")
