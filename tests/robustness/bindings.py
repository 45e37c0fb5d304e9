# ruff: noqa: E501
"""Random input for every binding of the native module: right shapes and wrong ones, huge and not finite numbers.

Wrong input has to raise ``ValueError`` or ``TypeError``; the rest has to run. Under sanitizers a fault ends the program.
"""

from __future__ import annotations

import argparse
import contextlib
import random
from collections import Counter

import numpy as np

from polarguide import _native

SIZES = (0, 1, 2, 7, 16, 17, 65)
VALUES = (0.0, -0.0, 1.0, -1.0, 1e-30, 1e30, -1e30, 3e38, np.inf, -np.inf, np.nan)


def array(rng: random.Random, *shape: int) -> np.ndarray:
    """Random float32 values, some of them extreme; sometimes of another shape or type."""
    if rng.random() < 0.04:
        shape = tuple(rng.choice(SIZES) for _ in range(rng.randint(0, 4)))
    made = np.random.default_rng(rng.randrange(2**31)).normal(size=shape).astype(np.float32)
    if made.size and rng.random() < 0.3:
        for _ in range(rng.randint(1, 4)):
            made.reshape(-1)[rng.randrange(made.size)] = rng.choice(VALUES)
    if rng.random() < 0.02:
        made = made.astype(np.float64)
    return made


def maybe(rng: random.Random, given: np.ndarray) -> np.ndarray | None:
    return None if rng.random() < 0.3 else given


def rasterizer(rng: random.Random) -> None:
    n, d, height, width = rng.choice(SIZES), rng.randint(1, 12), rng.choice(SIZES), rng.choice(SIZES)
    permutation = list(range(d))
    rng.shuffle(permutation)
    if rng.random() < 0.1:
        permutation[rng.randrange(d)] = rng.choice((-1, d, 2**31 - 1, 0))
    numbers = [
        rng.choice((rng.gauss(0, 1), rng.choice(VALUES))) if rng.random() < 0.2 else rng.gauss(0, 1)
        for _ in range(3)
    ]
    turn = np.linalg.qr(np.random.default_rng(rng.randrange(2**31)).normal(size=(3, 3)))[0]
    made = _native.Rasterizer(
        turn.flatten().tolist(),
        numbers,
        [30.0, 30.0, width / 2, height / 2],
        width,
        height,
        0.01,
        permutation,
        rng.randint(-1, d + 1),
    )
    inputs = [
        array(rng, n, 3),
        array(rng, n, 4),
        np.abs(array(rng, n, 3)),
        np.clip(np.abs(array(rng, n)), 0, 1),
        array(rng, n, d),
    ]
    out, alpha, radius = array(rng, height, width, d), array(rng, height, width), array(rng, n)
    if rng.random() < 0.9:
        with contextlib.suppress(ValueError, TypeError):
            made.forward(*inputs, out, alpha, radius, rng.random() < 0.5, rng.random() < 0.8)
    m = n if rng.random() < 0.9 else rng.choice(SIZES)
    e = d if rng.random() < 0.9 else rng.randint(1, 12)
    if m != n:
        inputs = [array(rng, m, 3), array(rng, m, 4), array(rng, m, 3), array(rng, m), array(rng, m, d)]
    gradients = [array(rng, m, 3), array(rng, m, 4), array(rng, m, 3), array(rng, m), array(rng, m, e)]
    made.backward(
        *inputs,
        out,
        array(rng, height, width, d),
        array(rng, height, width),
        *gradients,
        maybe(rng, array(rng, m, 2)),
    )


def photometric(rng: random.Random) -> None:
    h, w = rng.choice(SIZES), rng.choice(SIZES)
    given = array(rng, h, w, 3), array(rng, h, w, 3), maybe(rng, array(rng, h, w))
    _native.photometric(*given, rng.choice((0.0, 1.0, h * w)), 0.2, maybe(rng, array(rng, h, w, 3)))


def cubemap(rng: random.Random) -> None:
    side, channels, count = (
        rng.choice((0, 1, 2, 8, 33)),
        rng.choice((0, 1, 3, 16)),
        rng.choice((*SIZES, 5000)),
    )
    texture, directions = array(rng, 6, side, side, channels), array(rng, count, 3)
    _native.cubemap_forward(texture, directions, array(rng, count, channels))
    grads = maybe(rng, array(rng, 6, side, side, channels)), maybe(rng, array(rng, count, 3))
    _native.cubemap_backward(texture, directions, array(rng, count, channels), *grads)


