"""What lies around the median depth: native against the reference, and what it is at edges."""

from __future__ import annotations

import pytest
import torch
from raster_scenes import in_view, looking_ahead, posed, round_gaussian

from polarguide import _native
from polarguide.core.errors import PolarguideError
from polarguide.geometry.camera import Camera
from polarguide.raster import Splats, rasterize_reference
from polarguide.raster.cpu import native_rasterizer, rasterize_cpu
from polarguide.raster.surface import SurfacePicture, surface_picture, surface_reference


def reference(splats: Splats, camera: Camera) -> SurfacePicture:
    return surface_reference(Splats(*(t.double() for t in splats)), camera, rasterize_reference)


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 33), (50, 37)])
def test_native_against_the_reference(simd: str, size: tuple[int, int]) -> None:
    camera = posed(*size)
    splats = in_view(camera, 90, 3, seed=5)
    found, true = surface_picture(splats, camera), reference(splats, camera)
    # Where the weights reach half of their sum within rounding, either of two Gaussians is the median.
    far = (found.depth - true.depth).abs() > 1e-4 * true.depth
    assert float(far.float().mean()) < 0.002
    torch.testing.assert_close(found.depth[~far].double(), true.depth[~far], rtol=1e-4, atol=0)
    torch.testing.assert_close(found.directions[~far].double(), true.directions[~far], rtol=0, atol=2e-3)
    assert float((found.directions[~far] - true.directions[~far]).abs().mean()) < 2e-5


def test_bits_do_not_depend_on_threads(simd: str) -> None:
    camera, before = posed(70, 50), _native.thread_count()
    splats = in_view(camera, 90, 3, seed=6)
    try:
        pictures = []
        for threads in (1, 3):
            _native.set_thread_count(threads)
            pictures.append(surface_picture(splats, camera))
    finally:
        _native.set_thread_count(before)
    assert torch.equal(pictures[0].directions, pictures[1].directions)
    assert torch.equal(pictures[0].depth, pictures[1].depth)


def layers(*depths_and_opacities: tuple[float, float]) -> tuple[Splats, Camera]:
    """Wide Gaussians one behind the other, each with a direction of its own."""
    parts = [round_gaussian(4.0, opacity, depth) for depth, opacity in depths_and_opacities]
    splats = Splats(*(torch.cat(values) for values in zip(*parts, strict=True)))
    return splats._replace(features=torch.eye(3)[: len(parts)]), looking_ahead(5, 5)


def test_of_two_surfaces_it_is_the_one_that_shows_more() -> None:
    for opacity, depth, axis in ((0.45, 6.0, 1), (0.6, 2.0, 0)):
        found = surface_picture(*layers((2.0, opacity), (6.0, 0.98)))
        assert float(found.depth[2, 2]) == pytest.approx(depth, rel=1e-6)
        assert found.directions[2, 2].tolist() == pytest.approx(torch.eye(3)[axis].tolist(), abs=1e-6)
        blended = rasterize_cpu(*layers((2.0, opacity), (6.0, 0.98))).features[2, 2]
        assert 0.3 < float(blended[0] / blended.sum()) < 0.7, "between them, where it is blended"


def test_neighbors_within_the_width_are_averaged() -> None:
    found = surface_picture(*layers((2.0, 0.5), (2.01, 0.9)))
    assert 2.0 < float(found.depth[2, 2]) < 2.01
    assert 0.4 < float(found.directions[2, 2, 0]) < 0.6


def test_where_nothing_is() -> None:
    splats, camera = layers((2.0, 0.9))
    nothing = surface_picture(Splats(*(t[:0] for t in splats)), camera)
    behind = surface_picture(splats._replace(means=-splats.means), camera)
    for found in (nothing, behind):
        assert float(found.depth.abs().max()) == 0
        assert float(found.directions.abs().max()) == 0


def test_a_value_that_is_not_finite_is_named() -> None:
    splats, camera = layers((2.0, 0.9), (3.0, 0.9))
    broken = splats.means.clone()
    broken[1, 0] = torch.nan
    with pytest.raises(PolarguideError, match="Gaussian 1"):
        surface_picture(splats._replace(means=broken), camera)


def test_what_the_kernel_refuses() -> None:
    splats, camera = layers((2.0, 0.9))
    out = torch.empty(5, 5, 4)
    with pytest.raises(ValueError, match="four channels"):
        native_rasterizer(camera, 3, None).surface(*splats, 0.03, torch.empty(5, 5, 3))
    four = splats._replace(features=torch.ones(1, 4))
    for width in (0.0, float("nan")):
        with pytest.raises(ValueError, match="width"):
            native_rasterizer(camera, 4, None).surface(*four, width, out)
    with pytest.raises(ValueError, match="out"):
        native_rasterizer(camera, 4, None).surface(*four, 0.03, torch.empty(5, 4, 4))
    kept = native_rasterizer(camera, 4, None)
    kept.surface(*four, 0.03, out)
    pictures = [torch.zeros(5, 5, 4), torch.zeros(5, 5, 4), torch.zeros(5, 5)]
    with pytest.raises(ValueError, match="no forward pass was kept"):
        kept.backward(*four, *pictures, *(torch.empty_like(t) for t in four), None)
