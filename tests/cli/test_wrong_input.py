"""Wrong input ends in one line on stderr and status 2, never in a traceback, and writes nothing."""

from __future__ import annotations

import functools
import importlib.util
import json
import shutil
from pathlib import Path

import pytest

from polarguide.core.errors import install_package
from polarguide.runs.folder import CHECKPOINT, CONFIGURATION


def test_missing_scene(refused, tmp_path: Path) -> None:
    line = refused("train", tmp_path / "none", "--out", tmp_path / "run")
    assert f"{tmp_path / 'none'}: expected a capture folder, found nothing" in line
    assert not (tmp_path / "run").exists()


def test_a_folder_without_pictures(refused, tmp_path: Path) -> None:
    assert str(tmp_path) in refused("train", tmp_path, "--out", tmp_path / "run")
    assert str(tmp_path) in refused("priors", tmp_path, "--out", tmp_path / "pictures")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("--steps", -3),
        ("--steps", 0),
        ("--gaussians", -1),
        ("--checkpoint-every", 0),
        ("--downscale", 0),
        ("--downscale", 1000),
        ("--threads", -1),
        ("--memory", 0),
        ("--refractive-index", 0),
        ("--refractive-index", 1.0),
        ("--refractive-index", "nan"),
        ("--refractive-index", 9),
        ("--device", "cuda"),
    ],
)
def test_values_out_of_range(refused, tmp_path: Path, demo_scene: Path, flag: str, value: object) -> None:
    line = refused("train", demo_scene, "--out", tmp_path / "run", flag, value)
    assert flag.strip("-") in line
    assert not (tmp_path / "run").exists()


def test_out_that_already_has_a_run(refused, demo_scene: Path, trained: Path, short) -> None:
    before = (trained / CHECKPOINT).read_bytes()
    assert "--resume" in refused("train", demo_scene, "--out", trained, *short)
    assert (trained / CHECKPOINT).read_bytes() == before


def test_out_that_is_a_file(refused, tmp_path: Path, demo_scene: Path, trained: Path, short) -> None:
    (tmp_path / "file").write_text("mine")
    for command in (
        ("train", demo_scene, "--out", tmp_path / "file", *short),
        ("render", trained, "--out", tmp_path / "file"),
        ("priors", demo_scene, "--out", tmp_path / "file", "--downscale", 4, "--views", "v000"),
    ):
        assert str(tmp_path / "file") in refused(*command)
    assert (tmp_path / "file").read_text() == "mine"


def test_resume_without_a_run(refused, tmp_path: Path, demo_scene: Path, short) -> None:
    line = refused("train", demo_scene, "--out", tmp_path / "run", "--resume", *short)
    assert "expected a run to resume" in line
    assert not (tmp_path / "run").exists()


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
    refused, demo_scene: Path, trained: Path, short, flag: str, value: object, field: str
) -> None:
    before = (trained / CONFIGURATION).read_text()
    line = refused("train", demo_scene, "--out", trained, "--resume", *short, flag, value)
    assert f"({field})" in line
    assert (trained / CONFIGURATION).read_text() == before


def test_resume_with_another_scene(refused, tmp_path: Path, demo_scene: Path, trained: Path, short) -> None:
    other = tmp_path / "demo"
    shutil.copytree(demo_scene, other)
    shutil.copy(other / "polar" / "v003_000.png", other / "polar" / "v005_000.png")
    assert "(scene_digest)" in refused("train", other, "--out", trained, "--resume", *short)


@pytest.mark.parametrize(
    "place",
    ["ssim_weight", "metal_rules.begin", "angle_rules.weak", "priors.flat_rules.least", "propagation.rest"],
)
def test_resume_after_a_constant_of_the_recipe_changed_names_it(
    refused, tmp_path: Path, demo_scene: Path, trained: Path, short, place: str
) -> None:
    shutil.copytree(trained, tmp_path / "run")
    path = tmp_path / "run" / CONFIGURATION
    data = json.loads(path.read_text())
    *rooms, name = place.split(".")
    inner = functools.reduce(dict.__getitem__, rooms, data["recipe_data"])
    value, inner[name] = inner[name], 0.875
    path.write_text(json.dumps(data))
    line = refused("train", demo_scene, "--out", tmp_path / "run", "--resume", *short)
    assert f"(recipe_data.{place}): expected 0.875, found {json.dumps(value)}" in line


