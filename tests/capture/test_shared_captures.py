"""The larger captures beside the checkout, and the demo that ships with the package."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import polarguide
from polarguide.capture import load_scene

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
DEMO = Path(polarguide.__file__).parent / "data" / "demo"


def shared(name: str) -> Path:
    path = SHARED / name
    if not path.is_dir():
        pytest.skip("no captures in ../shared -> ln -s FOLDER ../shared")
    return path


@pytest.mark.parametrize("place", ["package", pytest.param("shared", marks=pytest.mark.shared)])
def test_demo(place: str) -> None:
    scene = load_scene(DEMO if place == "package" else shared("scenes/demo"))
    assert len(scene.views) == (50 if place == "package" else 27)
    assert scene.test_names == ("v000", "v022", "v044", "v066")
    assert scene.refractive_index == 1.5
    assert scene.warnings == ()
    assert scene.points.shape == (4846, 3)
    for view in scene.test_views:
        ground_truth = view.ground_truth
        assert ground_truth is not None
        assert ground_truth.normal is not None
        assert ground_truth.mask is not None
        assert ground_truth.specular is not None
        assert ground_truth.diffuse is not None
        lengths = ground_truth.normal[ground_truth.mask].norm(dim=-1)
        torch.testing.assert_close(lengths, torch.ones_like(lengths))
        # On surfaces the two lobes add up to S0, which is twice the photograph.
        light = (ground_truth.specular + ground_truth.diffuse)[ground_truth.mask] / 2
        assert (view.photograph()[ground_truth.mask] - light).abs().median() < 5e-3


@pytest.mark.shared
@pytest.mark.parametrize(("name", "share"), [("spheres", 1e-3), ("water", 0.05)])
def test_saturation_of_the_rendered_scenes(name: str, share: float) -> None:
    scene = load_scene(shared(f"scenes/{name}"))
    assert scene.warnings == ()
    worst = max(float(view.saturated.float().mean()) for view in scene.views)
    assert 0.5 * share < worst < share


@pytest.mark.shared
def test_real_capture() -> None:
    scene = load_scene(shared("real/wwbottle"), downscale=4, split="every-8th")
    assert len(scene.views) == 60
    assert scene.warnings == ()
    assert scene.refractive_index is None
    assert scene.test_names[:3] == ("000", "008", "016")
    assert scene.views[0].codes.shape == (4, 128, 153, 3)
    assert scene.views[0].camera.fx == pytest.approx(1869.689706 / 4)
    residuals = []
    for view in scene.views[::10]:
        i0, i45, i90, i135 = view.intensities()
        residuals.append(((i0 + i90 - i45 - i135).abs() / (i0 + i45 + i90 + i135) * 2).median())
    assert 0.01 < float(torch.stack(residuals).median()) < 0.03
