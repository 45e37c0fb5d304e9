"""Measure the picture and color kernels against their reference implementations in plain torch.

Each number is milliseconds, forward and backward together: the median and, in brackets, the minimum over the
repeats. The two sides take turns, so a busy machine slows both. ``python benchmarks/speed/image_kernels.py``.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor

from polarguide import _native
from polarguide.gaussians.harmonics import evaluate_sh, evaluate_sh_reference
from polarguide.shading.cubemap import cubemap_lookup, cubemap_lookup_reference
from polarguide.training.photometric import photometric_loss, photometric_loss_reference


def forward_backward(
    function: Callable[..., Tensor], leaves: list[Tensor], *rest: object
) -> Callable[[], None]:
    """Run one forward and one backward pass of ``function(*leaves, *rest)`` with a fixed upstream gradient."""
    upstream = torch.rand_like(function(*leaves, *rest).detach())

    def run() -> None:
        for leaf in leaves:
            leaf.grad = None
        function(*leaves, *rest).backward(upstream)

    return run


def photometric_pair(width: int, height: int) -> tuple[Callable[[], None], Callable[[], None]]:
    prediction = (torch.rand(height, width, 3) * 1.1).requires_grad_()
    target = torch.rand(height, width, 3)
    sides = (photometric_loss, photometric_loss_reference)
    ours, reference = (forward_backward(f, [prediction], target) for f in sides)
    return ours, reference


def cubemap_pair(resolution: int, count: int) -> tuple[Callable[[], None], Callable[[], None]]:
    """Return directions like those of a picture: neighbors reflect into neighboring texels."""
    texture = torch.randn(6, resolution, resolution, 3).requires_grad_()
    side = int(count**0.5) + 1
    grid = torch.stack(
        torch.meshgrid(torch.linspace(-2, 2, side), torch.linspace(-2, 2, side), indexing="ij"), -1
    )
    sphere = torch.cat((grid, 1 - grid.square().sum(-1, keepdim=True)), dim=-1).reshape(-1, 3)[:count]
    directions = (sphere + 0.02 * torch.randn(count, 3)).requires_grad_()
    sides = (cubemap_lookup, cubemap_lookup_reference)
    ours, reference = (forward_backward(f, [texture, directions]) for f in sides)
    return ours, reference


def harmonics_pair(count: int, degree: int) -> tuple[Callable[[], None], Callable[[], None]]:
    means, dc, rest = torch.randn(count, 3), torch.randn(count, 3), torch.randn(count, 15, 3)

    def bound(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
        return lambda m, d, r: function(m, torch.zeros(3), d, r, degree)

    leaves = [t.requires_grad_() for t in (means, dc, rest)]
    ours, reference = (forward_backward(bound(f), leaves) for f in (evaluate_sh, evaluate_sh_reference))
    return ours, reference


def milliseconds(sides: tuple[Callable[[], None], ...], repeats: int, seconds: float) -> list[list[float]]:
    """Return times of each side after a warm-up round, with fewer than ``repeats`` repeats of slow calls."""
    times: list[list[float]] = [[] for _ in sides]
    for run in sides:
        run()
    end = time.perf_counter() + seconds
    while len(times[0]) < repeats and (time.perf_counter() < end or len(times[0]) < 3):
        for side, run in enumerate(sides):
            start = time.perf_counter()
            run()
            times[side].append((time.perf_counter() - start) * 1e3)
    return times


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=10, help="at most this long for an operation")
    parser.add_argument(
        "--simd", nargs="*", default=["auto"], help="instruction sets to time, e.g. baseline avx2"
    )
    arguments = parser.parse_args()
    torch.manual_seed(0)
    operations = {
        "photometric 306x256": photometric_pair(306, 256),
        "photometric 1224x1024": photometric_pair(1224, 1024),
        "cubemap 78k, R 128": cubemap_pair(128, 78_336),
        "harmonics 20.8k, degree 3": harmonics_pair(20_800, 3),
        "harmonics 20.8k, degree 1": harmonics_pair(20_800, 1),
    }
    for simd in arguments.simd:
        _native.select_simd(simd)
        print(
            f"\n{_native.simd()}, {_native.thread_count()} threads, torch {torch.get_num_threads()} threads"
        )
        print("| operation | ours ms | reference ms | ratio |\n|---|---|---|---|")
        for name, sides in operations.items():
            ours, reference = milliseconds(sides, arguments.repeats, arguments.seconds)
            a, b = statistics.median(ours), statistics.median(reference)
            print(
                f"| {name} | {a:.2f} ({min(ours):.2f}) | {b:.2f} ({min(reference):.2f}) | {b / a:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
