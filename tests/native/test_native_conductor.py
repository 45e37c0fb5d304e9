"""The native conductor: a metal's mean reflectance and degree of polarization, with their gradients."""

from __future__ import annotations

import torch

from polarguide import _native, optics
from polarguide.shading.native import conductor_native


def test_the_native_conductor_is_the_one_of_the_optics(simd: str) -> None:
    generator = torch.Generator().manual_seed(4)
    cosine, values = torch.rand(200, generator=generator), torch.rand(200, 3, generator=generator)
    weights = [torch.randn(200, 3, generator=generator) for _ in range(2)]
    found = []
    for conductor, dtype in ((conductor_native, torch.float32), (optics.conductor, torch.float64)):
        c, r = (t.to(dtype).clone().requires_grad_() for t in (cosine, values))
        mean, slope = conductor(c if dtype == torch.float32 else c[:, None], r)
        (mean * weights[0] + slope * weights[1]).sum().backward()
        assert c.grad is not None
        assert r.grad is not None
        found.append([t.detach().double() for t in (mean, slope, c.grad, r.grad)])
    for ours, exact in zip(*found, strict=True):
        torch.testing.assert_close(ours, exact, rtol=2e-3, atol=2e-3)


def test_threads_do_not_change_a_bit_of_it() -> None:
    generator = torch.Generator().manual_seed(5)
    inputs = torch.rand(9000, generator=generator), torch.rand(9000, 3, generator=generator)
    found = []
    for threads in (1, 2, 3):
        _native.set_thread_count(threads)
        cosine, values = (t.clone().requires_grad_() for t in inputs)
        mean, slope = conductor_native(cosine, values)
        (mean.square() + slope).sum().backward()
        found.append([mean.detach(), slope.detach(), cosine.grad, values.grad])
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))
