"""``benchmarks/accuracy/index_labels.py`` labels one object in a part of the training views."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from polarguide.core.errors import PolarguideError

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks" / "accuracy"))
from index_labels import label_scene

NUMBERS = np.array([[0, 1, 1], [2, 2, 1]], dtype=np.uint8)
VIEWS = [f"v{number}" for number in range(6)]


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    folder = tmp_path / "pond"
    (folder / "gt").mkdir(parents=True)
    for view in VIEWS:
        np.savez(folder / "gt" / f"{view}.npz", objid=np.roll(NUMBERS, int(view[1:]), axis=1))
    objects = [{"id": 1, "name": "stone"}, {"id": 2, "name": "water"}]
    (folder / "scene.json").write_text(json.dumps({"train": VIEWS, "objects": objects}))
    return folder


def test_one_object_is_labeled_in_every_fourth_view(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "labeled"
    assert label_scene(scene, out, "water", 1.33) == 2
    assert sorted(path.stem for path in (out / "materials").iterdir()) == ["v0", "v4"]
    for view in ("v0", "v4"):
        labels = np.asarray(Image.open(out / "materials" / f"{view}.png"))
        np.testing.assert_array_equal(labels, 3 * (np.roll(NUMBERS, int(view[1:]), axis=1) == 2))
    description = json.loads((out / "scene.json").read_text())
    assert description["materials"] == {"3": {"refractive_index": 1.33, "name": "water"}}
    assert "materials" not in json.loads((scene / "scene.json").read_text())


def test_wrong_scenes_and_an_existing_folder_are_refused(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(PolarguideError, match="polarguide synth"):
        label_scene(tmp_path, tmp_path / "a", "water", 1.33)
    with pytest.raises(PolarguideError, match="a new folder"):
        label_scene(scene, scene, "water", 1.33)
    with pytest.raises(PolarguideError, match="one of stone, water"):
        label_scene(scene, tmp_path / "a", "sand", 1.33)
    (scene / "gt" / "v4.npz").unlink()
    with pytest.raises(PolarguideError, match="--ground-truth all"):
        label_scene(scene, tmp_path / "b", "water", 1.33)
    assert not (tmp_path / "b").exists()
