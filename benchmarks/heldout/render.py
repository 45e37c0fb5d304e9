"""Render and prepare the scenes of the held-back half, and record or compare their checksums.

The scenes test a finished method. Do not look at them, and do not train on them, before the method is finished.
Each scene is rendered as raw mosaics with the noise and the 12 bits of a sensor. ``prepare`` develops the mosaics, so
it is part of the measurement. The ground truth and the held-out views of the rendering are added to the prepared scene.

    python benchmarks/heldout/render.py OUT [--scenes NAME ...] [--threads 1]

Writes OUT/rendered/NAME and the scene folder OUT/NAME. The same command resumes after Ctrl-C. ``checksums.json``
contains the SHA-256 of each rendering, which is the SHA-256 of its ``checksums.txt``. Missing values are added. A
difference is reported, and the exit status is then 1: processors with other instructions round differently. The
prepared scenes depend on the version of ``prepare``. Records of comparisons contain their digests.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path

import polarguide
from polarguide.capture.calibration import read_calibration
from polarguide.core.errors import PolarguideError
from polarguide.core.files import write_text
from polarguide.core.progress import SILENT
from polarguide.preparation.settings import PrepareSettings
from polarguide.raster import use_threads
from polarguide_synth.folder import scene_digest
from polarguide_synth.render import synthesize
from polarguide_synth.sensor import Sensor
from polarguide_synth.settings import SynthSettings, find_scene

HERE = Path(__file__).resolve().parent
CHECKSUMS = HERE / "checksums.json"
SCENES = ("workbench", "sideboard", "pantry", "picnic", "bathroom", "tortoise")
"""Held-back scenes, as names of scene files in this folder."""
USED = ("valve", "trophy")
"""Former held-back scenes. They showed a fault of the search for metals, and are development scenes since then."""
SYNTH = SynthSettings(size="128x96", samples=192, seed=80, sensor="IMX250MYR", noise=1.0, test_every=6)
"""Settings of the renderings. The size is that of the prepared pictures. The 48 views include 8 held-out views.

A sample of a mosaic has a quarter of the paths. With fewer paths, their noise clearly exceeds the noise of the sensor.
"""


def prepare_rendering(rendered: Path, out: Path) -> None:
    """Develop the mosaics of a rendering to a scene folder, and add its ground truth and held-out views."""
    sensor = Sensor()
    settings = PrepareSettings(
        sensor=SYNTH.sensor.upper(),
        bits=sensor.bits,
        black_level=float(sensor.black),
        poses=str(rendered),
        calibration=read_calibration(rendered / "calibration.json"),
    )
    polarguide.prepare(rendered / "raw", out, settings=settings)
    shutil.copytree(rendered / "gt", out / "gt", dirs_exist_ok=True)
    shutil.copyfile(rendered / "split.json", out / "split.json")
    objects = json.loads((rendered / "scene.json").read_text(encoding="utf-8"))["objects"]
    scene = json.loads((out / "scene.json").read_text(encoding="utf-8"))
    write_text(out / "scene.json", json.dumps({**scene, "objects": objects}, indent=1) + "\n")


def make_scene(name: str, out: Path, threads: int) -> str:
    """Render and prepare a scene, and return the SHA-256 of the rendering."""
    rendered = out / "rendered" / name
    synthesize(find_scene(str(HERE / f"{name}.json")), rendered, SYNTH, SILENT, threads=threads)
    prepare_rendering(rendered, out / name)
    return scene_digest(rendered)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", nargs="+", choices=SCENES + USED, default=SCENES)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    use_threads(options.threads)
    recorded = json.loads(CHECKSUMS.read_text(encoding="utf-8")) if CHECKSUMS.exists() else {}
    differing = []
    for name in options.scenes:
        print(f"rendering {name}", flush=True)
        try:
            made = make_scene(name, options.out, options.threads)
        except PolarguideError as error:
            parser.error(str(error))
        print(f"{options.out / name}   SHA-256 of the rendering: {made}", flush=True)
        if recorded.setdefault(name, made) != made:
            differing.append(name)
    write_text(CHECKSUMS, json.dumps(recorded, indent=1) + "\n")
    if differing:
        sys.exit(f"These scenes differ from checksums.json: {', '.join(differing)}.")


if __name__ == "__main__":
    main()
