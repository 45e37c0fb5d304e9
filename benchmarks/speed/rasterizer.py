"""Measure the CPU rasterizer: milliseconds, pixel-Gaussian pairs per second, and shares of the hardware's peaks.

The first case has few Gaussians of three pixels and is bound by their pairs with pixels. The second case has many
Gaussians of half a pixel and is bound by gathering them. The same run measures both peaks: independent fused
multiply-adds with the widest instruction set and all threads, and a copy between two arrays that no cache holds.

A pair counts 150 flop for both passes, 50 of them forward. Memory traffic is the minimum of reads and writes: each
Gaussian and its gradient, each pixel and its gradient, once.

    python benchmarks/speed/rasterizer.py [--threads 1]

Run it without other work on the machine.
"""

from __future__ import annotations

import argparse
import statistics
import time

import torch

from polarguide import _native
from polarguide.geometry.camera import Camera
from polarguide.raster import use_threads
from polarguide.raster.cpu import native_rasterizer
from polarguide.raster.interface import ScreenStatistic, Splats

FLOP_PER_PAIR = 150


def scene(count: int, width: int, height: int, channels: int, sigma: float) -> tuple[Splats, Camera]:
    """Return Gaussians of about ``sigma`` pixels, spread over the picture, of mixed shape and opacity."""
    generator = torch.Generator().manual_seed(0)
    camera = Camera(
        width, height, width, width, width / 2, height / 2, torch.eye(3).double(), torch.zeros(3).double()
    )
    depth = 2 + 4 * torch.rand(count, generator=generator)
    x = (torch.rand(count, generator=generator) - 0.5) * depth
    y = (torch.rand(count, generator=generator) - 0.5) * depth * height / width
    scales = sigma / width * depth[:, None] * torch.exp(0.4 * torch.randn(count, 3, generator=generator))
    rotations = torch.randn(count, 4, generator=generator)
    opacities = 0.05 + 0.6 * torch.rand(count, generator=generator)
    features = torch.rand(count, channels, generator=generator)
    return Splats(torch.stack((x, y, depth), dim=1), rotations, scales, opacities, features), camera


CASES = {"pairs": (20_000, 3.0), "gathering": (300_000, 0.5)}
COPIED = 256 << 20
"""Size of a float in bytes."""
OF_GAUSSIAN, OF_PIXEL = 11, 1
"""Floats of a Gaussian (mean, rotation, scales, opacity) and of a pixel (alpha), without features."""


def bandwidth() -> float:
    """Return the bytes per second that a copy reads and writes."""
    source, to = torch.ones(COPIED // 4), torch.empty(COPIED // 4)
    times = []
    for _ in range(7):
        start = time.perf_counter()
        to.copy_(source)
        times.append(time.perf_counter() - start)
    return 2 * COPIED / min(times)


def measured(count: int, sigma: float, channels: int, size: tuple[int, int], repeats: int) -> list[float]:
    """Return pairs, and median seconds of the forward and of the backward pass."""
    width, height = size
    splats, camera = scene(count, width, height, channels, sigma)
    rasterizer = native_rasterizer(camera, channels, ScreenStatistic((0, 1, 2)))
    out, alpha = torch.empty(height, width, channels), torch.empty(height, width)
    radii, screen = torch.empty(count), torch.empty(count, 2)
    grad_out, grad_alpha = torch.randn_like(out), torch.randn_like(alpha)
    gradients = [torch.empty_like(t) for t in splats]
    rasterizer.forward(*splats, out, alpha, radii, count_pairs=True)
    pairs = rasterizer.pairs
    forward, backward = [], []
    for _ in range(repeats):
        start = time.perf_counter()
        rasterizer.forward(*splats, out, alpha, radii)
        middle = time.perf_counter()
        rasterizer.backward(*splats, out, grad_out, grad_alpha, *gradients, screen)
        forward.append(middle - start)
        backward.append(time.perf_counter() - middle)
    return [pairs, statistics.median(forward[5:]), statistics.median(backward[5:])]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240))
    parser.add_argument("--channels", type=int, nargs="+", default=[3, 7, 8, 11, 12, 16])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=40)
    arguments = parser.parse_args()
    use_threads(arguments.threads)
    peak, memory = _native.fma_peak(0.5), bandwidth()
    print(
        f"{_native.simd()}, {_native.thread_count()} threads, {peak / 1e9:.0f} GFLOP/s, {memory / 1e9:.1f} GB/s\n"
    )
    print("| bound by | D | pairs | forward ms | backward ms | Mpairs/s | share of flop | share of memory |")
    print("|---|---|---|---|---|---|---|---|")
    for name, (count, sigma) in CASES.items():
        for channels in arguments.channels:
            size = tuple(arguments.size)
            pairs, f, b = measured(count, sigma, channels, size, arguments.repeats)
            # Gaussians: read twice, gradients written. Pictures: written, read again, and their gradients.
            floats = 3 * count * (OF_GAUSSIAN + channels) + 3 * size[0] * size[1] * (OF_PIXEL + channels)
            print(
                f"| {name} | {channels} | {pairs / 1e6:.2f} M | {f * 1e3:.2f} | {b * 1e3:.2f} "
                f"| {pairs / (f + b) / 1e6:.0f} | {pairs * FLOP_PER_PAIR / (f + b) / peak:.1%} "
                f"| {4 * floats / (f + b) / memory:.1%} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
