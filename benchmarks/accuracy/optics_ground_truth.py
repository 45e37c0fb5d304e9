"""Measure the accuracy of the polarization optics on rendered scenes with known normals and layers.

Usage: python benchmarks/accuracy/optics_ground_truth.py SCENES_DIR [--scenes ...] > benchmarks/records/optics.md

Each scene folder contains ``polar/VIEW_ANGLE.png`` (linear, 16 bits), ``gt/VIEW.npz`` (world ``normal``,
``mask``, and ``specular`` and ``diffuse`` in units of S0), ``sparse/0`` (COLMAP text) and ``split.json`` with
the test views. Prints a Markdown table of means over the test views of the scene's foreground.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from polarguide import optics
from polarguide.geometry.camera import Camera
from polarguide.optics.color import shown

THRESHOLD = 0.05
WATER_INDEX = 1.33


class View(NamedTuple):
    """A test view: [3, H, W, 3] Stokes, rays and true normals in camera axes, mask, true layers."""

    stokes: Tensor
    rays: Tensor
    normals: Tensor
    mask: Tensor
    specular: Tensor
    diffuse: Tensor


def read_cameras(sparse: Path) -> dict[str, Camera]:
    """Return cameras by view name from a COLMAP text model with one PINHOLE camera."""
    rows = [line for line in (sparse / "cameras.txt").read_text().splitlines() if line[:1] != "#"]
    fields = rows[0].split()
    width, height = int(fields[2]), int(fields[3])
    fx, fy, cx, cy = map(float, fields[4:8])
    cameras = {}
    lines = [line for line in (sparse / "images.txt").read_text().splitlines() if line[:1] != "#"]
    for line in lines[::2]:
        w, x, y, z, *translation = map(float, line.split()[1:8])
        rotation = torch.tensor(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ],
            dtype=torch.float64,
        )
        pose = (rotation, torch.tensor(translation, dtype=torch.float64))
        cameras[Path(line.split()[9]).stem] = Camera(width, height, fx, fy, cx, cy, *pose)
    return cameras


def read_view(scene: Path, name: str, camera: Camera) -> View:
    """Return a test view in float64."""
    images = [cv2.imread(str(scene / "polar" / f"{name}_{a:03d}.png"), -1) for a in optics.ANGLES]
    intensities = torch.from_numpy(np.stack(images)[..., ::-1] / 65535.0)
    with np.load(scene / "gt" / f"{name}.npz") as ground_truth:
        arrays = {
            key: torch.from_numpy(ground_truth[key].astype(np.float64))
            for key in ("normal", "specular", "diffuse")
        }
        mask = torch.from_numpy(ground_truth["mask"])
    normals = torch.nn.functional.normalize(camera.to_camera(arrays["normal"]), dim=-1)
    rays = camera.rays(dtype=torch.float64)
    return View(optics.stokes(intensities), rays, normals, mask, arrays["specular"], arrays["diffuse"])


def psnr(layer: Tensor, ground_truth: Tensor, mask: Tensor) -> float:
    """Return the PSNR in dB of a layer on display (S/2, sRGB) over the mask."""
    difference = shown(layer[mask] / 2) - shown(ground_truth[mask] / 2)
    return -10 * math.log10(float((difference**2).mean()))


def angle(a: Tensor, b: Tensor) -> Tensor:
    """Return the angle between unit vectors in degrees."""
    return torch.rad2deg(torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1)))


def fold(difference: Tensor, period: float) -> Tensor:
    """Return the size of an angle difference modulo ``period``, in degrees."""
    return torch.rad2deg(((difference + period / 2) % period - period / 2).abs())


def score(view: View, refractive_index: float) -> dict[str, float]:
    """Return all numbers of one view."""
    luminance = optics.luminance(view.stokes)
    degree, true_zenith = optics.dolp(luminance), optics.zenith(view.normals, view.rays)
    pixels = view.mask & optics.polarization_mask(luminance, threshold=THRESHOLD)
    model = optics.luminance(
        optics.predicted_stokes(view.specular, view.diffuse, view.normals, view.rays, refractive_index)
    )
    azimuth_error = fold(optics.aolp(luminance) - optics.azimuth(view.normals, view.rays), math.pi / 2)[
        pixels
    ]
    aolp_error = fold(optics.aolp(luminance) - optics.aolp(model), math.pi)[pixels]
    exact = optics.exact_separation(view.stokes, view.normals, view.rays, refractive_index)
    cue_zenith = optics.diffuse_zenith(degree, refractive_index)
    result = {
        "median DoLP": float(degree[view.mask].median()),
        "azimuth error modulo 90, mean": float(azimuth_error.mean()),
        "azimuth error modulo 90, median": float(azimuth_error.median()),
        "AoLP error, median": float(aolp_error.median()),
        "DoLP error, median": float((degree - optics.dolp(model))[view.mask].abs().median()),
        "specular PSNR exact, conditioned": psnr(
            exact.specular, view.specular, view.mask & exact.conditioned
        ),
        "specular PSNR exact": psnr(exact.specular, view.specular, view.mask),
        "diffuse PSNR exact": psnr(exact.diffuse, view.diffuse, view.mask),
        "specular PSNR paper, true zenith": psnr(
            optics.paper_separation(view.stokes, true_zenith, refractive_index).specular,
            view.specular,
            view.mask,
        ),
        "specular PSNR paper": psnr(
            optics.paper_separation(view.stokes, cue_zenith, refractive_index).specular,
            view.specular,
            view.mask,
        ),
        "specular PSNR of nothing": psnr(torch.zeros_like(view.specular), view.specular, view.mask),
    }
    for label, candidates in (
        ("four", optics.paper_candidates(luminance, view.rays, refractive_index)),
        ("six", optics.physical_candidates(luminance, view.rays, refractive_index)),
    ):
        error = angle(optics.disambiguate(candidates, view.normals).normal, view.normals)[pixels]
        result[f"best of {label}, mean"] = float(error.mean())
        result[f"best of {label}, median"] = float(error.median())
    return result | color_scores(view, true_zenith, refractive_index)


def color_scores(view: View, true_zenith: Tensor, refractive_index: float) -> dict[str, float]:
    """Return the frequency and accuracy of normals from the polarization of color differences.

    The true normal resolves the ambiguity of half a turn, as in the other rows.
    """
    found = optics.chromatic_normals(view.stokes, refractive_index)
    where = view.mask & found.decided
    turn = fold(found.azimuth - optics.azimuth(view.normals, view.rays), math.pi)
    two = torch.stack(
        [optics.normal_from_angles(found.zenith, found.azimuth + t, view.rays) for t in (0.0, math.pi)],
        dim=-2,
    )
    error = angle(optics.disambiguate(two, view.normals).normal, view.normals)[where]
    wrong = (turn > 45) & where & (true_zenith > math.radians(15))
    return {
        "color: share of mask decided, percent": 100 * float(where.sum() / view.mask.sum()),
        "color: of those the wrong lobe, percent": 100 * float(wrong.sum() / where.sum()),
        "color: normal error, mean": float(error.mean()),
        "color: normal error, median": float(error.median()),
    }


def main() -> None:
    """Score all test views and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes_dir", type=Path)
    parser.add_argument("--scenes", nargs="+", default=["spheres", "cup", "car", "water"])
    parser.add_argument("--refractive-index", type=float, help=f"default: 1.5, and {WATER_INDEX} for water")
    arguments = parser.parse_args()
    if arguments.refractive_index is not None and not arguments.refractive_index > 1:
        parser.error(f"--refractive-index: expected more than 1, found {arguments.refractive_index}")
    columns: dict[str, dict[str, float]] = {}
    for name in arguments.scenes:
        scene = arguments.scenes_dir / name
        refractive_index = arguments.refractive_index or (WATER_INDEX if name == "water" else 1.5)
        cameras = read_cameras(scene / "sparse" / "0")
        tests = json.loads((scene / "split.json").read_text())["test"]
        scores = [score(read_view(scene, view, cameras[view]), refractive_index) for view in tests]
        columns[name] = {key: float(np.mean([s[key] for s in scores])) for key in scores[0]}
    print("| |", " | ".join(columns), "|\n|---|" + "---|" * len(columns))
    for key in next(iter(columns.values())):
        digits = 3 if "DoLP" in key and "AoLP" not in key else 1
        print(f"| {key} |", " | ".join(f"{column[key]:.{digits}f}" for column in columns.values()), "|")


if __name__ == "__main__":
    main()
