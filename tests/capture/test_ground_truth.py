"""Ground truth, the objects that it tells apart, and scenes at a smaller size."""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from faults import Fault
from hypothesis import given
from hypothesis import strategies as st
from tiny_capture import HEIGHT, WIDTH, TinyCapture, encode_srgb

from polarguide.capture import box_filter as boxes
from polarguide.capture import load_scene
from polarguide.capture.exposures import Exposure
from polarguide.capture.metadata import Material
from polarguide.capture.variants import SmallerViews, smaller


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
    assert ground_truth.specular is None
    assert ground_truth.diffuse is None
    assert ground_truth.normal.dtype == torch.float32
    lengths = ground_truth.normal.norm(dim=-1)
    assert lengths[:2].eq(0).all()
    torch.testing.assert_close(lengths[2:], torch.ones(HEIGHT - 2, WIDTH))
    assert (ground_truth.depth.dtype, ground_truth.mask.dtype) == (torch.float32, torch.bool)
    assert ground_truth.mask.sum() == 7 * HEIGHT


@pytest.mark.parametrize(
    ("name", "array", "expected", "found"),
    [
        ("normal", np.zeros((12, 10, 3)), "shape [10, 12, 3] like the pictures", "float64 of shape [12, 10, 3]"),
        ("depth", np.full((HEIGHT, WIDTH), "deep"), "", "<U4 of shape [10, 12]"),
        *(
            ("specular", np.pad(np.full((1, 2, 3), value), ((1, HEIGHT - 2), (2, WIDTH - 4), (0, 0))),
             "finite numbers", "6 of 360 values")
            for value in (np.nan, np.inf, 1e300)
        ),
    ],
)  # fmt: skip
def test_arrays_that_are_refused(
    capture: TinyCapture, name: str, array: np.ndarray, expected: str, found: str
) -> None:
    capture.write_truth("v000", **{name: array})
    Fault(f"gt/v000.npz ({name})", expected, found).raised_by(load_scene, capture.root)


@pytest.mark.parametrize("keep", [0, 10, 200, -30])
def test_cut_short(capture: TinyCapture, keep: int) -> None:
    path = capture.write_truth("v000", depth=np.random.default_rng(0).random((HEIGHT, WIDTH)))
    path.write_bytes(path.read_bytes()[:keep])
    Fault(
        "gt/v000.npz",
        expected="a NumPy .npz file",
        remedy="Write it again",
    ).raised_by(load_scene, capture.root)


def test_a_single_array_and_pickled_objects_are_refused(capture: TinyCapture) -> None:
    path = capture.write_truth("v000", depth=np.array([{"a": 1}], dtype=object))
    Fault("gt/v000.npz", found="a damaged one").raised_by(load_scene, capture.root)
    with path.open("wb") as file:
        np.save(file, np.zeros((HEIGHT, WIDTH)))
    Fault("gt/v000.npz", found="one that cannot be unpacked").raised_by(load_scene, capture.root)


CUP = {
    "id": 2,
    "name": "cup",
    "foreground": True,
    "material": {"type": "pplastic", "alpha": 0.03, "ior": 1.5},
}
GROUND = {
    "id": 1,
    "name": "ground",
    "foreground": False,
    "material": {"type": "pplastic", "alpha": 0.3, "ior": 1.5},
}


def numbered(capture: TinyCapture, objects: Any, ids: np.ndarray | None = None) -> TinyCapture:
    ids = np.ones((HEIGHT, WIDTH), np.uint8) if ids is None else ids
    capture.write_truth("v003", objid=ids)
    capture.write_json("scene.json", {"objects": objects, "scene": "tiny"})
    return capture


def test_the_table_is_read(capture: TinyCapture) -> None:
    ground, cup = load_scene(numbered(capture, [GROUND, CUP]).root).objects
    assert (ground.id, ground.name, ground.foreground) == (1, "ground", False)
    assert (cup.id, cup.material.alpha, cup.material.kind) == (2, 0.03, "dielectric")


def test_a_table_that_nothing_refers_to_may_lack_fields(capture: TinyCapture) -> None:
    capture.write_json("scene.json", {"objects": [{"somebody": "else's"}]})
    assert load_scene(capture.root).objects == ()


