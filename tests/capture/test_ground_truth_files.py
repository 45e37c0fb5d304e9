"""Ground truth that a capture brings."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from tiny_capture import HEIGHT, WIDTH, TinyCapture

from polarguide.capture import load_scene
from polarguide.errors import PolarguideError


def test_arrays_become_float_tensors_and_unit_normals(capture: TinyCapture) -> None:
    normal = np.zeros((HEIGHT, WIDTH, 3), np.float16)
    normal[2:] = (0.6, 0.0, -0.801)
    capture.write_truth(
        "v003",
        normal=normal,
        depth=np.full((HEIGHT, WIDTH), 2.5, np.float16),
        mask=np.arange(WIDTH)[None].repeat(HEIGHT, 0) > 4,
        objid=np.zeros((HEIGHT, WIDTH), np.uint8),
    )
    scene = load_scene(capture.root)
    ground_truth = scene.view("v003").ground_truth
    assert scene.view("v004").ground_truth is None
    assert ground_truth is not None
    assert ground_truth.specular is None
    assert ground_truth.diffuse is None
    assert ground_truth.normal is not None
    assert ground_truth.normal.dtype == torch.float32
    lengths = ground_truth.normal.norm(dim=-1)
    assert lengths[:2].eq(0).all()
    torch.testing.assert_close(lengths[2:], torch.ones(HEIGHT - 2, WIDTH))
    assert ground_truth.depth is not None
    assert ground_truth.depth.dtype == torch.float32
    assert ground_truth.mask is not None
    assert ground_truth.mask.dtype == torch.bool
    assert ground_truth.mask.sum() == 7 * HEIGHT


def fails(capture: TinyCapture, *parts: str) -> None:
    with pytest.raises(PolarguideError, match=".*".join(re.escape(part) for part in parts)):
        load_scene(capture.root)


def test_another_size(capture: TinyCapture) -> None:
    capture.write_truth("v000", depth=np.zeros((HEIGHT, WIDTH)), normal=np.zeros((WIDTH, HEIGHT, 3)))
    fails(
        capture, "gt/v000.npz (normal)", "shape [10, 12, 3] like the pictures", "float64 of shape [12, 10, 3]"
    )


def test_another_type(capture: TinyCapture) -> None:
    capture.write_truth("v000", depth=np.full((HEIGHT, WIDTH), "deep"))
    fails(capture, "gt/v000.npz (depth)", "found <U4 of shape [10, 12]")


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_values_that_are_not_finite(capture: TinyCapture, value: float) -> None:
    specular = np.zeros((HEIGHT, WIDTH, 3))
    specular[1, 2:4] = value
    capture.write_truth("v000", specular=specular)
    fails(capture, "gt/v000.npz (specular)", "finite numbers", "found 6 of 360 values", "Write zeros")


@pytest.mark.parametrize("keep", [0, 10, 200, -30])
def test_cut_short(capture: TinyCapture, keep: int) -> None:
    path = capture.write_truth("v000", depth=np.random.default_rng(0).random((HEIGHT, WIDTH)))
    path.write_bytes(path.read_bytes()[:keep])
    fails(capture, "gt/v000.npz", "a NumPy .npz file", "a damaged, truncated or other file", "Write it again")


def test_a_single_array_and_pickled_objects_are_refused(capture: TinyCapture) -> None:
    path = capture.write_truth("v000", depth=np.array([{"a": 1}], dtype=object))
    fails(capture, "gt/v000.npz", "a damaged, truncated or other file")
    with path.open("wb") as file:
        np.save(file, np.zeros((HEIGHT, WIDTH)))
    fails(capture, "gt/v000.npz", "a damaged, truncated or other file")
