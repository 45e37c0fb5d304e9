"""Wrong input ends in one line on stderr and status 2, never in a traceback, and writes nothing."""

import functools
import importlib.util
import json
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_files import write_mosaics
from comparison_records import content
from comparison_records import run as run_record

from polarguide import __version__
from polarguide.core.errors import install_package
from polarguide.runs.folder import CHECKPOINT, CONFIGURATION

Refused = Callable[..., str]

TRAIN, COMPARE = "train DEMO --out new", "compare DEMO --out new --recipes 3dgs"
MEASURE = "measure shots/v000.png --out new --sensor IMX250MZR --bits 12"
WATCH = "measure --out new --sensor IMX250MZR --bits 12 --watch"
PRIORS = "priors shots/v000.png --out new --sensor IMX250MZR"
PREPARE = "prepare gray --out new --sensor IMX250MYR"
RENDER, PRESENT, MESH = "render RUN --out new", "present RUN", "export RUN --out new --format mesh"
BENCH, SYNTH, INSPECT = "bench --out new", "synth proof --out new", "inspect DEMO --out new"
CALIBRATE = "calibrate gray --sensor IMX250MZR"
# Command lines, and what they say of the place of the mistake and of what was found there.
WRONG = [
    ("train none --out new", "none", "nothing"),
    ("train empty --out new", "empty", ""),
    ("priors empty --out new", "empty", ""),
    (f"{TRAIN} --steps 0", "steps", "0"),
    (f"{TRAIN} --gaussians -1", "gaussians", "-1"),
    (f"{TRAIN} --checkpoint-every 0", "checkpoint-every", "0"),
    (f"{TRAIN} --downscale 1000", "downscale", "1000"),
    (f"{TRAIN} --memory 0", "memory", "0"),
    (f"{TRAIN} --refractive-index 1.0", "--refractive-index", "1"),
    (f"{TRAIN} --refractive-index 9", "--refractive-index", "9"),
    (f"{TRAIN} --device cuda", "--device cuda", ""),
    (f"{TRAIN} --resume", "new", ""),
    ("train DEMO --out file", "file", ""),
    ("render RUN --out file", "file", ""),
    ("priors DEMO --out file --downscale 4 --views v000", "file", ""),
    ("eval empty", "empty", ""),
    ("eval none", "none", ""),
    ("render none", "none", ""),
    (f"{RENDER} --layers final,color", "--layers", "color"),
    (f"{RENDER} --layers ''", "--layers", ""),
    (f"{RENDER} --views v0001", "demo", "'v0001'"),
    (f"{RENDER} --views ,", "--views", ""),
    (f"{RENDER} --video new/a.mp4", "--video", ""),
    (f"{RENDER} --path orbit --video new/a.gif", "--video", ""),
    (f"{RENDER} --path loop", "loop", ""),
    (f"{RENDER} --environment none.exr", "none.exr", ""),
    (f"{RENDER} --frames 5", "--frames", ""),
    (f"{RENDER} --path orbit --frames 0", "--frames", "0"),
    (f"{RENDER} --rotate-environment 1e308", "--rotate-environment", ""),
    (f"{RENDER} --transparent --format npy", "--transparent", ""),
    (f"{RENDER} --transparent --path orbit", "--transparent", ""),
    ("priors DEMO --views x --out new --downscale 4", "demo", "'x'"),
    ("priors DEMO --views , --out new", "--views", ""),
    ("priors DEMO --run RUN --out new --downscale 2", "--downscale", "2"),
    ("share RUN --out new.txt", "--out", ""),
    (f"{MESH} --resolution 4", "--resolution", "4"),
    ("fly", "fly", ""),
    ("view RUN --port 0", "the port", "0"),
    ("view RUN --port 99999", "the port", "99999"),
    ("view RUN --host no.such.host.invalid", "'no.such.host.invalid'", ""),
    (f"{TRAIN} --downscale 4 --viewer --viewer-host 192.0.2.1", "'192.0.2.1'", ""),
    ("tables none.json --out new", "none.json", ""),
    ("tables empty --out new", "results.json", ""),
    ("tables record.json broken.json --out new", "broken.json", ""),
    ("tables record.json --against ref-gs --out new", "--against", "ref-gs"),
    ("tables --out new", "tables", "none"),
    (f"{BENCH} --scenes rough", "--scenes", "rough"),
    (f"{BENCH} --scenes cat", "--scenes", "cat"),
    (f"{BENCH} --held-back --scenes kit", "--scenes", "kit"),
    (f"{BENCH} --jobs -1", "--jobs", "-1"),
    ("calibrate none --out new.safetensors --sensor IMX250MZR", "none", ""),
    (f"{CALIBRATE} --out new.safetensors", "gray", ""),
    (f"{CALIBRATE} --out new.png", "--out", "new.png"),
    (f"{INSPECT} --steps 0", "--steps", "0"),
    (f"{INSPECT} --downscale -1", "downscale", "-1"),
    (f"{INSPECT} --refractive-index 0.9", "refractive", "0.9"),
    (f"{INSPECT} --downscale 5000", "downscale", "5000"),
    ("inspect none", "none", ""),
    ("inspect empty --out file", "file", ""),
    ("synth cat --out new", "cat", ""),
    (f"{SYNTH} --size big", "--size", "big"),
    ("scale --diameter nan --out new.svg", "--diameter", "nan"),
    ("scale --diameter 3 --out new.svg", "--diameter", "3"),
    ("scale --diameter 1000 --out new.svg", "--diameter", "1000"),
    ("compare DEMO --out new --recipes magic", "recipe", "magic"),
    (f"{COMPARE} 3dgs", "--recipes", "3dgs"),
    (f"{COMPARE} --seeds 0", "--seeds", "0"),
    (f"{COMPARE} --report-views -1", "--report-views", "-1"),
    (f"{COMPARE} --steps 5 gnerp=9", "--steps", "gnerp"),
    ("compare DEMO DEMO --out new --recipes 3dgs --downscale 8", "demo", "demo twice"),
    ("prepare gray --out new", "gray", ""),
    (f"{PREPARE} --order 0,90", "--order", "0,90"),
    (f"{PREPARE} --calibration none.json", "none.json", ""),
    (f"{PREPARE} --zero nan", "zero", "nan"),
    (f"{PREPARE} --poses none --threads -1", "threads", "-1"),
    (f"{PREPARE} --poses loop", "loop", ""),
    (f"{PREPARE} --poses none --dark-frame loop", "loop", ""),
    (f"{MEASURE} --roi 1,2,3,{'9' * 5000}", "--roi", ""),
    (f"{MEASURE} --roi 1,2,3", "--roi", "1,2,3"),
    (f"{MEASURE} --roi a=0,0,1,1 --roi a=0,0,2,2", "--roi", "a twice"),
    (f"{MEASURE} --threshold 2", "--threshold", "2"),
    (f"{MEASURE} --limits none.json", "none.json", ""),
    (f"{MEASURE} --reference none.png", "none.png", ""),
    (f"{MEASURE} --dark-frame none.png", "none.png", "nothing"),
    (f"{MEASURE} --watch .", "--watch", ""),
    (f"{MEASURE} --settle 7", "--settle", ""),
    (f"{MEASURE} --patience 7", "--patience", ""),
    (f"{MEASURE} --idle 7", "--idle", ""),
    ("measure --out new --sensor IMX250MZR", "--watch", "neither"),
    (f"{WATCH} none", "none", ""),
    (f"{PRIORS} --threshold 0.1", "--threshold", "shots"),
    (f"{PRIORS} --views all", "--views", "shots"),
    (f"{PRIORS} --memory 1GB", "--memory", "shots"),
    (f"{PRIORS} --run runs/x", "--run", "shots"),
    (f"{PRIORS} --downscale 2", "--downscale", "2"),
    (f"{PRIORS} --formats pdf", "--formats", "pdf"),
    (f"{PRIORS} --full-well 3", "--full-well", "3"),
    (f"{PRIORS} --refractive-index 0.5", "--refractive-index", "0.5"),
    (f"{PRIORS} --intrinsics 1,2", "--intrinsics", ""),
    ("present none", "none", ""),
    ("present empty --author A", "empty", ""),
    ("present DEMO --up-axis v000,3,3", "--up-axis", ""),
    (f"{PRESENT} --points v000,3,3", "--points", "1"),
    (f"{PRESENT} --distance 1", "--points", ""),
    (f"{PRESENT} --points v000 v000 --distance 1", "--points", ""),
    (f"{PRESENT} --points v000 v003 --distance '1 mile'", "--distance", "1 mile"),
    (f"{PRESENT} --points v000 v003 --distance 1 --meters-per-unit 1", "", "both"),
    (f"{PRESENT} --points v000,900,3 v003 --distance 1", "--points", ""),
    (f"{PRESENT} --white-balance v00,3,3", "demo", "v00"),
    (f"{PRESENT} --white-balance v000,900,3", "--white-balance", "900"),
    (f"{PRESENT} --white-balance 99,1,1", "(white_balance[0])", "99"),
    (f"{PRESENT} --white-balance nan,1,1", "(white_balance[0])", "NaN"),
    (f"{PRESENT} --white-balance white", "--white-balance", "white"),
    (f"{PRESENT} --up-axis up", "--up-axis", "up"),
    (f"{PRESENT} --up-axis 0,0,0", "(up_axis)", "0"),
    (f"{PRESENT} --meters-per-unit -1", "(meters_per_unit)", "-1"),
    (f"{PRESENT} --meters-per-unit much", "--meters-per-unit", "much"),
    (f"{PRESENT} --crop 1,2,3", "--crop", "1,2,3"),
    (f"{PRESENT} --crop 5,1,0,1,0,1", "(crop)", ""),
    (f"{PRESENT} --author 'a\nb'", "(author)", ""),
]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder: an empty folder, files of several kinds, a link in a circle, and shots of a sensor."""
    monkeypatch.chdir(tmp_path)
    for name in ("empty", "gray", "shots"):
        (tmp_path / name).mkdir()
    (tmp_path / "file").write_text("mine")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "record.json").write_text(json.dumps(content([run_record("x", "3dgs", 0, psnr=30.0)])))
    (tmp_path / "broken.json").write_text(json.dumps({"format": "polarguide-results-2"}))
    cv2.imwrite(str(tmp_path / "gray" / "a.png"), np.full((32, 32), 90, np.uint8))
    write_mosaics(tmp_path / "shots", 1, color=False, bits=12)
    return tmp_path


@pytest.mark.parametrize(("line", "where", "found"), WRONG, ids=[row[0][:60] for row in WRONG])
def test_a_wrong_command_line_is_one_line_and_writes_nothing(
    refused: Refused, folder: Path, demo_scene: Path, trained: Path, line: str, where: str, found: str
) -> None:
    before = sorted((path, path.lstat().st_mtime_ns) for path in (*folder.rglob("*"), *trained.rglob("*")))
    places = {"DEMO": demo_scene, "RUN": trained}
    said = refused(*(places.get(word, word) for word in shlex.split(line)))
    assert where in said.partition(": expected ")[0], said
    assert found in said.partition(": expected ")[2].partition(", found ")[2], said
    assert sorted((p, p.lstat().st_mtime_ns) for p in (*folder.rglob("*"), *trained.rglob("*"))) == before


def test_out_that_already_has_a_run(refused: Refused, demo_scene: Path, trained: Path, short) -> None:
    before = (trained / CHECKPOINT).read_bytes()
    assert "--resume" in refused("train", demo_scene, "--out", trained, *short)
    assert (trained / CHECKPOINT).read_bytes() == before


@pytest.mark.parametrize(
    ("flag", "value", "field"),
    [
        ("--steps", 50, "steps"),
        ("--seed", 1, "settings"),
        ("--recipe", "3dgs", "recipe"),
        ("--downscale", 8, "downscale"),
        ("--refractive-index", 1.4, "settings"),
    ],
)
def test_resume_with_other_flags(
    refused: Refused, demo_scene: Path, trained: Path, short, flag: str, value: object, field: str
) -> None:
    before = (trained / CONFIGURATION).read_text()
    assert f"({field})" in refused("train", demo_scene, "--out", trained, "--resume", *short, flag, value)
    assert (trained / CONFIGURATION).read_text() == before


def test_resume_with_another_scene(
    refused: Refused, tmp_path: Path, demo_scene: Path, trained: Path, short
) -> None:
    other = Path(shutil.copytree(demo_scene, tmp_path / "demo"))
    shutil.copy(other / "polar" / "v003_000.png", other / "polar" / "v011_000.png")
    assert "(scene_digest)" in refused("train", other, "--out", trained, "--resume", *short)


def rewritten(run_folder: Path, place: str, value: object) -> object:
    """Change a field of the configuration, whose name has a dot before each further level; returns the former value."""
    path = run_folder / CONFIGURATION
    data = json.loads(path.read_text())
    *levels, name = place.split(".")
    inner = functools.reduce(dict.__getitem__, levels, data)
    former, inner[name] = inner.get(name), value
    path.write_text(json.dumps(data))
    return former


@pytest.mark.parametrize(
    "place",
    [
        "recipe_data.ssim_weight",
        "recipe_data.metal_rules.prior",
        "recipe_data.angle_rules.weak",
        "recipe_data.priors.flat_rules.least",
        "recipe_data.propagation.rest",
        "version",
    ],
)
def test_resume_after_the_recipe_or_the_program_changed_names_it(
    refused: Refused, demo_scene: Path, copy: Path, short, place: str
) -> None:
    value = f"{__version__}7" if place == "version" else 0.875
    former = rewritten(copy, place, value)
    line = refused("train", demo_scene, "--out", copy, "--resume", *short)
    assert f"({place}): expected {json.dumps(value)}, found {json.dumps(former)}" in line


@pytest.mark.parametrize("verb", ["eval", "render"])
def test_a_damaged_checkpoint(refused: Refused, copy: Path, verb: str) -> None:
    checkpoint = copy / CHECKPOINT
    checkpoint.write_bytes(checkpoint.read_bytes()[:5000])
    assert str(checkpoint) in refused(verb, copy)
    checkpoint.unlink()
    assert "expected a checkpoint" in refused(verb, copy)


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("scene", "/no/such/scene", "/no/such/scene"),
        ("recipe", "magic", "found magic"),
        ("settings", 3, CONFIGURATION),
    ],
)
def test_a_run_whose_configuration_is_wrong(
    refused: Refused, copy: Path, field: str, value: object, said: str
) -> None:
    rewritten(copy, field, value)
    assert said in refused("eval", copy)


@pytest.mark.parametrize(
    ("word", "meant"),
    [("trian", "train"), ("evaluate", "eval"), ("exprot", "export"), ("Inspect", "inspect")],
)
def test_a_verb_that_is_nearly_one(refused: Refused, word: str, meant: str) -> None:
    assert f"Perhaps polarguide {meant} is meant." in refused(word, "scene")


def test_viewing_a_file_says_what_is_wanted(refused: Refused, tmp_path: Path) -> None:
    (tmp_path / "point_cloud.ply").write_bytes(b"ply")
    assert f"polarguide view {tmp_path}" in refused("view", tmp_path / "point_cloud.ply")


@pytest.mark.parametrize(
    ("arguments", "package"),
    [
        ("export RUN --format environment", "OpenEXR"),
        ("export RUN --format spz", "gaussforge"),
        ("export RUN --format mesh", "skimage"),
        ("render RUN --path orbit --video a.mp4", "imageio_ffmpeg"),
        ("render RUN --environment a.exr", "OpenEXR"),
    ],
)
def test_missing_packages_are_named_before_anything_is_read(
    refused: Refused, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: str, package: str
) -> None:
    """The run does not even exist: what is missing is said first."""
    there = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == package else there(name))
    line = refused(*arguments.replace("RUN", str(tmp_path / "run")).split())
    assert f"expected the Python package {package}" in line
    assert f"Install it with {install_package(package)} and" in line