@pytest.mark.parametrize(
    ("objects", "parts"),
    [
        ([CUP, {**GROUND, "id": 2}], ("(objects)", "unique id", "2 with the id 2")),
        ([CUP, {**GROUND, "name": "cup"}], ("(objects)", "unique name", "2 with the name cup")),
        ([{"name": "cup"}], ("(objects[0])", "the field id", "only name")),
        ([{**CUP, "id": 0}], ("(objects[0].id)", "1 to 65535", "found 0")),
        ([{**CUP, "id": "two"}], ("(objects[0].id)", "a whole number", '"two"')),
        ([{**CUP, "material": "clay"}], ("(objects[0].material)", "a JSON object", '"clay"')),
        ({"cup": 2}, ("(objects)", "a list", '{"cup": 2}')),
    ],
)
def test_a_wrong_table(capture: TinyCapture, objects: Any, parts: tuple[str, ...]) -> None:
    message = str(Fault("scene.json").raised_by(load_scene, numbered(capture, objects).root))
    assert all(part in message for part in (*parts, "Correct it, or remove")), message


@pytest.mark.parametrize(
    ("ids", "fault"),
    [
        (np.full((HEIGHT, WIDTH), 1.5), Fault(found="float64 from 1.5 to 1.5")),
        (np.full((HEIGHT, WIDTH), -1), Fault(found="int64 from -1 to -1")),
        (np.full((HEIGHT, WIDTH), 70000), Fault(found="int64 from 70000 to 70000")),
    ],
)
def test_numbers_that_are_none(capture: TinyCapture, ids: np.ndarray, fault: Fault) -> None:
    caught = fault.raised_by(load_scene, numbered(capture, [CUP], ids).root)
    assert "gt/v003.npz (objid)" in str(caught).replace("\\", "/")


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_a_number_counts_where_its_whole_box_agrees(capture: TinyCapture, factor: int) -> None:
    ids = np.random.default_rng(0).choice([1, 1, 1, 1, 2], (HEIGHT, WIDTH)).astype(np.uint16)
    depth = np.where(np.random.default_rng(1).uniform(size=ids.shape) < 0.2, 0, 2.0 + ids)
    numbered(capture, [CUP, GROUND], ids)
    capture.write_truth("v003", objid=ids, depth=depth)
    found = load_scene(capture.root, downscale=factor).view("v003").ground_truth
    rows, columns = HEIGHT // factor, WIDTH // factor
    assert tuple(found.object_ids.shape) == (rows, columns)
    for y in range(rows):
        for x in range(columns):
            box = np.s_[y * factor : (y + 1) * factor, x * factor : (x + 1) * factor]
            numbers = set(ids[box].ravel().tolist())
            assert int(found.object_ids[y, x]) == (numbers.pop() if len(numbers) == 1 else 0)
            expected = depth[box].mean() if (depth[box] > 0).all() else 0.0
            assert float(found.depth[y, x]) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("material", "kind"),
    [
        (Material("pplastic", 0.03, 1.5), "dielectric"),
        (Material("plastic", 0.15, 1.5), "dielectric"),
        (Material("plastic", 0.16, 1.5), "rough dielectric"),
        (Material("", 0.3, 1.33), "rough dielectric"),
        (Material("roughconductor", 0.12), "metal"),
        (Material("metal", 0.3), "rough metal"),
        (Material("chrome", 0.01, k=[3.0, 3.0, 3.0]), "metal"),
        (Material("matte"), "matte"),
        (Material(), None),
        (Material("wax", 0.2), None),
    ],
)
def test_classes_of_material(material: Material, kind: str | None) -> None:
    assert material.kind == kind


def slow_boxes(values: np.ndarray, factor: int) -> list[list[np.ndarray]]:
    """The pixels of each whole box, [rows][columns] of [K * K, ...]."""
    return [
        [
            values[row : row + factor, column : column + factor].reshape(factor * factor, *values.shape[2:])
            for column in range(0, values.shape[1] - factor + 1, factor)
        ]
        for row in range(0, values.shape[0] - factor + 1, factor)
    ]


