"""The CPU rasterizer's speed: milliseconds, pixel-Gaussian pairs a second, and the share of the processor's peak.

The peak is measured in the same run (independent fused multiply-adds, widest instruction set, all threads). A pair
counts 150 flop for both passes, 50 of them forward. Run it alone: ``python benchmarks/speed/rasterizer.py``.
"""

from __future__ import annotations

import argparse
import statistics
import time

import torch

from polarguide import _native
from polarguide.camera import Camera
from polarguide.raster.cpu import native_rasterizer
from polarguide.raster.interface import ScreenStatistic, Splats

FLOP_PER_PAIR = 150


def scene(count: int, width: int, height: int, channels: int, sigma: float) -> tuple[Splats, Camera]:
    """Gaussians of about ``sigma`` pixels, spread over the picture, of mixed shape and opacity."""
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gaussians", type=int, default=20_000)
    parser.add_argument("--sigma", type=float, default=3.0)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240))
    parser.add_argument("--repeats", type=int, default=40)
    arguments = parser.parse_args()
    width, height = arguments.size
    peak = _native.fma_peak(0.5)
    print(f"{_native.simd()}, {_native.thread_count()} threads, peak {peak / 1e9:.0f} GFLOP/s")
    print("| D | pairs | forward ms | backward ms | Mpairs/s | of peak |\n|---|---|---|---|---|---|")
    for channels in (3, 7, 8, 12):
        splats, camera = scene(arguments.gaussians, width, height, channels, arguments.sigma)
        statistic = ScreenStatistic((0, 1, 2))
        rasterizer = native_rasterizer(camera, channels, statistic)
        out, alpha = torch.empty(height, width, channels), torch.empty(height, width)
        radii, screen = torch.empty(arguments.gaussians), torch.empty(arguments.gaussians, 2)
        grad_out, grad_alpha = torch.randn_like(out), torch.randn_like(alpha)
        gradients = [torch.empty_like(t) for t in splats]
        rasterizer.forward(*splats, out, alpha, radii, count_pairs=True)
        pairs = rasterizer.pairs
        forward, backward = [], []
        for _ in range(arguments.repeats):
            start = time.perf_counter()
            rasterizer.forward(*splats, out, alpha, radii)
            middle = time.perf_counter()
            rasterizer.backward(*splats, out, grad_out, grad_alpha, *gradients, screen)
            forward.append(middle - start)
            backward.append(time.perf_counter() - middle)
        f, b = statistics.median(forward[5:]), statistics.median(backward[5:])
        share = pairs * FLOP_PER_PAIR / (f + b) / peak
        print(
            f"| {channels} | {pairs / 1e6:.2f} M | {f * 1e3:.2f} | {b * 1e3:.2f} "
            f"| {pairs / (f + b) / 1e6:.0f} | {share:.1%} |"
        )


if __name__ == "__main__":
    main()
