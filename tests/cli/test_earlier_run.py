"""A run that commit 239ddd2 trained and scored opens, is scored, rendered and exported, with the values it had then.

Made by that commit's command line from the scene that ``earlier`` writes:
``train SCENE --out run --steps 30 --downscale 4 --background black --gaussians 150 --threads 1 --device cpu`` and
``eval run --no-speed --threads 1 --device cpu``. The archive is of what they wrote, without errors.png and the lock.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

import polarguide
from polarguide.cli.app import run as command

ARCHIVE = Path(__file__).with_name("run-239ddd2.tar.xz")
HEADER, EVERY = 3, 40
REFLECTED = {"psnr", "psnr_foreground", "psnr_reflective", "ssim", "flip", "specular_psnr", "specular_psnr_aligned",
             "specular_psnr_dielectric", "stokes_error"}  # fmt: skip
"""Metrics of reflected light: between texels, radiance is interpolated now; then it was its logarithm."""
MEASURED_ANEW = {"peak_memory_mib", "fps_reason", "train_seconds_reason", "provenance"}
BAKED = ("f_dc", "f_rest", "roughness")
"""Properties whose definition has changed: harmonics by the directions that are seen, and roughness as in glTF."""


@pytest.fixture(scope="module")
def earlier(demo_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder, beside its scene: the demo's views with every 40th of its points."""
    place = tmp_path_factory.mktemp("earlier")
    scene = Path(shutil.copytree(demo_scene, place / "scene"))
    points = scene / "sparse" / "0" / "points3D.txt"
    lines = points.read_text().splitlines(keepends=True)
    points.write_text("".join(lines[:HEADER] + lines[HEADER::EVERY]))
    shutil.unpack_archive(ARCHIVE, place, filter="data")
    record = place / "run" / "run.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | {"scene": str(scene)}))
    return place / "run"


def test_it_opens_without_a_warning(earlier: Path) -> None:
    run = polarguide.open_run(earlier)
    assert (run.recipe.name, run.steps, run.model.size) == ("polarguide-stokes", 30, "122 Gaussians")
    assert run.scene.test_names == ("v000", "v022", "v044", "v066")
    assert run.health is None
    roughness = run.render("v000", "roughness")["roughness"]
    assert bool((roughness == roughness[0, 0]).all()), "all its surfaces are mirrors"


def test_it_is_scored_as_then(earlier: Path) -> None:
    before = json.loads((earlier / "metrics.json").read_text())
    assert command(["eval", str(earlier), "--no-speed", "--threads", "1", "--device", "cpu"]) == 0
    after = json.loads((earlier / "metrics.json").read_text())
    compared = 0
    for then, now in (
        (before, after),
        *((before["views"][name], after["views"][name]) for name in before["views"]),
    ):
        for name in then.keys() - MEASURED_ANEW:
            if isinstance(then[name], float):
                assert now[name] == pytest.approx(then[name], rel=2e-3 if name in REFLECTED else 1e-5), name
                compared += 1
            elif not isinstance(then[name], dict):
                assert now[name] == then[name], name
    assert compared > 90
    assert after["objects"].keys() == before["objects"].keys()


def test_it_is_rendered(earlier: Path, tmp_path: Path) -> None:
    words = ["render", str(earlier), "--out", str(tmp_path), "--layers", "final,normal", "--views", "v000"]
    assert command([*words, "--format", "npy", "--threads", "1"]) == 0
    picture = np.load(tmp_path / "v000_final.npy")
    assert np.array_equal(picture, polarguide.open_run(earlier).render("v000")["final"].numpy())


def test_it_is_exported_as_then(earlier: Path, tmp_path: Path) -> None:
    polarguide.present(earlier, crop="all")
    words = [
        "--format",
        "ply",
        "--fields",
        "all",
        "--axes",
        "scene",
        "--out",
        str(tmp_path),
        "--threads",
        "1",
    ]
    assert command(["export", str(earlier), *words]) == 0
    paths = earlier / "point_cloud.ply", tmp_path / "polarguide.ply"
    then, now = (PlyData.read(path)["vertex"].data for path in paths)
    assert then.dtype == now.dtype
    assert len(then) == 122
    for name in then.dtype.names:
        if not name.startswith(BAKED):
            np.testing.assert_allclose(now[name], then[name], rtol=1e-6, err_msg=name)
