"""Safe arithmetic, and NumPy arrays in and out."""

import inspect
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import uniform_filter
from torch.testing import assert_close

from polarguide import optics
from polarguide.optics._numerics import window_mean
from polarguide.optics.color import srgb_decode, srgb_encode


@pytest.mark.parametrize("window", [1, 3, 5, 15])
def test_window_means_repeat_the_border(window: int) -> None:
    planes = torch.randn(2, 9, 13, generator=torch.Generator().manual_seed(window), dtype=torch.float64)
    expected = uniform_filter(planes.numpy(), size=(1, window, window), mode="nearest")
    assert_close(window_mean(planes, window), torch.from_numpy(expected), rtol=0, atol=1e-13)


RNG = np.random.default_rng(3)
FOUR = RNG.uniform(0.1, 0.9, (4, 6, 7, 3)).astype(np.float32)
STOKES = optics.stokes(FOUR)
GRAY = optics.luminance(STOKES)
RAYS = np.array([0.1, -0.2, 1.0], np.float32) / np.float32(np.sqrt(1.05))
NORMALS = np.broadcast_to(np.array([0.3, 0.2, -0.93], np.float32), (6, 7, 3))
ANGLE = RNG.uniform(0.1, 1.4, (6, 7)).astype(np.float32)
SHARE = RNG.uniform(0.05, 0.35, (6, 7)).astype(np.float32)
CIRCLE = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)], np.float32)
CALLS: dict[str, tuple[Any, ...]] = {
    "analyzer": (ANGLE[0, 0], RAYS, "filter"),
    "aolp": (GRAY,),
    "azimuth": (NORMALS, RAYS),
    "brewster": (SHARE + 1,),
    "chromatic_normals": (STOKES,),
    "conductor": (SHARE, SHARE + np.float32(0.5)),
    "conductor_dolp_slope": (SHARE, SHARE + 1, SHARE + 2),
    "conductor_index": (SHARE + np.float32(0.5),),
    "conductor_oblique_share": (SHARE, SHARE + 1, SHARE + 2),
    "conductor_reflectances": (SHARE, SHARE + 1, SHARE + 2),
    "diffuse_dolp": (ANGLE,),
    "diffuse_dolp_limit": (SHARE + 1,),
    "diffuse_zenith": (SHARE,),
    "disambiguate": (optics.physical_candidates(GRAY, RAYS), NORMALS),
    "dolp": (GRAY,),
    "dolp_noise": (GRAY, SHARE),
    "dolp_slopes": (SHARE,),
    "exact_separation": (STOKES, NORMALS, RAYS),
    "filter_analyzer": (ANGLE[0, 0], RAYS),
    "fitted_stokes": (FOUR, CIRCLE),
    "fitted_uncertainty": (GRAY, np.concatenate([FOUR[..., 0], FOUR[:2, ..., 0]]) * np.float32(1e-4)),
    "intensity": (GRAY, ANGLE),
    "intensity_noise": (FOUR[..., 0], 3),
    "lens_frame": (RAYS,),
    "luminance": (STOKES,),
    "normal_from_angles": (ANGLE, ANGLE, RAYS),
    "paper_candidates": (GRAY, RAYS),
    "paper_intensities": (STOKES, ANGLE, ANGLE, 0.5),
    "paper_separation": (STOKES, ANGLE),
    "photograph": (STOKES,),
    "physical_candidates": (GRAY, RAYS),
    "polarization_mask": (GRAY,),
    "polarization_uncertainty": (GRAY, FOUR[..., 0] * np.float32(1e-4)),
    "predicted_stokes": (STOKES[0], STOKES[0], NORMALS, RAYS),
    "reflectances": (ANGLE,),
    "reflectances_from_cosine": (SHARE,),
    "specular_dolp": (ANGLE,),
    "specular_zeniths": (SHARE,),
    "stokes": (FOUR,),
    "transmittances": (ANGLE,),
    "zenith": (NORMALS, RAYS),
}


def flat(value: Any) -> list[Any]:
    return [part for item in value for part in flat(item)] if isinstance(value, tuple) else [value]


def as_tensors(value: Any) -> Any:
    if isinstance(value, tuple):
        return (
            type(value)(*map(as_tensors, value))
            if hasattr(value, "_fields")
            else tuple(map(as_tensors, value))
        )
    return torch.tensor(np.array(value)) if isinstance(value, np.ndarray) else value


def test_every_function_is_called_here() -> None:
    public = {name for name in optics.__all__ if inspect.isfunction(getattr(optics, name))}
    assert public == set(CALLS)


