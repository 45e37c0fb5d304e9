"""Pictures larger than those of the training show what the training saw, not needles."""

from dataclasses import replace

import pytest
import torch
from raster_scenes import in_view, looking_ahead, posed, round_gaussian

from polarguide.raster.cpu import rasterize_cpu
from polarguide.raster.magnification import as_trained, footprints

SCALES = torch.tensor([[0.002, 0.05, 0.3]])  # a needle: much narrower than a pixel one way


def test_footprints_are_those_of_the_nearest_camera_that_has_it_in_the_picture() -> None:
    near, far = looking_ahead(40, 30, 50.0), looking_ahead(40, 30, 25.0)
    aside = replace(near, translation=torch.tensor([100.0, 0.0, 0.0], dtype=torch.float64))
    means = torch.tensor(
        [[0.0, 0.0, 2.0], [0.0, 0.0, 6.0], [0.9, 0.0, 2.0], [0.0, 0.0, -2.0], [50.0, 0.0, 2.0]]
    )
    # In the middle, near and far away; in the wider picture alone; behind; in neither.
    expected = [2 / 50, 6 / 50, 2 / 25, 0.0, 0.0]
    assert footprints(means, [near, far, aside]).tolist() == pytest.approx(expected)


@pytest.mark.parametrize("factor", [3, 5])  # odd: pixels of both pictures have centers in common
def test_a_larger_picture_agrees_with_the_trainings(factor: int) -> None:
    camera = looking_ahead(40, 40, 60.0)
    larger = camera.scaled(factor, factor * 40, factor * 40)
    needle = round_gaussian(1.0, 0.9)._replace(scales=SCALES)  # between the middle pixels
    common = slice(factor // 2, None, factor)
    trained = rasterize_cpu(needle, camera).alpha
    drawn = rasterize_cpu(as_trained(needle, larger, footprints(needle.means, [camera])), larger).alpha
    as_it_is = rasterize_cpu(needle, larger).alpha
    torch.testing.assert_close(drawn[common, common], trained, atol=2e-3, rtol=0)
    assert float((as_it_is[common, common] - trained).abs().max()) > 0.1


def test_nothing_changes_in_pictures_of_the_training_and_in_smaller_ones() -> None:
    camera = posed(50, 37)
    splats = in_view(camera, 60, 3, seed=1)
    sizes = footprints(splats.means, [camera])
    for view in (camera, camera.downscaled(3)):
        torch.testing.assert_close(as_trained(splats, view, sizes).scales, splats.scales, rtol=1e-4, atol=0)
    wider = as_trained(splats, camera.scaled(2, 100, 74), sizes).scales > splats.scales
    assert torch.equal(wider.all(dim=1), sizes > 0)
