"""Measure the gains and poses that ``prepare`` estimates for single shots through a filter.

Each view of a scene with four pictures becomes one JPEG photograph, as by ``polarguide synth --sensor filter``: a
random angle of the filter, and a random exposure up to 0.3 stops off. The photographs are prepared, and the results are
compared with the exposures and with the poses of the scene.

    python benchmarks/accuracy/filter_shots.py SCENES WORK --real CAPTURE > benchmarks/records/filter-shots.md

SCENES contains the rendered scenes cup and spheres, and CAPTURE is wwbottle. Its pictures keep one exposure. Errors of
gains are relative to the geometric mean of the gains of all views, because the common factor has no meaning.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from pose_error import compare_poses
from simulated_mosaics import linear_intensities

from polarguide.capture.colmap.model import read_model
from polarguide.capture.layout import find_layout
from polarguide.core.errors import PolarguideError
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings
from polarguide_synth.sensor import Sensor, filter_jpeg, plan_shot

SEED = 0


@dataclass(frozen=True)
class Photographer:
    """Settings of simulated photographs.

    Attributes:
        filtered: False to photograph without a filter.
        automatic: False to expose all photographs equally.
        noted: True if the files state their exposures.
        noise: amount of noise, as for ``polarguide synth``.
    """

    filtered: bool = True
    automatic: bool = False
    noted: bool = False
    noise: float = 0.0

    def photograph(self, scene: Path, out: Path) -> dict[str, float]:
        """Write a photograph of each view of a scene, and return their exposures in stops by view."""
        layout = find_layout(scene)
        model = read_model(scene)
        out.mkdir(parents=True)
        stops = {}
        for number, view in enumerate(layout.names):
            i0, i45, i90, i135 = linear_intensities(layout, view, "linear")
            stokes = np.stack([(i0 + i45 + i90 + i135) / 2, i0 - i90, i45 - i135])
            shot = replace(plan_shot(SEED, number), noted=self.noted)
            if not self.automatic:
                shot = replace(shot, stops=0.0)
            if not self.filtered:
                stokes[1:] = 0
            name = f"{view}_a{shot.body_angle}.jpg" if self.filtered else f"{view}.jpg"
            rays = model.camera(view).rays(dtype=torch.float64).numpy()
            random = np.random.default_rng((SEED, 31, number))
            (out / name).write_bytes(filter_jpeg(stokes, rays, shot, self.noise, random, Sensor()))
            stops[view] = shot.stops
        return stops


class Preparation:
    """A scene that ``prepare`` made of simulated photographs.

    Args:
        scene: folder with four pictures of each view, and a COLMAP model.
        photographer: settings of the photographs.
        poses: ``sfm``, or the folder of a model.
        work: new folder for photographs and the prepared scene.
    """

    def __init__(self, scene: Path, photographer: Photographer, poses: str, work: Path) -> None:
        self.reference = scene
        print(f"preparing {work}", file=sys.stderr, flush=True)
        self.stops = photographer.photograph(scene, work / "photographs")
        self.folder = work / "scene"
        settings = PrepareSettings(
            format="singles",
            angles=None if photographer.filtered else "none",
            poses=poses,
            poses_of="displayed" if poses != "sfm" else "auto",
        )
        try:
            prepare_scene(work / "photographs", self.folder, settings)
            self.posed = True
        except PolarguideError as error:
            print(error, file=sys.stderr)
            self.posed = False

    def gain_row(self, label: str) -> str:
        """Return a row of the table of gains."""
        with (self.folder / "angles.csv").open(encoding="utf-8", newline="") as file:
            gains = {row["view"]: float(row["gain"]) for row in csv.DictReader(file)}
        logs = np.array([math.log(gain) - math.log(2) * self.stops[view] for view, gain in gains.items()])
        errors = 100 * np.abs(np.expm1(logs - logs.mean()))
        return f"| {label} | {np.median(errors):.1f} % | {errors.max():.1f} % |"

    def pose_row(self, label: str) -> str:
        """Return a row of the table of poses."""
        if not self.posed:
            return f"| {label} | 0 of {len(self.stops)} | |"
        errors = compare_poses(read_model(self.folder), read_model(self.reference))
        turns = errors.rotations
        return f"| {label} | {len(turns)} of {errors.views} | {np.median(turns):.1f}, {turns.max():.1f} degrees |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", type=Path, help="folder of the scenes cup and spheres")
    parser.add_argument("work", type=Path, help="new folder for photographs and prepared scenes")
    parser.add_argument("--real", type=Path, required=True, help="the capture wwbottle")
    options = parser.parse_args()
    work = options.work
    cup = options.scenes / "cup"
    spheres = options.scenes / "spheres"
    gains = []
    poses = []
    for scene in (cup, spheres):
        for source, noted in (("exact EXIF", True), ("points of its model", False)):
            automatic = Photographer(automatic=True, noted=noted)
            prepared = Preparation(scene, automatic, str(scene), work / f"{scene.name} {source}")
            gains.append(prepared.gain_row(f"{scene.name}, {source}"))
    for scene in (cup, spheres):
        for kind, filtered in (("without filter", False), ("through the filter", True)):
            label = f"{scene.name}, {kind}"
            poses.append(Preparation(scene, Photographer(filtered), "sfm", work / label).pose_row(label))
    for scene, label, photographer in (
        (cup, "with noise and automatic exposure", Photographer(automatic=True, noise=1)),
        (options.real, "through the filter", Photographer()),
    ):
        prepared = Preparation(scene, photographer, "sfm", work / f"{scene.name} {label}")
        poses.append(prepared.pose_row(f"{scene.name}, {label}"))
        gains.append(prepared.gain_row(f"{scene.name}, points of structure from motion"))
    print("| scene and source of the gains | median error | largest error |\n|---|---|---|")
    print("\n".join(gains))
    print("\n| scene | registered of | rotation error, median and largest |\n|---|---|---|")
    print("\n".join(poses))


if __name__ == "__main__":
    main()
