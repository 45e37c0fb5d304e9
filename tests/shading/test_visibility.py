"""From where Gaussians are seen."""

from __future__ import annotations

import torch
from torch.nn.functional import normalize

from polarguide.capture import Scene
from polarguide.raster import choose_backend
from polarguide.training.actions import outward_directions


def test_a_wall_is_seen_from_the_side_of_the_cameras_and_what_is_behind_it_is_not(tiny_scene: Scene) -> None:
    """A dense opaque patch before one camera, and one Gaussian well behind it."""
    view = tiny_scene.train_views[0]
    camera = view.camera
    center = camera.center.float()
    ahead = camera.rotation[2].float()
    across = camera.rotation[:2].float()
    steps = torch.linspace(-1.5, 1.5, 25)
    grid = torch.stack(torch.meshgrid(steps, steps, indexing="ij"), dim=-1).reshape(-1, 2)
    wall = center + 2 * ahead + grid @ across
    means = torch.cat((wall, (center + 4 * ahead)[None]))
    count = len(means)
    rows = {
        "means": means,
        "quaternions": torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4),
        "log_scales": torch.full((count, 3), 0.08).log(),
        "opacity_logits": torch.full((count,), 4.0),
        "sh_dc": torch.zeros(count, 3),
        "sh_rest": torch.zeros(count, 15, 3),
    }
    outward = outward_directions(rows, [view], choose_backend("cpu").rasterize)
    middle = grid.norm(dim=1) < 0.5
    toward = normalize(center - wall, dim=-1)
    torch.testing.assert_close(outward[:-1][middle], toward[middle], atol=1e-5, rtol=1e-5)
    assert torch.equal(outward[-1], torch.zeros(3))
