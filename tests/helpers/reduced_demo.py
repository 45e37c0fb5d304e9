"""The demo scene with fewer of its views: what a test costs goes mostly with their number."""

import json
import shutil
from pathlib import Path

import polarguide

TEST_VIEWS = ("v000", "v022", "v044", "v066")
"""Those of the whole scene."""
TRAIN_VIEWS = ("v001", "v003", "v011", "v019", "v029", "v036", "v045", "v053", "v063", "v071")
VIEWS = tuple(sorted(TEST_VIEWS + TRAIN_VIEWS))


def write_reduced_demo(folder: Path) -> Path:
    """Write the scene, with all points of the whole one."""
    whole = polarguide.demo_scene()
    for kind in ("polar", "gt"):
        (folder / kind).mkdir(parents=True)
        for path in (whole / kind).iterdir():
            if path.stem.partition("_")[0] in VIEWS:
                shutil.copy(path, folder / kind)
    shutil.copytree(whole / "sparse", folder / "sparse")
    images = folder / "sparse" / "0" / "images.txt"
    lines = [line for line in images.read_text().splitlines() if not line.startswith("#")]
    # A pose ends with the name of its picture; the line behind it has the picture's features.
    pairs = (
        pair for pair in zip(lines[::2], lines[1::2], strict=True) if Path(pair[0].split()[-1]).stem in VIEWS
    )
    images.write_text("".join(f"{pose}\n{features}\n" for pose, features in pairs))
    record = json.loads((whole / "scene.json").read_text())
    changed = record | {"views": VIEWS, "train": TRAIN_VIEWS, "test": TEST_VIEWS}
    (folder / "scene.json").write_text(json.dumps(changed))
    shutil.copy(whole / "split.json", folder)
    return folder
