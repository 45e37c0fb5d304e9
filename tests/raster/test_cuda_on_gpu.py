"""gsplat against the reference implementation, on a GPU; ``test_cuda.py`` tests what needs none."""

from importlib.metadata import version

import pytest
import torch
from raster_scenes import (
    Outcome,
    differences,
    in_view,
    looking_ahead,
    outcome,
    posed,
    round_gaussian,
)
from reference_rasterizer import rasterize_reference

from polarguide.raster import Splats, choose_backend
from polarguide.raster.cpu import rasterize_cpu
from polarguide.raster.cuda import has_gsplat, rasterize_cuda
from polarguide.raster.surface import surface_picture

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(
        not torch.cuda.is_available(), reason="no CUDA GPU -> on a machine with one: make gpu-check"
    ),
    pytest.mark.skipif(not has_gsplat(), reason="no gsplat -> pip install '.[cuda]'"),
]

# Norm of the difference over the norm, float32 with fast exponentials against float64.
TOLERANCES = {
    "features": 2e-5,
    "alpha": 2e-5,
    "gradient of means": 1e-3,
    "gradient of rotations": 1e-3,
    "gradient of scales": 1e-3,
    "gradient of opacities": 2e-4,
    "gradient of features": 1e-4,
    "statistic": 1e-3,
}


@pytest.fixture(scope="module", autouse=True)
def kernels() -> None:
    choose_backend("cuda")


def there(gaussians: Splats) -> Splats:
    return Splats(*(t.cuda() for t in gaussians))


def here(found: Outcome) -> Outcome:
    gradients = Splats(*(t.cpu() for t in found.gradients))
    statistic = None if found.statistic is None else found.statistic.cpu()
    return Outcome(found.features.cpu(), found.alpha.cpu(), found.radii.cpu(), gradients, statistic)


@pytest.mark.parametrize("channels", [1, 3, 6, 7, 8, 11, 32])
@pytest.mark.parametrize("statistic", [None, (0,), (0, 1, 2), (1, 4)])
def test_gsplat_agrees_with_the_reference(channels: int, statistic: tuple[int, ...] | None) -> None:
    if statistic and max(statistic) >= channels:
        statistic = tuple(range(channels))
    camera = posed(50, 37)
    gaussians = in_view(camera, 60, channels, seed=channels)
    found = here(outcome(rasterize_cuda, there(gaussians), camera, statistic))
    expected = outcome(rasterize_reference, gaussians, camera, statistic, dtype=torch.float64)
    worst = differences(found, expected)
    worst.pop("radii")  # of another kind
    assert {name: d for name, d in worst.items() if not d < TOLERANCES[name]} == {}
    assert bool((found.radii[expected.radii > 0] > 0).all())


def test_a_large_picture_agrees_with_the_cpu() -> None:
    camera = posed(640, 480)
    small = in_view(posed(64, 48), 40, 8, seed=4)
    jitter = torch.randn(50 * 40, 3, generator=torch.Generator().manual_seed(0))
    many = Splats(*(torch.cat([t] * 50) for t in small))
    many = many._replace(means=many.means + 0.3 * jitter, opacities=many.opacities * 0.3)
    found = here(outcome(rasterize_cuda, there(many), camera, (0, 1, 2)))
    expected = outcome(rasterize_cpu, many, camera, (0, 1, 2))
    # Pixels near a cut-off may fall on either side: few, so the whole is close.
    assert differences(found, expected)["features"] < 1e-3
    assert differences(found, expected)["statistic"] < 1e-2


def test_alpha_is_capped_later_than_ours_in_the_first_version() -> None:
    """0.999 in 1.5.3, 0.99 in 1.6.0 and here: an opaque Gaussian hides more."""
    camera, opaque = looking_ahead(9, 9), round_gaussian(5.0, 0.9999)
    assert float(rasterize_reference(opaque, camera).alpha.max()) == pytest.approx(0.99, abs=1e-4)
    found = rasterize_cuda(there(opaque), camera).alpha
    cap = 0.999 if version("gsplat").startswith("1.5") else 0.99
    assert float(found.max()) == pytest.approx(cap, abs=1e-4)


def test_nothing_in_view_is_an_empty_picture() -> None:
    camera, behind = looking_ahead(9, 9), round_gaussian(0.1, 0.5, depth=-3.0)
    found = outcome(rasterize_cuda, there(behind), camera, (0,))
    assert not bool(found.features.any())
    assert not bool(found.radii.any())
    assert all(bool(torch.isfinite(t).all()) for t in found.gradients)


def test_the_surface_comes_back_to_the_gpu() -> None:
    camera = posed(31, 18)
    splats = in_view(camera, 60, 3, seed=8)
    found = surface_picture(Splats(*(t.cuda() for t in splats)), camera)
    for ours, true in zip(found, surface_picture(splats, camera), strict=True):
        assert ours.is_cuda
        torch.testing.assert_close(ours.cpu(), true)
