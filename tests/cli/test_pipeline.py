"""The verbs one after another on the demo scene: what they write is whole, valid and of the right size."""

import json
import os
import shutil
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from plyfile import PlyData
from safetensors.torch import load_file

import polarguide
from polarguide.cli.app import run
from polarguide.optics.color import srgb_decode
from polarguide.results.evaluation.evaluate import validate_metrics
from polarguide.runs.folder import CHECKPOINT, CONFIGURATION, LOG, PLY
from polarguide.training.loop import TrainingLoop
from polarguide.training.settings import StepReport

SIZE = (24, 32)  # the demo scene over 4
TEST_VIEWS = ("v000", "v022", "v044", "v066")


def picture(path: Path) -> np.ndarray:
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None, path
    assert pixels.dtype == np.uint8
    assert pixels.shape[2] == 3
    return pixels


def differing(a: Path, b: Path) -> list[str]:
    """Names of the checkpoints' tensors that are not the same bits."""
    first, second = load_file(a / CHECKPOINT), load_file(b / CHECKPOINT)
    assert set(first) == set(second)
    return [name for name in first if first[name].numpy().tobytes() != second[name].numpy().tobytes()]


def test_a_training_leaves_a_whole_run(trained: Path) -> None:
    assert {path.name for path in trained.iterdir()} >= {CONFIGURATION, CHECKPOINT, LOG, PLY}
    assert {path.name for path in trained.glob(".*")} <= {".lock"}
    lines = [json.loads(line) for line in (trained / LOG).read_text().splitlines()]
    assert [line["step"] for line in lines] == [9, 19, 29, 39]
    assert all(np.isfinite(line["loss"]) and np.isfinite(line["psnr"]) for line in lines)
    seconds = [line["seconds"] for line in lines]
    assert seconds == sorted(seconds)
    assert json.loads((trained / CONFIGURATION).read_text())["settings"]["steps"] == 40


def test_the_ply_opens_in_an_independent_reader(trained: Path) -> None:
    vertex = PlyData.read(str(trained / PLY))["vertex"]
    tensors = load_file(trained / CHECKPOINT)
    assert vertex.count == len(tensors["gaussians.means"])
    for column, name in enumerate("xyz"):
        np.testing.assert_array_equal(vertex[name], tensors["gaussians.means"][:, column].numpy())
    np.testing.assert_array_equal(vertex["opacity"], tensors["gaussians.opacity_logits"].numpy())
    rotation = np.stack([vertex[f"rot_{i}"] for i in range(4)], axis=1)
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=1), 1, rtol=1e-5)
    names = {p.name for p in vertex.properties}
    assert {"f_dc_2", "f_rest_44", "scale_2", "rot_3"} <= names
    assert len(names) == 62, "those of the release of 3DGS, and no others"
    assert all(np.isfinite(vertex[name]).all() for name in names)