def reflect(rng: random.Random) -> None:
    n, d, local = rng.choice((*SIZES, 5000)), rng.randint(5, 12), rng.random() < 0.5
    features, rays, three = array(rng, n, d), array(rng, n, 3), [array(rng, n, 3) for _ in range(7)]
    _native.turn(rays, [rng.uniform(-1, 1) for _ in range(rng.choice((9, 9, 9, 8)))], three[0])
    model = (
        rng.random() < 0.5,
        local,
        rng.choice((1.5, 0.0, np.nan)),
        rng.choice((-1, -1, 0, d - 1, d, 2**31 - 1)),
    )
    side = rng.choice((1, 2, 5))
    texels = array(rng, 6, side, side, rng.choice((3, 3, 3, 4)))
    looked_up = maybe(rng, three[0]), maybe(rng, three[5])
    _native.reflect_forward(features, rays, texels, *model, *looked_up, *three[1:5])
    layers = [maybe(rng, values) for values in (*three[1:5], *three[1:3])]
    by_look_up = three[5], maybe(rng, three[6])
    _native.reflect_backward_layers(features, rays, three[0], *model, *layers, *by_look_up, array(rng, n, d))
    _native.reflect_backward_directions(features, rays, three[0], array(rng, n, d))


def harmonics(rng: random.Random) -> None:
    n, degree = rng.choice((*SIZES, 3000)), rng.randint(-1, 4)
    given = array(rng, n, 3), array(rng, 3), array(rng, n, 3), array(rng, n, 15, 3)
    _native.harmonics_forward(degree, *given, array(rng, n, 3))
    gradients = (
        array(rng, n, 3),
        maybe(rng, array(rng, n, 3)),
        array(rng, n, 3),
        maybe(rng, array(rng, n, 15, 3)),
    )
    _native.harmonics_backward(degree, *given, *gradients)


def axes(rng: random.Random) -> None:
    n = rng.choice((*SIZES, 3000))
    given = array(rng, n, 3), array(rng, n, 4), array(rng, n, 3), array(rng, 3), maybe(rng, array(rng, n, 3))
    grazing = rng.choice((0.0, 0.3, np.nan))
    _native.axes_forward(*given, grazing, array(rng, n, 3))
    _native.axes_backward(*given, grazing, array(rng, n, 3), array(rng, n, 4))
    _native.mirrored_forward(given[0], given[3], array(rng, n, 3), array(rng, n, 3))


def splatting(rng: random.Random) -> None:
    n, degree, k = rng.choice((*SIZES, 3000)), rng.randint(-1, 4), rng.choice((0, 1, 5, 6, 30))
    core = [array(rng, n, *shape) for shape in ((3,), (4,), (3,), (), (3,), (15, 3))]
    light = rng.random() < 0.5
    others = [
        maybe(rng, array(rng, n, 3)),
        maybe(rng, array(rng, n)),
        array(rng, n, 3) if light else None,
        array(rng, n, 15, 3) if light else None,
        maybe(rng, array(rng, n)),
        maybe(rng, array(rng, n, k)),
    ]
    normals = light or rng.random() < 0.5
    made = _native.Splatting(
        *core, degree, array(rng, 3), maybe(rng, array(rng, 3)), normals, rng.choice((0.3, np.nan)), *others
    )
    d = made.channels
    results = array(rng, n, 3), array(rng, n), array(rng, n, d)
    mirrored = array(rng, n, 3) if light else None
    with contextlib.suppress(ValueError, TypeError):
        made.forward(*results, maybe(rng, mirrored) if light else None)
    by = [array(rng, n, *shape) for shape in ((3,), (4,), (3,), (), (d,))]
    learned = (others[1], others[2], others[3], others[5])
    to = [None if given is None else np.zeros_like(given) for given in (*core, *learned)]
    made.backward(*results, mirrored, *by, *to)


def shortest(rng: random.Random) -> None:
    n = rng.choice((*SIZES, 9000))
    given = array(rng, n, 3), array(rng, n)
    _native.shortest_sum(*given)
    _native.shortest_gradient(*given, rng.choice((1.0, np.nan)), array(rng, n, 3))


def finite(rng: random.Random) -> None:
    _native.first_not_finite(array(rng, *(rng.choice(SIZES) for _ in range(rng.randint(0, 3)))))


def gbuffer(rng: random.Random) -> None:
    n, d = rng.choice((*SIZES, 5000)), rng.randint(5, 12)
    _native.gbuffer_split(array(rng, n, d), array(rng, n), array(rng, n, 3), maybe(rng, array(rng, n)))
    given = [maybe(rng, array(rng, *shape)) for shape in ((n,), (n, d), (n, 3), (n,), (n,))]
    _native.gbuffer_join(array(rng, n), *given[:4], array(rng, n, d), given[4])


def polarization(rng: random.Random) -> None:
    n, k = rng.choice((*SIZES, 5000)), rng.choice((0, 1, 2, 3, 4, 9))
    normal, rays, specular, diffuse = (array(rng, n, 3) for _ in range(4))
    measured, analyzers, weight = array(rng, k, n, 3), array(rng, k, 3), maybe(rng, array(rng, n))
    numbers = rng.choice((0.1, 0.0, np.nan, 3e38)), rng.choice((1.5, 1.5, 1.0, -1.0, 1e30, np.inf, np.nan))
    gradients = [array(rng, n, 3) for _ in range(3)]
    metal = maybe(rng, array(rng, n, 6))
    layers = specular, diffuse, metal, measured, analyzers, weight
    _native.polarization(
        normal,
        rays,
        array(rng, 3, 3),
        *layers,
        *numbers,
        maybe(rng, array(rng, n)),
        *gradients,
        maybe(rng, array(rng, n, 6)),
    )


