"""The short training goes on where it stopped, and sees nothing of the order of the pictures."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from polarguide.capture import load_scene
from polarguide.inspection.evidence import photograph_digest, short_run, trained_surface
from polarguide.raster import choose_backend


@pytest.fixture(scope="module")
def small(demo_scene):
    return load_scene(demo_scene, downscale=4)


def test_its_key_ignores_the_order_of_the_pictures_and_nothing_else(small) -> None:
    def with_first(**changes):
        views = list(small.views)
        place = next(k for k, view in enumerate(views) if view.name not in small.test_names)
        views[place] = dataclasses.replace(views[place], **{k: f(views[place]) for k, f in changes.items()})
        return dataclasses.replace(small, views=tuple(views))

    key = photograph_digest(small)
    assert photograph_digest(with_first(pictures=lambda v: v.codes[[2, 1, 0, 3]])) == key
    assert photograph_digest(with_first(pictures=lambda v: (v.codes.int() + 1).to(torch.uint16))) != key
    moved = with_first(camera=lambda v: dataclasses.replace(v.camera, translation=v.camera.translation + 0.1))
    assert photograph_digest(moved) != key


def test_it_goes_on_and_is_not_repeated(small, tmp_path) -> None:
    backend = choose_backend("auto")
    seen: list[int] = []

    def stop(report) -> None:
        seen.append(report.step)
        if report.step == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        short_run(small, tmp_path, steps=5, backend=backend, on_step=stop)
    short_run(small, tmp_path, steps=5, backend=backend, on_step=lambda r: seen.append(r.step))
    assert seen == [0, 1, 2, 3, 4]
    state = short_run(small, tmp_path, steps=5, backend=backend, on_step=lambda r: seen.append(r.step))
    assert len(seen) == 5
    surface = trained_surface(state, small.views[0], backend)
    assert surface.normal.shape == (*surface.known.shape, 3)
    assert surface.depth.shape == surface.known.shape
    short_run(small, tmp_path, steps=2, backend=backend, on_step=lambda r: seen.append(r.step))
    assert seen[5:] == [0, 1]