def slow(reduce: object, values: np.ndarray, factor: int) -> np.ndarray:
    return np.array([[reduce(box) for box in row] for row in slow_boxes(values, factor)])  # type: ignore[operator]


@pytest.mark.parametrize("factor", [2, 3, 4, 10])
def test_intensities_are_averaged_on_linear_values(capture: TinyCapture, factor: int) -> None:
    capture.rewrite(encode_srgb)
    full = load_scene(capture.root, transfer="srgb")
    small = load_scene(capture.root, transfer="srgb", downscale=factor)
    assert small.downscale == factor
    for one, other in zip(full.views, small.views, strict=True):
        for angle in range(4):
            expected = slow(lambda box: box.mean(axis=0), one.intensities()[angle].double().numpy(), factor)
            np.testing.assert_allclose(other.intensities()[angle].numpy(), expected, atol=0.51 / 65535)


@pytest.mark.parametrize("factor", [2, 3])
def test_camera_keeps_looking_at_the_same_points(capture: TinyCapture, factor: int) -> None:
    full = load_scene(capture.root).views[1].camera
    small = load_scene(capture.root, downscale=factor).views[1].camera
    assert (small.width, small.height) == (WIDTH // factor, HEIGHT // factor)
    assert (small.fx, small.cy) == (full.fx / factor, full.cy / factor)


@pytest.mark.parametrize("factor", [2, 3])
def test_masks_need_all_pixels_and_invalid_any(capture: TinyCapture, factor: int) -> None:
    rng = np.random.default_rng(1)
    mask, invalid = rng.random((2, HEIGHT, WIDTH)) < np.array([0.8, 0.1])[:, None, None]
    for folder, picture in (("masks", mask), ("invalid", invalid)):
        (capture.root / folder).mkdir()
        cv2.imwrite(str(capture.root / folder / "v000.png"), picture.astype(np.uint8) * 255)
    view = load_scene(capture.root, downscale=factor).views[0]
    np.testing.assert_array_equal(view.mask.numpy(), slow(np.all, mask, factor))
    np.testing.assert_array_equal(view.invalid.numpy(), slow(np.any, invalid, factor))


@pytest.mark.parametrize("factor", [2, 3])
def test_one_saturated_or_black_pixel_marks_its_box(capture: TinyCapture, factor: int) -> None:
    values = capture.linear["v000"].copy()
    values[2, 4, 7, 1] = 1.0
    values[:, 0, 0] = 0.0
    capture.write_view("v000", values)
    marked = np.zeros((HEIGHT, WIDTH), bool)
    marked[4, 7] = marked[0, 0] = True
    np.testing.assert_array_equal(load_scene(capture.root).views[0].saturated.numpy(), marked)
    view = load_scene(capture.root, downscale=factor).views[0]
    np.testing.assert_array_equal(view.saturated.numpy(), slow(np.any, marked, factor))


@pytest.mark.parametrize("factor", [2, 3])
def test_ground_truth(capture: TinyCapture, factor: int) -> None:
    rng = np.random.default_rng(2)
    normal = rng.normal(size=(HEIGHT, WIDTH, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    depth, mask = rng.uniform(1, 9, (HEIGHT, WIDTH)), rng.random((HEIGHT, WIDTH)) < 0.8
    normal[~mask] = 0.0
    specular, diffuse = rng.random((2, HEIGHT, WIDTH, 3))
    capture.write_truth("v000", normal=normal, depth=depth, mask=mask, specular=specular, diffuse=diffuse)
    ground_truth = load_scene(capture.root, downscale=factor).views[0].ground_truth
    fields = (
        ground_truth.normal,
        ground_truth.depth,
        ground_truth.mask,
        ground_truth.specular,
        ground_truth.diffuse,
    )
    found = [field.numpy() for field in fields if field is not None]
    mean_normal = slow(lambda box: box.mean(axis=0), normal, factor)
    expected = [
        mean_normal / np.linalg.norm(mean_normal, axis=-1, keepdims=True),
        slow(np.mean, depth, factor),
        slow(np.all, mask, factor),
        slow(lambda box: box.mean(axis=0), specular, factor),
        slow(lambda box: box.mean(axis=0), diffuse, factor),
    ]
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-6)


@given(
    height=st.integers(1, 9),
    width=st.integers(1, 9),
    factor=st.integers(1, 4),
    seed=st.integers(0, 2**32 - 1),
)
def test_box_functions_against_the_reference(height: int, width: int, factor: int, seed: int) -> None:
    if factor > min(height, width):
        return
    codes = np.random.default_rng(seed).integers(0, 65536, (height, width, 3)).astype(np.uint16)
    exact = slow(lambda box: box.astype(np.float64).mean(axis=0), codes, factor)
    assert np.abs(boxes.mean_codes(codes, factor) - exact).max() <= 0.5
    np.testing.assert_array_equal(boxes.maximum(codes[..., 0], factor), slow(np.max, codes[..., 0], factor))
    np.testing.assert_allclose(boxes.mean(codes.astype(np.float32), factor), exact, rtol=1e-6)


def test_normals_that_cancel_become_zero() -> None:
    normals = np.zeros((2, 2, 3), np.float32)
    normals[0], normals[1] = (0, 0, 1), (0, 0, -1)
    np.testing.assert_array_equal(boxes.unit_mean(normals, 2), np.zeros((1, 1, 3)))


@pytest.mark.parametrize("hold", [True, False])
def test_a_scene_is_made_smaller_as_if_it_had_been_read_so(capture: TinyCapture, hold: bool) -> None:
    (capture.root / "invalid").mkdir()
    flags = np.random.default_rng(2).random((HEIGHT, WIDTH)) < 0.1
    cv2.imwrite(str(capture.root / "invalid" / "v001.png"), flags.astype(np.uint8) * 255)
    full = load_scene(capture.root, hold=hold)
    assert smaller(full, max(HEIGHT, WIDTH)) is full
    made, read = smaller(full, max(HEIGHT, WIDTH) // 3), load_scene(capture.root, downscale=3)
    assert [view.name for view in made.views] == [view.name for view in full.train_views]
    for view in made.views:
        other = read.view(view.name)
        assert torch.equal(view.codes, other.codes)
        assert torch.equal(view.invalid, other.invalid)
        assert (view.exposures, view.mount) == (other.exposures, other.mount)
        assert (view.camera.width, view.camera.fx, view.camera.cy) == (
            other.camera.width, other.camera.fx, other.camera.cy,
        )  # fmt: skip
        # Saturation is told before the average here, and after it there, where a box at full scale is needed.
        assert not bool((other.saturated & ~view.saturated).any())


def test_views_are_made_smaller_one_by_one(capture: TinyCapture) -> None:
    """Their pictures are those of a smaller scene; marks of the subject and of materials come along."""
    full = load_scene(capture.root, hold=False)
    materials = torch.zeros(HEIGHT, WIDTH, dtype=torch.uint8)
    materials[: HEIGHT // 2], materials[0, 0] = 2, 1
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:2, :2], mask[3, 3] = True, True
    read = full.train_views
    marked = dataclasses.replace(load_scene(capture.root).train_views[1], materials=materials, mask=mask)
    views = SmallerViews((read[0], marked), 2)
    assert len(views) == 2
    assert views[0] is views[0]
    assert [view.name for view in views] == [view.name for view in views[:]]
    for view, whole in zip(views, smaller(full, max(HEIGHT, WIDTH) // 2 + 1).views, strict=False):
        assert torch.equal(view.codes, whole.codes)
        assert torch.equal(view.invalid, whole.invalid)
        assert view.camera.width == whole.camera.width
        assert torch.equal(view.photograph(), whole.photograph())
    assert views[0].mask is views[0].materials is None
    found = views[1]
    assert found.mask.nonzero().tolist() == [[0, 0]]  # a box that is the subject in part is not
    assert found.materials[0, :2].tolist() == [0, 2]  # a box of two materials is of none
    assert int(found.materials.max()) == 2
    other = found.with_exposures((Exposure(10.0),))
    assert other.exposures == (Exposure(10.0),)
    assert torch.equal(other.codes, found.codes)
