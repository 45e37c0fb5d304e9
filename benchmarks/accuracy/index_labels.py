"""Copy a rendered scene, and label an object with its own refractive index.

    polarguide synth water --out SCENE --size 192x144 --views 56 --test-every 7 --ground-truth all
    python benchmarks/accuracy/index_labels.py SCENE OUT --object water --index 1.33

One training view in four gets the file materials/VIEW.png, from the object numbers of its ground truth. The value 3 is
on pixels of the object, and 0 (unknown) elsewhere. ``polarguide train OUT`` then uses the index for this object.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from PIL import Image

from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import make_folder, write_text
from polarguide.core.options import check_choice
from polarguide.core.records import decode, read_record

LABEL = 3
"""First number in materials/ that stands for a material of scene.json."""
UNKNOWN = 0
EVERY = 4
"""Interval of labeled training views."""


class Labeled(msgspec.Struct):
    """Object of a rendered scene, with its number in the ground truth."""

    id: int
    name: str


class Rendered(msgspec.Struct):
    """Objects and training views of a rendered scene."""

    objects: list[Labeled]
    train: list[str]


def label_scene(scene: Path, out: Path, name: str, index: float) -> int:
    """Write the labeled copy of a scene, and return the number of labeled views.

    Raises:
        PolarguideError: the scene has no valid scene.json or no object of this name, a training view has no ground
            truth, or the output folder exists.
    """
    path = scene / "scene.json"
    remedy = "Render the scene with polarguide synth."
    description = read_record(path, dict[str, Any], remedy=remedy)
    rendered = decode(description, Rendered, path, remedy=remedy)
    numbers = {thing.name: thing.id for thing in rendered.objects}
    check_choice("--object", name, numbers)
    views = rendered.train[::EVERY]
    truths = [scene / "gt" / f"{view}.npz" for view in views]
    missing = [truth.name for truth in truths if not truth.exists()]
    require(
        not missing,
        scene / "gt",
        expected="ground truth of training views",
        found=f"no {', '.join(missing)}",
        remedy="Render the scene with --ground-truth all.",
    )
    require(not out.exists(), out, expected="a new folder", found="a folder", remedy="Choose another folder.")
    shutil.copytree(scene, out)
    make_folder(out / "materials")
    for view, truth in zip(views, truths, strict=True):
        with np.load(truth) as arrays:
            labels = np.where(arrays["objid"] == numbers[name], LABEL, UNKNOWN).astype(np.uint8)
        Image.fromarray(labels).save(out / "materials" / f"{view}.png")
    description["materials"] = {str(LABEL): {"refractive_index": index, "name": name}}
    write_text(out / "scene.json", json.dumps(description, indent=1) + "\n")
    return len(views)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path, help="new folder")
    parser.add_argument("--object", required=True, help="name of the object")
    parser.add_argument("--index", type=float, required=True, help="its refractive index")
    options = parser.parse_args()
    try:
        views = label_scene(options.scene, options.out, options.object, options.index)
    except PolarguideError as error:
        parser.error(str(error))
    print(f"{options.out}: {views} labeled views")


if __name__ == "__main__":
    main()
