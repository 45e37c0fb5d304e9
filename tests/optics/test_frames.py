"""The lens frame and normals as angles in it."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from polarguide import optics

coordinate = st.floats(-1.5, 1.5)
shapes = st.lists(st.integers(0, 3), max_size=3).map(tuple)


def ray(x: float, y: float) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.tensor((x, y, 1.0), dtype=torch.float64), dim=0)


def rolled(angle: float) -> torch.Tensor:
    """Rotation about the optical axis that turns image right toward image down."""
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor(((c, -s, 0), (s, c, 0), (0, 0, 1)), dtype=torch.float64)


def test_axes_on_the_optical_axis() -> None:
    right, up = optics.lens_frame(ray(0, 0))
    assert right.tolist() == [1, 0, 0]
    assert up.tolist() == [0, -1, 0]


@given(x=coordinate, y=coordinate)
def test_frame_is_right_handed_and_orthonormal(x: float, y: float) -> None:
    d = ray(x, y)
    right, up = optics.lens_frame(d)
    frame = torch.stack((right, up, -d))
    assert torch.allclose(frame @ frame.T, torch.eye(3, dtype=torch.float64), atol=1e-14)
    assert float(torch.det(frame)) == pytest.approx(1.0, abs=1e-14)


@given(x=st.floats(0.05, 1.5), y=coordinate)
def test_frame_is_the_smallest_rotation_from_the_axis(x: float, y: float) -> None:
    d = ray(x, y)
    forward = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
    axis = torch.nn.functional.normalize(torch.linalg.cross(forward, d), dim=0)
    angle = math.acos(float(d[2]))
    for moved, at_center in zip(optics.lens_frame(d), ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0)), strict=True):
        v = torch.tensor(at_center, dtype=torch.float64)
        turned = v * math.cos(angle) + torch.linalg.cross(axis, v) * math.sin(angle)
        turned = turned + axis * (axis @ v) * (1 - math.cos(angle))
        assert torch.allclose(moved, turned, atol=1e-12)


@given(x=coordinate, y=coordinate, polar=st.floats(0.01, math.pi - 0.01), turn=st.floats(-math.pi, math.pi))
def test_zenith_and_azimuth_round_trip(x: float, y: float, polar: float, turn: float) -> None:
    d = ray(x, y)
    angles = torch.tensor((polar, turn), dtype=torch.float64)
    normal = optics.normal_from_angles(angles[0], angles[1], d)
    assert float(normal.norm()) == pytest.approx(1.0, abs=1e-13)
    assert float(optics.zenith(normal, d)) == pytest.approx(polar, abs=1e-12)
    assert math.remainder(float(optics.azimuth(3 * normal, d)) - turn, 2 * math.pi) == pytest.approx(
        0, abs=1e-11
    )
    assert float(-normal @ d) == pytest.approx(math.cos(polar), abs=1e-13)


@given(x=coordinate, y=coordinate, roll=st.floats(-3, 3))
def test_azimuth_turns_with_the_camera_and_zenith_does_not(x: float, y: float, roll: float) -> None:
    turn = rolled(roll)
    d = ray(x, y)
    normal = optics.normal_from_angles(
        torch.tensor(0.7, dtype=torch.float64), torch.tensor(1.1, dtype=torch.float64), d
    )
    seen, toward = turn @ normal, turn @ d
    assert float(optics.zenith(seen, toward)) == pytest.approx(0.7, abs=1e-12)
    # Right turns toward down, which is clockwise as displayed, so azimuths shrink.
    difference = float(optics.azimuth(seen, toward)) - (1.1 - roll)
    assert math.remainder(difference, 2 * math.pi) == pytest.approx(0, abs=1e-11)


def test_azimuth_is_counter_clockwise_as_displayed() -> None:
    up = torch.tensor((0.0, -1.0, 0.0), dtype=torch.float64)
    assert float(optics.azimuth(up, ray(0, 0))) == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("z", [1.0, -1.0])
def test_gradient_is_finite_where_the_normal_has_no_azimuth(z: float, dtype: torch.dtype) -> None:
    for vector in ((0.0, 0.0, -1.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)):
        normal = torch.tensor(vector, dtype=dtype, requires_grad=True)
        rays = torch.tensor((0.0, 0.0, z), dtype=dtype, requires_grad=True)
        total = optics.zenith(normal, rays) + optics.azimuth(normal, rays)
        total = total + optics.lens_frame(rays)[0].sum() + optics.lens_frame(rays)[1].sum()
        total.backward()
        assert torch.isfinite(total)
        assert torch.isfinite(normal.grad).all()
        assert torch.isfinite(rays.grad).all()


def test_zenith_at_normal_incidence_is_exact() -> None:
    d = ray(0.4, -0.3)
    assert float(optics.zenith(-d, d)) < 1e-15
    assert float(optics.zenith(d, d)) == pytest.approx(math.pi, abs=1e-15)


@given(shape=shapes, dtype=st.sampled_from([torch.float32, torch.float64]))
def test_any_batch_shape_and_dtype(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    rays = torch.nn.functional.normalize(torch.randn(*shape, 3, dtype=dtype), dim=-1)
    polar, turn = torch.rand(shape, dtype=dtype), torch.rand(shape, dtype=dtype)
    normals = optics.normal_from_angles(polar, turn, rays)
    assert normals.shape == (*shape, 3)
    assert normals.dtype == dtype
    assert optics.zenith(normals, rays).shape == shape
    assert torch.allclose(optics.zenith(normals, rays), polar, atol=1e-4)