def metal(rng: random.Random) -> None:
    n, d = rng.choice((*SIZES, 5000)), rng.randint(10, 18)
    first, local = (
        rng.choice((7, 7, 10, 12, 3, d, 2**31 - 1)),
        rng.choice((-1, -1, 7, 0, d - 2, 2**31 - 1, -(2**31))),
    )
    pixels = np.flatnonzero(np.random.default_rng(rng.randrange(2**31)).random(n) < 0.4)
    if len(pixels) and rng.random() < 0.1:
        pixels[rng.randrange(len(pixels))] = rng.choice((-1, n, 2**62))
    k, blur = len(pixels), rng.choice((4.0, 4.0, 0.0, np.nan, 3e38))
    given = array(rng, n, d), array(rng, n, 3), pixels, first, local, rng.choice((0.01, 0.01, 0.0)), blur
    rows, seen = [array(rng, k, 3) for _ in range(3)], array(rng, k, 3)
    _native.metal_directions(*given, rows[0], array(rng, k))
    _native.metal_layers(*given, seen, array(rng, k), *rows[1:], array(rng, n, 3), array(rng, n, 3))
    layers = [maybe(rng, array(rng, n, 3)) for _ in range(3)]
    by = [maybe(rng, array(rng, k, 3)) for _ in range(2)]
    _native.metal_backward_layers(*given, seen, *layers, *by, array(rng, k, 3), array(rng, n, d))
    _native.metal_backward_directions(*given, array(rng, k, 3), array(rng, k), array(rng, n, d))


def mips(rng: random.Random) -> None:
    n, c = rng.choice((*SIZES, 5000)), rng.choice((1, 3, 3, 5, 64, 65, 0))
    sides = [rng.choice((1, 2, 5, 16)) for _ in range(rng.choice((1, 2, 5, 16, 17, 0)))]
    textures = [array(rng, 6, side, side, c) for side in sides]
    directions, level = array(rng, n, 3), 3 * array(rng, n)
    _native.mips_forward(textures, directions, level, array(rng, n, c))
    flat = maybe(rng, array(rng, sum(6 * side * side * c for side in sides)))
    _native.mips_backward(
        textures, directions, level, array(rng, n, c), flat, array(rng, n, 3), array(rng, n)
    )


def direction(rng: random.Random) -> None:
    n = rng.choice((*SIZES, 5000))
    given = array(rng, n, 3), array(rng, n, 3), maybe(rng, array(rng, n))
    _native.direction(*given, rng.choice((0.1, 0.0, np.nan)), rng.random() < 0.5, array(rng, n, 3))


def consistency(rng: random.Random) -> None:
    h, w = rng.choice((2, 3, 5, 16, 17, 70)), rng.choice((2, 3, 5, 16, 17, 70))
    n = h * w if rng.random() < 0.95 else rng.choice(SIZES)
    normal, rays, turn = array(rng, n, 3), array(rng, n, 3), array(rng, 3, 3)
    given = array(rng, h, w), array(rng, h, w), maybe(rng, array(rng, n))
    _native.consistency(
        normal, rays, turn, *given, rng.choice((0.1, np.nan)), array(rng, n, 3), array(rng, h, w)
    )


KINDS = (
    rasterizer, photometric, cubemap, reflect, harmonics, axes, finite, gbuffer, polarization, direction,
    consistency, metal, mips, splatting, shortest,
)  # fmt: skip


def instruction_sets() -> list[str]:
    """Those that this processor has."""
    found = []
    for name in ("baseline", "avx2", "avx512"):
        with contextlib.suppress(ValueError):
            _native.select_simd(name)
            found.append(name)
    return found


def main() -> None:
    """Call everything a number of times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    ran: Counter[str] = Counter()
    refused: Counter[str] = Counter()
    sets = instruction_sets()
    for number in range(asked.rounds):
        _native.select_simd(sets[number % len(sets)])
        _native.set_thread_count((1, 2, 3)[number // len(sets) % 3])
        for kind in KINDS:
            try:
                kind(random.Random(f"{asked.seed} {number} {kind.__name__}"))
                ran[kind.__name__] += 1
            except (ValueError, TypeError):
                refused[kind.__name__] += 1
    idle = [kind.__name__ for kind in KINDS if not ran[kind.__name__]]
    assert not idle, f"never ran: {idle}"
    print(f"bindings: {ran.total()} calls ran, {refused.total()} were refused, with {', '.join(sets)}")


if __name__ == "__main__":
    main()
