"""Make the files of the gallery: shared pages, pictures, sheets of layers, and a film under other light.

    python benchmarks/front/gallery.py commands    # print the commands that render and train the scenes of gallery.json
    python benchmarks/front/gallery.py files RUNS

The second command reads the scored runs ``RUNS/NAME/page``, ``polarguide-stokes``,
``polarguide-stokes_unpolarized`` and ``3dgs``. It writes ``docs/_static/scenes`` and the scores of the pages,
``benchmarks/records/gallery.json``, and prints the table of ``docs/gallery.md``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
import torch
from front_pictures import absent, drawn
from PIL import Image, ImageDraw, ImageFont

import polarguide as pg
from polarguide.core.files import write_text
from polarguide.geometry.camera_path import orbit
from polarguide.results.export.placement import Presented
from polarguide.results.rendering.relight import write_hdr
from polarguide.visualization.figures import (
    Picture,
    clipping_exposure,
    ground_truth_pictures,
    layer_picture,
    radiance_to_rgb,
)
from polarguide_synth.textures import make_environment

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
PAGES = ROOT / "docs" / "_static" / "scenes"
RECORD = ROOT / "benchmarks" / "records" / "gallery.json"
STEPS = 2500
RECIPES = ("3dgs", "polarguide-stokes:unpolarized", "polarguide-stokes")
"""Recipes in the columns of a sheet, after the photograph. docs/_static/wipes.js has the same order."""
ROWS = ("final", "specular", "normal")
"""Layers in the rows of a sheet."""
BRIGHTEST = 16.0
"""Largest factor on the brightness of the specular layers of a sheet, as on shared pages."""
ENLARGED = 2
"""Factor of the size of the sheets' pictures."""
PICTURE = (384, 288)
"""Width and height of the picture that opens a page."""
TILE = (192, 144)
"""Width and height of a picture in the film."""
FRAMES = 48
FRAMES_PER_SECOND = 10
QUALITY = 80
SCORES = ("psnr", "normal_mae_deg", "specular_psnr", "diffuse_psnr")


