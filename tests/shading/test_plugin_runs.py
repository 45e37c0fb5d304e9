"""A plug-in's recipe through the public interface: trained, opened, scored, exported and ablated by name."""

from pathlib import Path

import pytest
from faults import Fault
from plugins import install
from toy_shading import TOY, SkyShading

import polarguide
from polarguide.shading.deferred import DeferredShading
from polarguide_bench.compare import ablated
from polarguide_bench.plan import model_digest


def test_a_recipe_object_goes_all_the_way(tmp_path: Path, demo_scene: Path) -> None:
    scene = polarguide.load_scene(demo_scene, downscale=8)
    settings = polarguide.TrainSettings(steps=4)
    polarguide.train(scene, tmp_path / "run", recipe=TOY, settings=settings)
    run = polarguide.open_run(tmp_path / "run", recipe=TOY, scene=scene)
    assert run.evaluate()["psnr"] > 5
    assert run.export("ply", tmp_path)[0].stat().st_size > 1000
    Fault(expected="one of").raised_by(polarguide.open_run, tmp_path / "run")
    Fault(expected="toy, which").raised_by(polarguide.open_run, tmp_path / "run", recipe="3dgs")


def test_a_scene_of_another_size_is_refused(trained: Path, demo_scene: Path) -> None:
    other = polarguide.load_scene(demo_scene, downscale=8)
    run = polarguide.open_run(trained, scene=other)
    Fault(expected="downscale 4, transfer linear", found="downscale 8").raised_by(run.evaluate)


def test_the_code_of_a_plugins_model_counts() -> None:
    assert model_digest(DeferredShading) == ""
    assert len(model_digest(SkyShading)) == 16


def test_ablations_of_a_plugin_are_known(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    install(monkeypatch, tmp_path / "site", toy="toy_shading:recipes")
    assert ablated("toy") == ("toy", "toy:dull")
