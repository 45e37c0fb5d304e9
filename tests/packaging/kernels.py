"""Kernels of an installed wheel on NumPy arrays, without PyTorch: prints what they compute, as a digest.

``make wheel`` compares the line between the versions of Python on the machine. Run as a program in their environments.
"""

from __future__ import annotations

import hashlib
import sys

import numpy as np

from polarguide import _native


def main() -> None:
    """Spherical harmonics, a cubemap, and the photometric loss, forward and backward."""
    random = np.random.default_rng(0)

    def drawn(*shape: int) -> np.ndarray:
        return random.standard_normal(shape).astype(np.float32)

    def empty(*shape: int) -> np.ndarray:
        return np.zeros(shape, np.float32)

    _native.set_thread_count(2)
    count = 1000
    colors = empty(count, 3)
    _native.harmonics_forward(3, drawn(count, 3), drawn(3), drawn(count, 3), drawn(count, 15, 3), colors)
    looked_up = empty(count, 3)
    _native.cubemap_forward(drawn(6, 16, 16, 3), drawn(count, 3), looked_up)
    prediction, target, gradient = (array(48, 64, 3) for array in (drawn, drawn, empty))
    losses = _native.photometric(prediction, target, None, float(48 * 64 * 3), 0.2, gradient)
    results = [colors, looked_up, gradient, np.array(losses)]
    if not all(np.isfinite(result).all() and result.any() for result in results):
        sys.exit("kernels: expected finite values, found others")
    try:
        _native.select_simd("no such set")
    except ValueError:  # errors have to pass between the module and the backend, two compiled files
        pass
    else:
        sys.exit("kernels: expected a ValueError, found none")
    digest = hashlib.sha256(b"".join(result.tobytes() for result in results)).hexdigest()[:16]
    python = ".".join(map(str, sys.version_info[:3]))
    print(f"Python {python}, NumPy {np.__version__}, {_native.simd()}: {digest}")


if __name__ == "__main__":
    main()
