"""Surface nets: triangles of the zero level set of values on a grid."""

from __future__ import annotations

import numpy as np

from polarguide.synth.mesh import Array


def surface_nets(values: Array) -> tuple[Array, np.ndarray]:
    """Naive surface nets (Gibson 1998): vertices [V, 3] in units of cells, and triangles [F, 3].

    Args:
        values: signed distances on a grid, [X, Y, Z], negative inside.
    """
    inside = values < 0
    shape = tuple(n - 1 for n in values.shape)
    sums, counts = np.zeros((*shape, 3)), np.zeros(shape)
    corners = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]

    def corner(array: np.ndarray, at: tuple[int, ...]) -> np.ndarray:
        return np.asarray(array[tuple(slice(o, o + n) for o, n in zip(at, shape, strict=True))])

    for first in corners:
        for axis in range(3):
            if first[axis]:
                continue
            second = tuple(1 if k == axis else first[k] for k in range(3))
            a, b = corner(values, first), corner(values, second)
            crossed = (a < 0) != (b < 0)
            t = np.where(crossed, a / np.where(crossed, a - b, 1), 0)
            place = np.array(first) + t[..., None] * np.eye(3)[axis]
            sums += np.where(crossed[..., None], place, 0)
            counts += crossed
    used = counts > 0
    index = np.full(shape, -1)
    index[used] = np.arange(int(used.sum()))
    points = np.argwhere(used) + sums[used] / counts[used][:, None]
    faces = []
    for axis in range(3):
        one, two = (axis + 1) % 3, (axis + 2) % 3
        low = np.moveaxis(inside, (axis, one, two), (0, 1, 2))[:-1, 1:-1, 1:-1]
        high = np.moveaxis(inside, (axis, one, two), (0, 1, 2))[1:, 1:-1, 1:-1]
        cells = np.moveaxis(index, (axis, one, two), (0, 1, 2))
        around = [cells[:, :-1, :-1], cells[:, 1:, :-1], cells[:, 1:, 1:], cells[:, :-1, 1:]]
        for mask, order in ((low & ~high, (0, 1, 2, 3)), (high & ~low, (3, 2, 1, 0))):
            quad = np.stack([around[k][mask] for k in order], -1)
            faces += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    return points, np.concatenate(faces)
