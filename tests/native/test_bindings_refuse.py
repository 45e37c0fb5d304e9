"""What the rasterizer's binding refuses, before the kernels would read or write beyond the end of something."""

from typing import Any

import pytest
import torch

from polarguide import _native

N, D, HEIGHT, WIDTH = 5, 4, 6, 8


def rasterizer(permutation: list[int] = list(range(D)), statistic: int = 2, width: int = WIDTH) -> Any:  # noqa: B006
    turn = torch.eye(3).flatten().tolist()
    return _native.Rasterizer(turn, [0, 0, 4], [8, 8, 4, 3], width, HEIGHT, 0.01, permutation, statistic)


def gaussians(count: int = N, channels: int = D) -> list[torch.Tensor]:
    turns = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    return [
        torch.zeros(count, 3),
        turns,
        torch.full((count, 3), 0.3),
        torch.full((count,), 0.5),
        torch.ones(count, channels),
    ]


def forward(made: Any) -> None:
    made.forward(*gaussians(), torch.empty(HEIGHT, WIDTH, D), torch.empty(HEIGHT, WIDTH), torch.empty(N))


def backward(made: Any, count: int = N, channels: int = D, of_features: int = D) -> None:
    pictures = [torch.zeros(HEIGHT, WIDTH, D), torch.zeros(HEIGHT, WIDTH, D), torch.zeros(HEIGHT, WIDTH)]
    gradients = gaussians(count, of_features)
    made.backward(*gaussians(count, channels), *pictures, *gradients, torch.empty(count, 2))


def test_backward_follows_forward() -> None:
    made = rasterizer()
    with pytest.raises(ValueError, match="no forward pass was kept for it"):
        backward(made)
    forward(made)
    backward(made)


@pytest.mark.parametrize("count", [0, 4, 6, 1000])
def test_backward_has_the_gaussians_of_forward(count: int) -> None:
    made = rasterizer()
    forward(made)
    with pytest.raises(ValueError, match="as in the forward pass"):
        backward(made, count)


@pytest.mark.parametrize(
    ("channels", "of_features"), [(D + 1, D), (D - 1, D), (D, D + 1), (D, D - 1), (D + 1, D + 1)]
)
def test_backward_has_the_channels_of_forward(channels: int, of_features: int) -> None:
    made = rasterizer()
    forward(made)
    with pytest.raises(ValueError, match="features"):
        backward(made, N, channels, of_features)


@pytest.mark.parametrize(
    "permutation", [[0, 1, 2, 4], [0, 1, 2, -1], [0, 1, 1, 3], [], [0, 1, 2, 2**31 - 1], list(range(100_000))]
)
def test_channels_out_of_range_are_refused(permutation: list[int]) -> None:
    with pytest.raises(ValueError, match="permutation"):
        rasterizer(permutation)


@pytest.mark.parametrize("statistic", [-1, D + 1, 2**31 - 1])
def test_a_statistic_of_channels_that_are_not_is_refused(statistic: int) -> None:
    with pytest.raises(ValueError, match="statistic_channels"):
        rasterizer(statistic=statistic)


@pytest.mark.parametrize("width", [0, -1, 2**31 - 1])
def test_a_picture_of_no_usual_size_is_refused(width: int) -> None:
    with pytest.raises(ValueError, match="camera"):
        rasterizer(width=width)
