"""Draw pictures of the front page: a held-out view by three recipes next to the ground truth, and a film of all layers.

    polarguide synth benchmarks/front/tea.json --size 192x144 --samples 12 --out SCENE
    for recipe in 3dgs 3dgs-dr polarguide-stokes; do
      polarguide train SCENE --steps 2000 --recipe $recipe --out RUNS/$recipe
    done
    python benchmarks/front/front_pictures.py SCENE RUNS --view v016

Writes ``docs/images/front.jpg`` and ``docs/images/front.webp``. With ``--control RUN``, a training without
polarization, it writes only the pairs of the gallery to ``docs/_static/scenes``. Pictures have the size of the scene's
pictures, at any size of the training.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import polarguide as pg
from polarguide.geometry.camera import Camera
from polarguide.geometry.trajectory import orbit
from polarguide.visualization.figures import Picture, contact_sheet, ground_truth_pictures, layer_picture

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
PAGES = IMAGES.parent / "_static" / "scenes"
RECIPES = ("3dgs", "3dgs-dr", "polarguide-stokes")
LAYERS = {"final": "picture", "specular": "specular", "diffuse": "diffuse", "normal": "normals"}
FRAMES_PER_SECOND = 12
HOLD, WIPE = 14, 16
"""Frames with one layer, and frames of a transition to the next one."""


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


def write_pairs(scene: pg.Scene, ours: pg.Run, control: pg.Run, name: str, folder: Path) -> None:
    """Write a held-out view as JPEG files: the photograph and ours, and each layer without and with polarization."""
    view = scene.view(name)
    with_it, without = drawn(ours, view.camera), drawn(control, view.camera)
    pairs = {layer: (without[layer], with_it[layer]) for layer in LAYERS}
    pairs["final"] = (ground_truth_pictures(view)["final"], with_it["final"])
    for layer, pair in pairs.items():
        for side, picture in zip(("left", "right"), pair, strict=True):
            assert picture is not None
            Image.fromarray(picture).save(folder / f"wipe-{layer}-{side}.jpg", quality=88)


def absent(width: int, height: int) -> Picture:
    """Return the tile of a missing layer."""
    image = Image.new("RGB", (width, height), "#eeeeee")
    ImageDraw.Draw(image).text(
        (width / 2, height / 2), "none", font=ImageFont.load_default(18), fill="#777777", anchor="mm"
    )
    return np.asarray(image)


def film(run: pg.Run, size: tuple[int, int]) -> Iterator[Picture]:
    """Yield the frames of a film around the scene. Each layer covers the previous one from the left."""
    layers = tuple(LAYERS)
    cycle = HOLD + WIPE
    first = next(iter(run.cameras.values()))
    cameras = orbit(list(run.cameras.values()), cycle * len(layers))
    for number, camera in enumerate(cameras):
        pictures = drawn(run, camera.scaled(size[0] / first.width, *size))
        place, within = divmod(number, cycle)
        below, above = layers[place], layers[(place + 1) % len(layers)]
        edge = round(size[0] * max(0, within - HOLD + 1) / WIPE)
        yield wiped(pictures, below, above, edge)


def named(picture: Picture | None, name: str) -> Picture:
    """Return a picture with its name in the upper left corner."""
    assert picture is not None
    image = Image.fromarray(picture)
    ImageDraw.Draw(image).text(
        (10, 8), name, font=ImageFont.load_default(20), fill="white", stroke_width=2, stroke_fill="black"
    )
    return np.array(image)


def wiped(pictures: dict[str, Picture | None], below: str, above: str, edge: int) -> Picture:
    """Join one layer to the right of a column and another one to the left of it, with their names."""
    frame = named(pictures[below], LAYERS[below])
    frame[:, :edge] = named(pictures[above], LAYERS[above])[:, :edge]
    if 0 < edge < frame.shape[1]:
        frame[:, edge - 1 : edge + 1] = 255
    return frame


def write_film(path: Path, frames: Sequence[Picture], quality: int) -> None:
    """Write an animated WebP file that repeats forever."""
    first, *others = (Image.fromarray(frame) for frame in frames)
    first.save(
        path, save_all=True, append_images=others, loop=0, duration=round(1000 / FRAMES_PER_SECOND),
        quality=quality, method=6,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("runs", type=Path, help="a folder with a run of each recipe, by its name")
    parser.add_argument("--view", required=True, help="a held-out view")
    parser.add_argument("--size", type=int, nargs=2, default=(448, 336), help="of the film")
    parser.add_argument("--quality", type=int, default=65, help="of the film")
    parser.add_argument("--no-film", action="store_true", help="draw the sheet alone")
    parser.add_argument("--control", type=Path, help="a run of polarguide-stokes:unpolarized")
    parser.add_argument("--out", type=Path, default=IMAGES)
    given = parser.parse_args()
    if given.control is not None:
        ours, control = pg.open_run(given.runs / RECIPES[-1]), pg.open_run(given.control)
        write_pairs(pg.load_scene(given.scene), ours, control, given.view, PAGES)
        return
    runs = {recipe: pg.open_run(given.runs / recipe) for recipe in RECIPES}
    picture = Image.fromarray(sheet(pg.load_scene(given.scene), runs, given.view))
    picture.save(given.out / "front.jpg", quality=90)
    if given.no_film:
        return
    frames = list(film(runs["polarguide-stokes"], tuple(given.size)))
    write_film(given.out / "front.webp", frames, given.quality)
    for name in ("front.jpg", "front.webp"):
        print(f"{given.out / name}: {(given.out / name).stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