def test_eval_writes_a_valid_record(
    trained: Path, demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(trained, tmp_path / "run")
    assert run(["eval", str(tmp_path / "run"), "--threads", "1"]) == 0
    record = json.loads((tmp_path / "run" / "metrics.json").read_text())
    validate_metrics(record)
    assert tuple(sorted(record["views"])) == TEST_VIEWS
    assert record["steps"] == 40
    assert record["gaussians"] == len(load_file(trained / CHECKPOINT)["gaussians.means"])
    assert record["provenance"]["recipe"] == "polarguide-stokes"
    assert record["provenance"]["downscale"] == 4
    assert 5 < record["psnr"] < 60
    shown = capsys.readouterr().out
    assert f"{record['psnr']:.3f}" in shown
    assert "metrics.json" in shown
    assert "errors.png" in shown
    assert picture(tmp_path / "run" / "errors.png").shape[0] > len(TEST_VIEWS) * SIZE[0]
    table = json.loads((demo_scene / "scene.json").read_text())["objects"]
    assert list(record["objects"]) == [item["name"] for item in table if item["foreground"]]
    assert "sphere_black" in shown
    assert "all dielectric" in shown
    assert (
        sum(item["pixels"] for item in record["objects"].values())
        == record["materials"]["dielectric"]["pixels"]
    )
    for key in (
        "stokes_error",
        "depth_error_median_percent",
        "haze_free",
        "haze_true",
        "depth_beyond",
        "mesh_fscore_1",
        "specular_psnr_dielectric",
    ):
        assert record[key] is not None, key
    for key in ("coverage_error", "alpha_outside"):
        assert record[key] is None, key


def test_render_writes_every_layer_of_every_test_view(trained: Path, tmp_path: Path) -> None:
    out = tmp_path / "pictures"
    assert run(["render", str(trained), "--out", str(out), "--threads", "1"]) == 0
    layers = (
        "final",
        "base",
        "reflection",
        "specular",
        "diffuse",
        "strength",
        "roughness",
        "metalness",
        "normal",
        "depth",
        "dolp",
        "aolp",
    )
    wanted = {f"{view}_{layer}.png" for view in TEST_VIEWS for layer in layers} | {"contact_sheet.png"}
    assert {path.name for path in out.iterdir()} == wanted
    assert all(picture(out / name).shape[:2] == SIZE for name in wanted if name != "contact_sheet.png")
    sheet = picture(out / "contact_sheet.png")
    assert sheet.shape[0] >= len(TEST_VIEWS) * SIZE[0]
    # Five of them have a ground truth, two were measured, and metalness is 0 everywhere so soon, and left out.
    assert sheet.shape[1] >= (len(layers) + 7 - 1) * SIZE[1]
    seen = {layer: picture(out / f"v000_{layer}.png").tobytes() for layer in layers}
    assert seen.pop("base") == seen["diffuse"], "Fresnel-weighted light is added to the base as it is"
    assert len(set(seen.values())) == len(layers) - 1


def test_render_of_chosen_views_and_layers(trained: Path, tmp_path: Path) -> None:
    out = tmp_path / "pictures"
    arguments = ["--views", "v003, v071", "--layers", "alpha,final", "--out", str(out)]
    assert run(["render", str(trained), *arguments]) == 0
    names = {f"{view}_{layer}.png" for view in ("v003", "v071") for layer in ("alpha", "final")}
    assert {path.name for path in out.iterdir()} == names | {"contact_sheet.png"}


def test_transparent_pictures_over_black_are_the_opaque_ones(trained: Path, tmp_path: Path) -> None:
    """Read by OpenCV: colors are not darkened by what is not there, and alpha brings the darkness back."""
    arguments = ["--views", "v000", "--layers", "final,normal", "--threads", "1", "--out"]
    for name, flags in (("opaque", []), ("clear", ["--transparent"])):
        assert run(["render", str(trained), *arguments, str(tmp_path / name), *flags]) == 0
    clear = cv2.imread(str(tmp_path / "clear" / "v000_final.png"), cv2.IMREAD_UNCHANGED)
    assert clear.shape == (*SIZE, 4)
    rendered = polarguide.open_run(trained).render("v000", ["alpha"])["alpha"].numpy()
    np.testing.assert_allclose(clear[..., 3] / 255, rendered, atol=0.51 / 255)
    seen = clear[..., 3] > 128
    assert seen.any()
    linear = srgb_decode(torch.from_numpy(clear[..., :3] / 255)).numpy() * clear[..., 3:] / 255
    opaque = srgb_decode(torch.from_numpy(picture(tmp_path / "opaque" / "v000_final.png") / 255)).numpy()
    kept = seen & (clear[..., :3] < 255).all(axis=-1)
    np.testing.assert_allclose(linear[kept], opaque[kept], atol=0.02)
    assert cv2.imread(str(tmp_path / "clear" / "v000_normal.png"), cv2.IMREAD_UNCHANGED).shape == (*SIZE, 4)


@pytest.mark.parametrize("kind", ["npy", "exr"])
def test_layers_as_linear_numbers(trained: Path, tmp_path: Path, kind: str) -> None:
    """Read by NumPy and by OpenCV or the OpenEXR package, compared with what the API renders."""
    out = tmp_path / "pictures"
    arguments = ["--views", "v000", "--layers", "final,normal,depth", "--format", kind, "--out", str(out)]
    assert run(["render", str(trained), *arguments]) == 0
    names = {f"v000_{layer}.{kind}" for layer in ("final", "normal", "depth")}
    assert {path.name for path in out.iterdir()} == names | {"contact_sheet.png", "layers.json"}
    units = json.loads((out / "layers.json").read_text())
    assert units["final"].startswith("linear radiance")
    assert "scene's units" in units["depth"]
    expected = polarguide.open_run(trained).render("v000", ["final", "normal", "depth"])
    for layer, values in expected.items():
        path = out / f"v000_{layer}.{kind}"
        if kind == "npy":
            found = np.load(path)
        else:
            with pytest.importorskip("OpenEXR").File(str(path)) as file:
                found = file.channels()["RGB"].pixels
                found = found[..., 0] if layer == "depth" else found
        np.testing.assert_allclose(found, values.numpy(), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("with_run", [False, True])
def test_priors_before_and_after_training(
    trained: Path, demo_scene: Path, tmp_path: Path, with_run: bool
) -> None:
    out = tmp_path / "pictures"
    arguments = ["--downscale", "4", "--views", "v000,v003", "--out", str(out)]
    arguments += ["--run", str(trained)] if with_run else []
    assert run(["priors", str(demo_scene), *arguments]) == 0
    names = {path.name for path in out.iterdir()}
    source = "by_run" if with_run else "by_polarization"
    for view in ("v000", "v003"):
        for layer in ("S0", "DoLP", "AoLP", "mask", "specular_paper", f"diffuse_exact_{source}"):
            assert picture(out / f"{view}_{layer}.png").shape[:2] == SIZE
    assert "contact_sheet.png" in names
    assert len(names) == 2 * (len(names) // 2) + 1


def test_a_recipe_without_reflection_goes_through_all_verbs(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    short = ["--downscale", "8", "--steps", "5", "--threads", "1", "--recipe", "3dgs"]
    assert run(["train", str(demo_scene), "--out", str(out), *short]) == 0
    assert run(["eval", str(out)]) == 0
    assert json.loads((out / "metrics.json").read_text())["specular_psnr"] is None
    assert run(["render", str(out), "--views", "v000"]) == 0
    assert (
        "this recipe has no layer aolp, diffuse, dolp, metalness, reflection, roughness, specular, strength"
        in capsys.readouterr().out
    )
    assert not (out / "render" / "v000_specular.png").exists()
    assert (out / "render" / "v000_final.png").exists()


def test_a_changed_scene_is_warned_of(
    trained: Path, demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(trained, tmp_path / "run")
    shutil.copytree(demo_scene, tmp_path / "scene")
    split = tmp_path / "scene" / "split.json"
    split.write_text(split.read_text() + "\n")
    path = tmp_path / "run" / CONFIGURATION
    path.write_text(json.dumps(json.loads(path.read_text()) | {"scene": str(tmp_path / "scene")}))
    arguments = ["--views", "v000", "--layers", "final", "--out", str(tmp_path / "out")]
    assert run(["render", str(tmp_path / "run"), *arguments]) == 0
    assert "has changed since" in capsys.readouterr().out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_and_resumed_is_uninterrupted(
    trained: Path,
    demo_scene: Path,
    short: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    number: signal.Signals,
) -> None:
    """Ctrl-C in the middle of step 17: the state is saved, and --resume ends with the same bits."""
    straight = TrainingLoop.step

    def stopped(self: TrainingLoop) -> StepReport:
        if self.state.step == 17:
            os.kill(os.getpid(), number)
        return straight(self)

    command = ["train", str(demo_scene), "--out", str(tmp_path / "run"), *short]
    with monkeypatch.context() as patch:
        patch.setattr(TrainingLoop, "step", stopped)
        assert run(command) == 130
    assert int(load_file(tmp_path / "run" / CHECKPOINT)["scalars"][0]) == 18
    assert not (tmp_path / "run" / PLY).exists()
    assert signal.getsignal(number) is not None
    assert run([*command, "--resume"]) == 0
    assert differing(tmp_path / "run", trained) == []
    lines = [json.loads(line)["step"] for line in (tmp_path / "run" / LOG).read_text().splitlines()]
    assert lines == [9, 19, 29, 39]
    assert (tmp_path / "run" / PLY).read_bytes() == (trained / PLY).read_bytes()


def test_resuming_a_finished_run_changes_nothing(
    trained: Path, demo_scene: Path, short: tuple[str, ...], tmp_path: Path
) -> None:
    shutil.copytree(trained, tmp_path / "run")
    assert run(["train", str(demo_scene), "--out", str(tmp_path / "run"), *short, "--resume"]) == 0
    assert differing(tmp_path / "run", trained) == []


def test_the_demo_trains_scores_and_renders_and_can_be_gone_on_with(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(polarguide, "demo_scene", lambda: demo_scene)
    for _ in range(2):
        assert run(["demo", "--out", str(tmp_path / "run"), "--steps", "8", "--threads", "1"]) == 0
        validate_metrics(json.loads((tmp_path / "run" / "metrics.json").read_text()))
        assert picture(tmp_path / "run" / "render" / "v000_final.png").shape == (96, 128, 3)
