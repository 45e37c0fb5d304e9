"""Copy a rendered scene, and label an object with its own refractive index.

    polarguide synth water --out SCENE --size 192x144 --views 56 --test-every 7 --ground-truth all
    python benchmarks/accuracy/index_labels.py SCENE OUT --object water --index 1.33 [--every 4]

One training view in four gets the file materials/VIEW.png, from the object numbers of its ground truth. The value 3 is
on pixels of the object, and 0 (unknown) elsewhere. ``polarguide train OUT`` then uses the index for this object.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

import numpy as np
from PIL import Image

from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import make_folder, write_text

LABEL = 3
"""First number in materials/ that stands for a material of scene.json."""
UNKNOWN = 0


def number_of(objects: list[dict[str, object]], name: str) -> int:
    """Return the object number of an object.

    Raises:
        PolarguideError: the scene has no object of this name.
    """
    numbers = {str(each["name"]): int(str(each["id"])) for each in objects}
    require(
        name in numbers,
        "--object",
        expected=f"one of {', '.join(numbers)}",
        found=name,
        remedy="Correct the name.",
    )
    return numbers[name]


def label_scene(scene: Path, out: Path, name: str, index: float, every: int) -> int:
    """Write the labeled copy of a scene, and return the number of labeled views.

    Raises:
        PolarguideError: the object is unknown, or a training view has no ground truth.
    """
    description = json.loads((scene / "scene.json").read_text(encoding="utf-8"))
    number = number_of(description["objects"], name)
    views = description["train"][::every]
    truths = [scene / "gt" / f"{view}.npz" for view in views]
    missing = [path.name for path in truths if not path.exists()]
    require(
        not missing,
        scene / "gt",
        expected="ground truth of training views",
        found=f"no {', '.join(missing)}",
        remedy="Render the scene with --ground-truth all.",
    )
    shutil.copytree(scene, out)
    make_folder(out / "materials")
    for view, path in zip(views, truths, strict=True):
        with np.load(path) as arrays:
            labels = np.where(arrays["objid"] == number, LABEL, UNKNOWN).astype(np.uint8)
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
    parser.add_argument("--every", type=int, default=4, help="one training view in this many is labeled")
    options = parser.parse_args()
    try:
        views = label_scene(options.scene, options.out, options.object, options.index, options.every)
    except PolarguideError as error:
        parser.error(str(error))
    print(f"{options.out}: {views} labeled views")


if __name__ == "__main__":
    main()
