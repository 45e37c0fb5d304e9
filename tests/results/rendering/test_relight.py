"""Panoramas: upright, read back by another program, and turned the right way."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from random_runs import ring

from polarguide.core.errors import PolarguideError
from polarguide.geometry.scene_frame import scene_frame
from polarguide.results.rendering.relight import (
    needs_radiance,
    panorama,
    read_panorama,
    texels_of,
    turned_cubemap,
    write_exr,
)
from polarguide.shading.cubemap import cubemap_lookup, texel_directions
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.directional import DirectionalShading
from polarguide.shading.model import PLAIN

AROUND = scene_frame(list(ring().values()))
LERP, FRESNEL = DeferredShading(), DeferredShading("fresnel")


def smooth_texels(resolution: int = 32) -> torch.Tensor:
    """Raw texels of a light that varies slowly, and differently in all directions."""
    x, y, z = texel_directions(resolution).unbind(-1)
    return torch.stack((x + 0.3 * y, y - 0.5 * z, z * x), dim=-1)


@pytest.mark.parametrize("shading", [LERP, FRESNEL])
def test_a_panorama_becomes_the_light_it_was(shading: DeferredShading) -> None:
    texels = smooth_texels()
    picture = panorama(texels, shading.radiance_cubemap, AROUND, 256)
    back = texels_of(picture, shading.radiance_cubemap, AROUND, 32)
    torch.testing.assert_close(shading.radiance(back), shading.radiance(texels), atol=0.01, rtol=0.01)


def test_a_panorama_is_upright_and_runs_to_the_right() -> None:
    axes = AROUND.panorama_axes().float()
    texels = texel_directions(32) @ axes  # light = (right, up, back)
    picture = panorama(texels, FRESNEL.radiance_cubemap, AROUND, 64).log()
    right, up, back = picture.unbind(-1)
    assert float(up[0].mean()) > 0.99
    assert float(up[-1].mean()) < -0.99
    assert float(back[32, 64]) < -0.99  # the middle looks ahead
    assert float(right[32, 96]) > 0.99  # a quarter of the width further, to the right


def test_turning_moves_what_is_seen_counter_clockwise() -> None:
    texels = smooth_texels()
    turned = turned_cubemap(texels, AROUND.turn(90), 32)
    ahead = -AROUND.panorama_axes()[:, 2]
    left = AROUND.turn(90) @ ahead
    torch.testing.assert_close(
        cubemap_lookup(turned, left.float()[None]),
        cubemap_lookup(texels, ahead.float()[None]),
        atol=0.02,
        rtol=0,
    )


def test_exr_is_read_by_ffmpeg(tmp_path: Path) -> None:
    pytest.importorskip("OpenEXR")
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    picture = torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(0)) * 100
    path = tmp_path / "light.exr"
    write_exr(path, picture)
    command = [ffmpeg, "-v", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "gbrpf32le", "-"]
    planes = np.frombuffer(subprocess.run(command, capture_output=True, check=True).stdout, "<f4").reshape(
        3, 8, 16
    )
    np.testing.assert_array_equal(planes[[2, 0, 1]].transpose(1, 2, 0), picture.numpy())
    torch.testing.assert_close(read_panorama(path), picture)


def test_radiance_hdr_is_read(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).uniform(0.1, 50, (8, 16, 3)).astype(np.float32)
    assert cv2.imwrite(str(tmp_path / "light.hdr"), picture[..., ::-1])
    np.testing.assert_allclose(read_panorama(tmp_path / "light.hdr").numpy(), picture, rtol=0.02, atol=0.3)


def test_what_is_no_panorama_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE nonsense")
    (tmp_path / "b.hdr").write_bytes(b"")
    (tmp_path / "c.png").write_bytes(b"")
    cv2.imwrite(str(tmp_path / "d.hdr"), np.ones((8, 8, 3), np.float32))
    for name in ("a.hdr", "b.hdr", "c.png", "d.hdr", "none.exr"):
        with pytest.raises(PolarguideError, match=r"expected a (panorama|complete|picture)"):
            read_panorama(tmp_path / name)


@pytest.mark.parametrize(
    ("spoiled", "found"), [(float("nan"), "NaN at 1 of 128 pixels"), (None, "no value above 0")]
)
def test_a_panorama_without_light_or_numbers_is_refused(
    tmp_path: Path, spoiled: float | None, found: str
) -> None:
    pytest.importorskip("OpenEXR")
    picture = torch.zeros(8, 16, 3)
    if spoiled is not None:
        picture += 1
        picture[3, 4, 1] = spoiled
    write_exr(tmp_path / "a.exr", picture)
    with pytest.raises(PolarguideError, match=found):
        read_panorama(tmp_path / "a.exr")


@pytest.mark.skipif(sys.platform != "linux", reason="the file system takes names in UTF-8 alone")
def test_an_exr_is_written_under_a_name_that_is_no_utf8(tmp_path: Path) -> None:
    pytest.importorskip("OpenEXR")
    folder = tmp_path / os.fsdecode(b"a\xff")
    folder.mkdir()
    write_exr(folder / "a.exr", torch.ones(8, 16, 3))
    assert [path.name for path in folder.iterdir()] == ["a.exr"]
    assert not (folder / "a.exr").is_symlink()
    assert (read_panorama(folder / "a.exr") == 1).all()


def test_a_damaged_exr_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("OpenEXR")
    (tmp_path / "a.exr").write_bytes(b"v/1\x01 nonsense" * 20)
    with pytest.raises(PolarguideError, match=r"expected a (panorama|complete|picture)"):
        read_panorama(tmp_path / "a.exr")


def test_recipes_without_radiance_say_so() -> None:
    for shading in (DirectionalShading(), PLAIN):
        with pytest.raises(PolarguideError, match="--environment: expected a recipe that learns"):
            needs_radiance(shading, what="--environment")
    assert needs_radiance(FRESNEL, what="") == FRESNEL.radiance_cubemap
    assert math.isfinite(AROUND.distance)