@pytest.mark.parametrize("name", sorted(CALLS))
def test_arrays_in_arrays_out(name: str) -> None:
    function = getattr(optics, name)
    found = function(*CALLS[name])
    true = function(*(as_tensors(argument) for argument in CALLS[name]))
    assert type(found) is type(true) or isinstance(found, np.ndarray)
    for ours, theirs in zip(flat(found), flat(true), strict=True):
        assert isinstance(ours, np.ndarray)
        np.testing.assert_array_equal(ours, theirs.numpy())


@pytest.mark.parametrize(
    ("kind", "result"),
    [
        (np.int32, np.float64), (np.float16, np.float32), (np.float32, np.float32), (np.float64, np.float64),
        (">f4", np.float32),
    ],
)  # fmt: skip
def test_numbers_of_every_kind(kind: Any, result: Any) -> None:
    values = np.array([[10], [20], [30]]).astype(kind)
    assert optics.dolp(values).dtype == result
    if np.dtype(kind).kind == "f":
        four = np.array([[10], [20], [30], [5]]).astype(kind)
        assert optics.stokes(four)[:, 0].tolist() == [32.5, -20.0, 15.0]


@pytest.mark.parametrize(("kind", "full"), [("u1", 255), ("<u2", 65535), (">u2", 65535)])
def test_codes_are_shares_of_full_scale(kind: str, full: int) -> None:
    """As ``read_shot`` takes them. Differences of unsigned numbers would wrap around."""
    codes = np.array([[10], [20], [30], [5]]).astype(kind)
    expected = np.array([32.5, -20.0, 15.0]) / full
    assert optics.stokes(codes)[:, 0] == pytest.approx(expected, rel=1e-6)
    found = optics.stokes(torch.from_numpy(codes.astype(codes.dtype.newbyteorder("="))))
    assert found[:, 0].tolist() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("kind", [np.int32, np.uint32, np.int8, bool])
def test_other_whole_numbers_tell_no_full_scale(kind: Any) -> None:
    for four in (np.ones((4, 2), kind), torch.from_numpy(np.ones((4, 2), kind))):
        with pytest.raises(ValueError, match="divide them by full scale"):
            optics.stokes(four)


def test_views_and_read_only_arrays() -> None:
    four = np.broadcast_to(np.arange(4.0)[:, None], (4, 5))[:, ::-1]
    assert not four.flags.writeable
    assert optics.stokes(four).shape == (3, 5)
    assert (optics.stokes(four)[1] == -2).all()


def test_a_tensor_among_arrays_gives_tensors() -> None:
    assert isinstance(optics.intensity(torch.from_numpy(GRAY), ANGLE), torch.Tensor)


def test_tensors_keep_their_gradient() -> None:
    stokes = torch.tensor([1.0, 0.2, 0.1], requires_grad=True)
    optics.dolp(stokes).backward()
    assert stokes.grad.abs().sum() > 0


def test_something_else_than_numbers() -> None:
    with pytest.raises(TypeError, match="array"):
        optics.stokes(np.array(["a", "b", "c", "d"]))


def standard(linear: float) -> float:
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055


def test_encoding_is_the_standards_formula() -> None:
    values = torch.linspace(0, 1, 400, dtype=torch.float64)
    expected = torch.tensor([standard(float(v)) for v in values], dtype=torch.float64)
    torch.testing.assert_close(srgb_encode(values), expected)


@pytest.mark.parametrize(
    ("linear", "code"), [(0.0, 0), (1.0, 255), (0.21404, 127.5), (0.0722, 75.96), (0.0003035, 1.0)]
)
def test_known_codes(linear: float, code: float) -> None:
    assert 255 * float(srgb_encode(torch.tensor(linear))) == pytest.approx(code, abs=0.1)


def test_decoding_is_the_inverse() -> None:
    values = torch.linspace(0, 1, 999, dtype=torch.float64)
    torch.testing.assert_close(srgb_decode(srgb_encode(values)), values, atol=1e-7, rtol=1e-6)
    torch.testing.assert_close(srgb_encode(srgb_decode(values)), values, atol=1e-7, rtol=1e-6)


def test_gradients_against_finite_differences() -> None:
    values = torch.tensor([1e-4, 2e-3, 0.01, 0.2, 0.7, 1.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(srgb_encode, (values,))
    assert torch.autograd.gradcheck(srgb_decode, (values,))


@pytest.mark.parametrize("function", [srgb_encode, srgb_decode])
def test_gradients_are_finite_at_black_and_below(function: object) -> None:
    values = torch.tensor([-0.1, 0.0, 1e-12], requires_grad=True)
    function(values).sum().backward()  # type: ignore[operator]
    assert bool(torch.isfinite(values.grad).all())
    assert bool((values.grad > 0).all())