def test_resume_with_another_version_of_the_program(
    refused, tmp_path: Path, demo_scene: Path, trained: Path, short
) -> None:
    shutil.copytree(trained, tmp_path / "run")
    path = tmp_path / "run" / CONFIGURATION
    data = json.loads(path.read_text())
    data["version"] += "7"
    path.write_text(json.dumps(data))
    line = refused("train", demo_scene, "--out", tmp_path / "run", "--resume", *short)
    assert f'(version): expected "{data["version"]}"' in line


@pytest.mark.parametrize("verb", ["eval", "render"])
def test_a_folder_that_is_no_run(refused, tmp_path: Path, verb: str) -> None:
    for folder in (tmp_path, tmp_path / "none"):
        assert f"{folder}: expected a run folder" in refused(verb, folder)


def test_unknown_layers_and_views(refused, trained: Path, demo_scene: Path, tmp_path: Path) -> None:
    assert "found color" in refused("render", trained, "--layers", "final,color")
    line = refused("render", trained, "--views", "v0001", "--out", tmp_path / "r")
    assert "found 'v0001'" in line
    assert "The nearest names are: v0" in line
    line = refused("priors", demo_scene, "--views", "x", "--out", tmp_path / "p", "--downscale", 4)
    assert "found 'x'" in line


@pytest.mark.parametrize("verb", ["render", "priors"])
def test_no_views(refused, trained: Path, demo_scene: Path, tmp_path: Path, verb: str) -> None:
    first = trained if verb == "render" else demo_scene
    assert "--views" in refused(verb, first, "--views", ",", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_no_layers(refused, trained: Path, tmp_path: Path) -> None:
    assert "--layers" in refused("render", trained, "--layers", "", "--out", tmp_path / "out")


def test_priors_of_a_run_at_another_size(refused, trained: Path, demo_scene: Path, tmp_path: Path) -> None:
    line = refused("priors", demo_scene, "--run", trained, "--out", tmp_path / "p", "--downscale", 2)
    assert "--downscale: expected 4" in line


@pytest.mark.parametrize("verb", ["eval", "render"])
def test_a_damaged_checkpoint(refused, trained: Path, tmp_path: Path, verb: str) -> None:
    shutil.copytree(trained, tmp_path / "run")
    checkpoint = tmp_path / "run" / CHECKPOINT
    checkpoint.write_bytes(checkpoint.read_bytes()[:5000])
    assert str(checkpoint) in refused(verb, tmp_path / "run")
    checkpoint.unlink()
    assert "expected a checkpoint" in refused(verb, tmp_path / "run")


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("scene", "/no/such/scene", "/no/such/scene"),
        ("recipe", "magic", "found magic"),
        ("settings", 3, CONFIGURATION),
    ],
)
def test_a_run_whose_configuration_is_wrong(
    refused, trained: Path, tmp_path: Path, field: str, value: object, said: str
) -> None:
    shutil.copytree(trained, tmp_path / "run")
    path = tmp_path / "run" / CONFIGURATION
    path.write_text(json.dumps(json.loads(path.read_text()) | {field: value}))
    assert said in refused("eval", tmp_path / "run")


@pytest.mark.parametrize(
    ("word", "meant"),
    [("trian", "train"), ("evaluate", "eval"), ("exprot", "export"), ("Inspect", "inspect")],
)
def test_a_verb_that_is_nearly_one(refused, word: str, meant: str) -> None:
    assert f"Perhaps polarguide {meant} is meant." in refused(word, "scene")


def test_a_word_that_is_no_verb(refused) -> None:
    assert "fly: expected a verb: demo, calibrate, scale, prepare" in refused("fly")


def test_viewing_a_file_says_what_is_wanted(refused, tmp_path: Path) -> None:
    (tmp_path / "point_cloud.ply").write_bytes(b"ply")
    line = refused("view", tmp_path / "point_cloud.ply")
    assert "expected a run folder: what train wrote under --out" in line
    assert f"polarguide view {tmp_path}" in line


@pytest.mark.parametrize(
    ("arguments", "package"),
    [
        (("export", "RUN", "--format", "environment"), "OpenEXR"),
        (("export", "RUN", "--format", "spz"), "gaussforge"),
        (("export", "RUN", "--format", "mesh"), "skimage"),
        (("render", "RUN", "--path", "orbit", "--video", "a.mp4"), "imageio_ffmpeg"),
        (("render", "RUN", "--environment", "a.exr"), "OpenEXR"),
    ],
)
def test_missing_packages_are_named_before_anything_is_read(
    refused, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], package: str
) -> None:
    """The run does not even exist: what is missing is said first."""
    there = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == package else there(name))
    line = refused(*(str(tmp_path / "run") if word == "RUN" else word for word in arguments))
    assert f"expected the Python package {package}" in line
    assert f"Install it with {install_package(package)} and" in line
