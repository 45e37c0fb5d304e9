"""Draw the picture of the front page: a held-out view by three recipes next to the ground truth.

    polarguide synth benchmarks/front/tea.json --size 192x144 --samples 12 --out SCENE
    for recipe in 3dgs 3dgs-dr polarguide-stokes; do
      polarguide train SCENE --steps 2000 --recipe $recipe --out RUNS/$recipe
    done
    python benchmarks/front/front_pictures.py SCENE RUNS --view v016

Writes ``docs/images/front.jpg``. With ``--recipes`` and ``--out``, it draws other recipes to another file. Pictures
have the size of the scene's pictures, at any size of the training.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import polarguide as pg
from polarguide.geometry.camera import Camera
from polarguide.visualization.figures import Picture, contact_sheet, ground_truth_pictures, layer_picture

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
RECIPES = ("3dgs", "3dgs-dr", "polarguide-stokes")
LAYERS = {"final": "picture", "specular": "specular", "diffuse": "diffuse", "normal": "normals"}


def drawn(run: pg.Run, camera: Camera) -> dict[str, Picture | None]:
    """Return the layers of a run as 8-bit pictures; None for a missing layer."""
    result = run.result(camera)
    return {layer: layer_picture(result, layer, camera) for layer in LAYERS}


def sheet(scene: pg.Scene, runs: dict[str, pg.Run], name: str) -> Picture:
    """Return a held-out view with a row for each layer, the ground truth and all recipes side by side."""
    view = scene.view(name)
    columns = [ground_truth_pictures(view), *(drawn(run, view.camera) for run in runs.values())]
    none = absent(view.camera.width, view.camera.height)
    return contact_sheet(
        [[none if column[layer] is None else column[layer] for column in columns] for layer in LAYERS],
        list(LAYERS.values()),
        ["photograph, truth", *runs],
        minimum_width=1,
    )


def absent(width: int, height: int) -> Picture:
    """Return the tile of a missing layer."""
    image = Image.new("RGB", (width, height), "#eeeeee")
    ImageDraw.Draw(image).text(
        (width / 2, height / 2), "none", font=ImageFont.load_default(18), fill="#777777", anchor="mm"
    )
    return np.asarray(image)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("runs", type=Path, help="a folder with a run of each recipe, by its name")
    parser.add_argument("--view", required=True, help="a held-out view")
    parser.add_argument("--recipes", nargs="+", default=RECIPES)
    parser.add_argument("--out", type=Path, default=IMAGES / "front.jpg")
    given = parser.parse_args()
    runs = {recipe: pg.open_run(given.runs / recipe) for recipe in given.recipes}
    picture = Image.fromarray(sheet(pg.load_scene(given.scene), runs, given.view))
    picture.save(given.out, quality=90)


if __name__ == "__main__":
    main()