class GalleryScene(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A scene of the gallery.

    Attributes:
        name: name of its folder, and of the preset that renders it.
        title, about: heading of its page, and a description.
        gaussians: limit of Gaussians for a page of about 1.5 MB.
        view: the held-out view in the sheet.
        downscale: factor of the reduction in trainings.
        render: options of ``polarguide synth``. Scenes without them come from another program.
    """

    name: str
    title: str
    about: str
    gaussians: int
    view: str
    downscale: int = 1
    render: str = ""


class Gallery(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The scenes, and environments by name for the scenes of the film. ``make_environment`` reads the environments."""

    scenes: list[GalleryScene]
    relit: list[str]
    panoramas: dict[str, dict[str, Any]]


def commands(scene: GalleryScene) -> Iterator[str]:
    """Yield the commands that render a scene, train its four runs and score them."""
    if scene.render:
        yield f"polarguide synth {scene.name} --out SCENES/{scene.name} {scene.render}"
    trainings = {recipe.replace(":", "_"): f"--recipe {recipe}" for recipe in RECIPES}
    trainings["page"] = f"--gaussians {scene.gaussians}"
    for name, options in trainings.items():
        folder = f"RUNS/{scene.name}/{name}"
        yield (
            f"polarguide train SCENES/{scene.name} --out {folder} {options} "
            f"--downscale {scene.downscale} --steps {STEPS}"
        )
        yield f"polarguide eval {folder}"


def sheet(runs: Path, scene: GalleryScene) -> Image.Image:
    """Draw a held-out view: a column for the photograph and each recipe, a row for each layer, without gaps.

    The specular layers are brighter by a common factor, at which less than 1 % of the ground truth clips.
    """
    opened = [pg.open_run(runs / recipe.replace(":", "_")) for recipe in RECIPES]
    view = opened[0].scene.view(scene.view)
    assert view.ground_truth is not None
    assert view.ground_truth.specular is not None
    gloss = view.ground_truth.specular / 2
    factor = BRIGHTEST * clipping_exposure(BRIGHTEST * gloss)
    columns = [{**ground_truth_pictures(view), "specular": radiance_to_rgb(factor * gloss)}]
    for run in opened:
        result = run.result(view.camera)
        column = {layer: layer_picture(result, layer, view.camera) for layer in ROWS}
        if "specular" in result.layers:
            column["specular"] = radiance_to_rgb(factor * result.layers["specular"])
        columns.append({name: picture for name, picture in column.items() if picture is not None})
    none = absent(view.camera.width, view.camera.height)
    rows = [np.hstack([column.get(layer, none) for column in columns]) for layer in ROWS]
    picture = Image.fromarray(np.vstack(rows))
    return picture.resize((ENLARGED * picture.width, ENLARGED * picture.height), Image.Resampling.BICUBIC)


def write_page(run: pg.Run, scene: GalleryScene) -> dict[str, float]:
    """Set the credit of a run, write its page and the picture that opens it, and return its row of the record."""
    pg.present(
        run.folder,
        title=scene.title,
        author="The polarguide authors",
        license="Apache-2.0",
        provenance="rendered with Mitsuba, textures and surroundings by our programs",
    )
    run = pg.open_run(run.folder)
    page = run.share(PAGES / f"{scene.name}.html", caption=scene.about)
    camera = run.cameras[scene.view]
    picture = drawn(run, camera.scaled(PICTURE[0] / camera.width, *PICTURE))["final"]
    assert picture is not None
    Image.fromarray(picture).save(PAGES / f"{scene.name}.jpg", quality=QUALITY)
    return {
        **{key: run.metrics()[key] for key in SCORES},
        "gaussians": len(Presented(run).gaussians["means"]),
        "bytes": page.stat().st_size,
    }


def film(runs: list[Path], panoramas: Mapping[str, Mapping[str, Any]]) -> Iterator[Picture]:
    """Yield frames of a turn around scenes, one in each row, under one panorama in each column.

    The first row shows the panoramas.
    """
    opened = []
    heading = []
    with TemporaryDirectory() as folder:
        for name, data in panoramas.items():
            radiance = torch.tensor(make_environment(dict(data), name, Path(folder)))
            write_hdr(Path(folder) / "panorama.hdr", radiance)
            opened.append([pg.open_run(run) for run in runs])
            for run in opened[-1]:
                run.relight(Path(folder) / "panorama.hdr")
            small = Image.fromarray(radiance_to_rgb(radiance)).resize((TILE[0], TILE[0] // 2))
            heading.append(named(np.array(small), name))
    for number in range(FRAMES):
        rows = [np.hstack(heading)]
        for row in zip(*opened, strict=True):
            cameras = list(row[0].cameras.values())
            camera = orbit(cameras, FRAMES)[number].scaled(TILE[0] / cameras[0].width, *TILE)
            rows.append(np.hstack([layer_picture(run.result(camera), "final", camera) for run in row]))
        yield np.vstack(rows)


def named(picture: Picture, name: str) -> Picture:
    """Return a picture with its name in the upper left corner."""
    image = Image.fromarray(picture)
    ImageDraw.Draw(image).text(
        (6, 4), name, font=ImageFont.load_default(14), fill="white", stroke_width=2, stroke_fill="black"
    )
    return np.array(image)


def write_film(path: Path, frames: Sequence[Picture], quality: int) -> None:
    """Write an animated WebP file that repeats forever."""
    first, *others = (Image.fromarray(frame) for frame in frames)
    first.save(
        path, save_all=True, append_images=others, loop=0, duration=round(1000 / FRAMES_PER_SECOND),
        quality=quality, method=6,
    )  # fmt: skip


def table_row(scene: GalleryScene, scores: Mapping[str, float]) -> str:
    """Return the row of a scene in the table of ``docs/gallery.md``."""
    cells = (
        scene.title.lower(),
        f"{scores['psnr']:.1f} dB",
        f"{scores['normal_mae_deg']:.1f}°",
        f"{scores['specular_psnr']:.1f} dB",
        f"{scores['diffuse_psnr']:.1f} dB",
        f"{scores['gaussians']:,}",
        f"{scores['bytes'] / 1e6:.1f} MB",
    )
    return f"| {' | '.join(cells)} |"


def write_files(gallery: Gallery, runs: Path) -> None:
    """Write all files of the gallery, and print the table of its scenes."""
    record = {}
    for scene in gallery.scenes:
        folder = runs / scene.name
        sheet(folder, scene).save(PAGES / f"{scene.name}-layers.jpg", quality=QUALITY)
        record[scene.name] = write_page(pg.open_run(folder / "page"), scene)
        print(table_row(scene, record[scene.name]))
    write_text(RECORD, json.dumps(record, indent=1) + "\n")
    relit = [runs / name / "polarguide-stokes" for name in gallery.relit]
    write_film(PAGES / "relight.webp", list(film(relit, gallery.panoramas)), quality=60)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("action", choices=("commands", "files"))
    parser.add_argument("runs", type=Path, nargs="?", help="a folder with the runs of each scene")
    given = parser.parse_args()
    gallery = msgspec.json.decode((HERE / "gallery.json").read_bytes(), type=Gallery)
    if given.action == "commands":
        print("\n".join(command for scene in gallery.scenes for command in commands(scene)))
    elif given.runs is None:
        parser.error("files: expected the folder of the runs")
    else:
        write_files(gallery, given.runs)


if __name__ == "__main__":
    main()
