"""The short training runs all steps, or stops where it is told to."""

from __future__ import annotations

from polarguide.capture import load_scene
from polarguide.inspection.evidence import short_run, trained_surface
from polarguide.raster import choose_backend


def test_it_gives_a_surface_and_stops_where_it_is_told_to(demo_scene) -> None:
    small = load_scene(demo_scene, downscale=4)
    backend = choose_backend("auto")
    seen: list[int] = []
    state = short_run(small, steps=5, until=3, backend=backend, on_step=lambda r: seen.append(r.step))
    assert seen == [0, 1, 2]
    surface = trained_surface(state, small.views[0], backend)
    assert surface.normal.shape == (*surface.known.shape, 3)
    assert surface.depth.shape == surface.known.shape
    assert short_run(small, steps=2, backend=backend, on_step=lambda _: None).step == 2
