"""Compare kinds of capture of one object: four angles, single shots, brackets and mosaics, with a sensor's noise.

    python benchmarks/accuracy/capture_kinds.py scene WORK
    polarguide synth WORK/lamps.json --out WORK/truth --size 128x96 --samples 128 --ground-truth all \\
        --sensor IMX250MYR --noise 1 --exposures 0,-3,-6
    python benchmarks/accuracy/capture_kinds.py files WORK
    for seed in 0 1; do for kind in single four four-bracket mosaic; do
      python benchmarks/accuracy/capture_kinds.py train WORK --kind $kind --seed $seed
    done; done
    python benchmarks/accuracy/capture_kinds.py record WORK

The scene is the preset ``glossy`` with three bright lamps. A camera with a filter measures the same light as the
polarization camera, with the same noise, bits and full scale. Raw mosaics also contain noise of the rendering. All runs
are scored on the exact light of the same held-out views. The last command writes
``benchmarks/records/capture-kinds.json`` and ``docs/images/capture-kinds.jpg``, and prints the table of
``docs/how-to/capture.md``.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

import polarguide as pg
from polarguide.capture import View
from polarguide.capture.formats.pictures import FULL_CODE
from polarguide.capture.view import ANGLES
from polarguide.capture.write import write_png_file
from polarguide.core.files import write_text
from polarguide.optics.color import srgb_encode_array
from polarguide.visualization.figures import (
    Picture,
    contact_sheet,
    ground_truth_pictures,
    layer_picture,
    radiance_to_rgb,
)
from polarguide_synth.sensor import Sensor, behind_filter, exposure_suffix, noisy
from polarguide_synth.settings import find_scene

ROOT = Path(__file__).resolve().parents[2]
RECORD = ROOT / "benchmarks" / "records" / "capture-kinds.json"
FIGURE = ROOT / "docs" / "images" / "capture-kinds.jpg"
TRAINING = "v009"
"""Training view whose files the figure shows."""
HELD_OUT = "v008"
"""Held-out view whose layers the figure shows."""
TILE = 256
"""Width of a picture in the figure."""
BRIGHTER = 3.0
"""Factor on the brightness of the specular layers in the figure."""
PRESET = "glossy"
VIEWS = 40
EXPOSURE = 1.4
"""Display value of the radiance 1."""
LAMPS = ((1.2, -1.6, 3.6), (-1.6, 1.4, 3.2), (1.9, 1.3, 3.5))
"""Positions of the lamps."""
LAMP_SIZE = 0.35
LAMP_RADIANCE = (420.0, 393.0, 352.0)
BRACKET = (0.0, -3.0, -6.0)
"""Exposures of a bracket in stops."""
TURN = 60
"""Degrees between the filter angles of two successive single shots."""
SENSOR = Sensor()


@dataclass(frozen=True)
class Kind:
    """Kind of a capture.

    Attributes:
        title: name in the table.
        angles: number of filter angles of a view, or 0 for mosaics.
        stops: exposures in stops.
    """

    title: str
    angles: int
    stops: Sequence[float] = (0.0,)

    @property
    def files(self) -> int:
        """Number of files of each view."""
        return max(1, self.angles) * len(self.stops)

    def names(self, view: str, number: int) -> Iterator[tuple[str, float, int]]:
        """Yield name, exposure in stops and filter angle of each file of a view."""
        turned = ANGLES if self.angles == len(ANGLES) else (TURN * number % 180,)
        for stop, suffix in zip(self.stops, exposure_suffix(self.stops), strict=True):
            for angle in turned if self.angles else (0,):
                label = f"_{angle}" if self.angles else ""
                yield f"{view}{label}{suffix}.png", stop, angle


KINDS = {
    "single": Kind("one angle", 1),
    "four": Kind("four angles", 4),
    "four-bracket": Kind("bracket of four angles", 4, BRACKET),
    "mosaic": Kind("mosaic", 0),
}


def write_scene(work: Path) -> None:
    """Write the scene file: the preset with lamps."""
    data = find_scene(PRESET).data()
    data["camera"]["views"] = VIEWS
    data["exposure"] = EXPOSURE
    data["lights"] = [
        {"position": place, "toward": [0, 0, 0], "size": [LAMP_SIZE] * 2, "radiance": LAMP_RADIANCE}
        for place in LAMPS
    ]
    work.mkdir(parents=True, exist_ok=True)
    (work / "lamps.json").write_text(json.dumps(data), encoding="utf-8")


def write_files(work: Path) -> None:
    """Write the files that each kind of camera stores of all views."""
    truth = work / "truth"
    for number, view in enumerate(pg.load_scene(truth).views):
        with np.load(truth / "gt" / f"{view.name}.npz") as arrays:
            stokes = arrays["stokes"].astype(np.float64)
        rays = view.camera.rays(dtype=torch.float64).numpy()
        random = np.random.default_rng(number)
        for name, kind in KINDS.items():
            folder = work / name / "files"
            folder.mkdir(parents=True, exist_ok=True)
            for file, stop, angle in kind.names(view.name, number):
                if kind.angles:
                    light = 2.0**stop * behind_filter(stokes, rays, angle)
                    write_png_file(folder / file, sensor_codes(noisy(light, 1.0, random, SENSOR)))
                else:
                    raw = exposure_suffix(BRACKET)[BRACKET.index(stop)]
                    shutil.copy(truth / "raw" / f"{view.name}{raw}.png", folder / file)


def sensor_codes(light: NDArray[np.float64]) -> NDArray[np.uint16]:
    """Return intensities with the bits of the sensor, as 16-bit codes."""
    steps = (1 << SENSOR.bits) - 1
    rounded = np.rint(np.clip(light, 0, 1) * steps) / steps
    return np.rint(rounded * FULL_CODE).astype(np.uint16)


def preparation(work: Path, kind: Kind) -> list[str]:
    """Return the options of ``polarguide prepare``."""
    options = ["--poses", str(work / "truth")]
    if kind.angles:
        return [*options, "--transfer", "linear", "--gains", "none"]  # The exposure is locked.
    calibration = str(work / "truth" / "calibration.json")
    sensor = ["--sensor", "IMX250MYR", "--bits", str(SENSOR.bits), "--black-level", str(SENSOR.black)]
    return [*options, *sensor, "--calibration", calibration]


def cpu_seconds(arguments: Sequence[str | Path]) -> float:
    """Run polarguide, and return the CPU seconds that it took."""
    command = [sys.executable, "-m", "polarguide", *map(str, arguments)]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def train(work: Path, name: str, seed: int, steps: int) -> None:
    """Prepare and train a kind of capture with the default recipe, and write the scores of the run."""
    folder = work / name
    run = folder / f"run-{seed}"
    files = folder / "files"
    prepared = cpu_seconds(["prepare", files, "--out", folder / "scene", *preparation(work, KINDS[name])])
    options = ["--steps", str(steps), "--seed", str(seed), "--threads", "1", "--device", "cpu"]
    trained = cpu_seconds(["train", folder / "scene", "--out", run, *options])
    times = {"prepare_seconds": prepared, "train_seconds": trained}
    (run / "scores.json").write_text(json.dumps(times | scores(work, name, run)), encoding="utf-8")


METRICS = (
    *("psnr_seen", "specular_psnr", "specular_psnr_aligned", "diffuse_psnr", "normal_mae_deg"),
    *("stokes_error_seen", "seen_share"),
)


def scored_run(work: Path, name: str, run: Path) -> pg.Run:
    """Open a run whose held-out views are those of the ground truth, without noise or missing angles.

    The ground truth is converted to the unit of the prepared scene, in which the gains of a sensor are at most 1.
    """
    truth = pg.load_scene(work / "truth")
    scene = pg.load_scene(work / name / "scene")
    scale = json.loads((scene.root / "scene.json").read_text(encoding="utf-8"))["scale"]
    views = [
        scaled(truth.view(view.name), scale) if view.name in scene.test_names else view
        for view in scene.views
    ]
    return pg.open_run(run, scene=replace(scene, views=tuple(views), objects=truth.objects), device="cpu")


def scaled(view: View, scale: float) -> View:
    """Return a rendered view whose light is multiplied by a factor of at most 1."""
    truth = view.ground_truth
    codes = (view.codes.float() * scale).round().to(view.codes.dtype)
    lobes = {name: scale * getattr(truth, name) for name in ("specular", "diffuse")}
    return replace(view, pictures=codes, truth=replace(truth, **lobes))


def scores(work: Path, name: str, folder: Path) -> dict[str, float]:
    """Score a run on the ground truth.

    The value ``highlights`` is the rendered light of clipped foreground pixels as a share of the true light.
    """
    run = scored_run(work, name, folder)
    metrics = run.evaluate(speed=False)
    rendered = 0.0
    true = 0.0
    for view in run.scene.test_views:
        lobes = view.ground_truth
        light = (lobes.specular + lobes.diffuse) / 2
        clipped = lobes.mask & (light.mean(dim=-1) > 1)
        rendered += float(run.render(view.camera)["final"][clipped].sum())
        true += float(light[clipped].sum())
    return {**{key: metrics[key] for key in METRICS}, "highlights": rendered / true}


def table(record: dict[str, Any]) -> list[str]:
    """Return the lines of the table of ``docs/how-to/capture.md``: means over the seeds of each kind."""
    lines = [
        "| capture | files per view | picture | specular | diffuse | normals | highlights | CPU time |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for name, kind in KINDS.items():
        runs = [run for key, run in record["runs"].items() if key.rpartition("-")[0] == name]
        mean = {key: float(np.mean([run[key] for run in runs])) for key in runs[0]}
        decibels = [f"{mean[key]:.1f} dB" for key in ("psnr_seen", "specular_psnr", "diffuse_psnr")]
        normals = f"{mean['normal_mae_deg']:.1f}°"
        # Only the first run of a kind prepares the files. Later runs check the finished scene.
        seconds = max(run["prepare_seconds"] for run in runs) + mean["train_seconds"]
        cells = (*decibels, normals, f"{100 * mean['highlights']:.0f} %", f"{seconds:.0f} s")
        lines.append(f"| {' | '.join((kind.title, str(kind.files), *cells))} |")
    return lines


def write_record(work: Path) -> None:
    """Collect the scores of all runs in the record, draw the figure, and print the table."""
    runs = {
        f"{folder.parent.name}-{folder.name.removeprefix('run-')}": json.loads(
            (folder / "scores.json").read_text()
        )
        for folder in sorted(work.glob("*/run-*"))
    }
    run = pg.open_run(next(work.glob("*/run-*")))
    commit = run.metrics()["provenance"]["commit"]
    record = {"steps": run.steps, "commit": commit, "runs": runs}
    write_text(RECORD, json.dumps(record, indent=1) + "\n")
    Image.fromarray(figure(work)).save(FIGURE, quality=80)
    print("\n".join(table(record)))


def files_picture(work: Path, name: str, view: str, number: int) -> Picture:
    """Return the files of a training view as one picture with rows of equal length."""
    kind = KINDS[name]
    full = FULL_CODE if kind.angles else (1 << SENSOR.bits) - 1
    tiles = []
    for file, _, _ in kind.names(view, number):
        codes = cv2.imread(str(work / name / "files" / file), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR)
        tiles.append(np.rint(255 * srgb_encode_array(codes[..., ::-1] / full)).astype(np.uint8))
    columns = math.ceil(len(tiles) ** 0.5)
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
    return np.vstack([np.hstack(tiles[k : k + columns]) for k in range(0, len(tiles), columns)])


def enlarged(picture: Picture) -> Picture:
    """Return a picture at the width of a tile."""
    height = round(TILE * picture.shape[0] / picture.shape[1])
    return np.asarray(Image.fromarray(picture).resize((TILE, height), Image.Resampling.BICUBIC))


def figure(work: Path) -> Picture:
    """Draw the files of a training view, and the specular layer and the normals of the next held-out view."""
    truth = pg.load_scene(work / "truth")
    view = truth.view(HELD_OUT)
    number = [each.name for each in truth.views].index(TRAINING)
    columns = {"truth": ground_truth_pictures(view)}
    columns["truth"]["specular"] = radiance_to_rgb(BRIGHTER * view.ground_truth.specular / 2)
    for name in KINDS:
        run = scored_run(work, name, work / name / "run-0")
        result = run.result(view.camera)
        columns[name] = {
            "specular": radiance_to_rgb(BRIGHTER * result.layers["specular"]),
            "normal": layer_picture(result, "normal", view.camera),
            "files": files_picture(work, name, TRAINING, number),
        }
    columns["truth"]["files"] = radiance_to_rgb(truth.view(TRAINING).photograph())
    rows = ("files", "specular", "normal")
    titles = ["truth", *(kind.title for kind in KINDS.values())]
    pictures = [[enlarged(column[row]) for column in columns.values()] for row in rows]
    return contact_sheet(pictures, ["files", "specular", "normals"], titles, minimum_width=256)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("action", choices=("scene", "files", "train", "record"))
    parser.add_argument("work", type=Path, help="folder of the ground truth and of all runs")
    parser.add_argument("--kind", choices=tuple(KINDS), default="four")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=1500)
    options = parser.parse_args()
    if options.action == "scene":
        write_scene(options.work)
    elif options.action == "files":
        write_files(options.work)
    elif options.action == "train":
        train(options.work, options.kind, options.seed, options.steps)
    else:
        write_record(options.work)


if __name__ == "__main__":
    main()
