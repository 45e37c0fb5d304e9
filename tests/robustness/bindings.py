"""Random input for every binding of the native module: right shapes and wrong ones, huge and not finite numbers.

Wrong input has to raise ``ValueError`` or ``TypeError``, the rest has to run; sanitizers end the program at a fault.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import random
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from polarguide import _native

SIZES = (0, 1, 2, 7, 16, 17, 65)
MANY = (*SIZES, 5000)
VALUES = (0.0, -0.0, 1.0, -1.0, 1e-30, 1e30, -1e30, 3e38, np.inf, -np.inf, np.nan)
LARGEST, NAN = 2**31 - 1, np.nan


class Draw(random.Random):
    """Random arrays."""

    def __call__(self, *shape: int) -> np.ndarray:
        """Float32 values, some of them extreme; sometimes of another shape or type."""
        if self.random() < 0.04:
            shape = tuple(self.choice(SIZES) for _ in range(self.randint(0, 4)))
        made = self.numbers().normal(size=shape).astype(np.float32)
        if made.size and self.random() < 0.3:
            for _ in range(self.randint(1, 4)):
                made.reshape(-1)[self.randrange(made.size)] = self.choice(VALUES)
        return made.astype(np.float64) if self.random() < 0.02 else made

    def numbers(self) -> np.random.Generator:
        """Further random numbers."""
        return np.random.default_rng(self.randrange(2**31))

    def maybe(self, given: Any) -> Any:
        """What is given, or nothing."""
        return None if self.random() < 0.3 else given

    def arguments(self, text: str, sizes: Mapping[str, int], values: Mapping[str, Any]) -> list[Any]:
        """What a text lists: values by name, and arrays by their sides; ``?`` before those that may be missing."""
        known = {**sizes, "q": 15, "3": 3, "4": 4, "6": 6}
        made = []
        for word in text.split():
            given = values[word] if word in values else self(*(known[side] for side in word.strip("?")))
            made.append(self.maybe(given) if "?" in word else given)
        return made


# A row: the functions of a binding, each with its arguments; what the letters in them may be. "q" is 15.
ROWS: tuple[tuple[dict[str, str], dict[str, Sequence[int]], dict[str, Sequence[Any]]], ...] = (
    ({"photometric": "hw3 hw3 ?hw COUNT WEIGHT ?hw3"}, {"h": SIZES, "w": SIZES},
     {"COUNT": (0.0, 1.0, 17.0, 1105.0), "WEIGHT": (0.2,)}),
    ({"cubemap_forward": "6ssc n3 nc", "cubemap_backward": "6ssc n3 nc ?6ssc ?n3"},
     {"s": (0, 1, 2, 8, 33), "c": (0, 1, 3, 16), "n": MANY}, {}),
    ({"harmonics_forward": "DEGREE n3 3 n3 nq3 n3", "harmonics_backward": "DEGREE n3 3 n3 nq3 n3 ?n3 n3 ?nq3"},
     {"n": MANY}, {"DEGREE": range(-1, 5)}),
    ({"axes_forward": "n3 n4 n3 3 ?n3 GRAZING n3", "axes_backward": "n3 n4 n3 3 ?n3 GRAZING n3 n4",
      "mirrored_forward": "n3 3 n3 n3"}, {"n": MANY}, {"GRAZING": (0.0, 0.3, NAN)}),
    ({"shortest_sum": "n3 n", "shortest_gradient": "n3 n SCALE n3"}, {"n": MANY}, {"SCALE": (1.0, NAN)}),
    ({"gbuffer_split": "nd n n3 ?n", "gbuffer_join": "n ?n ?nd ?n3 ?n nd ?n"}, {"n": MANY, "d": range(5, 13)}, {}),
    ({"polarization": "n3 n3 33 n3 n3 ?n6 kn3 k3 ?n NOISE INDEX ?n n3 n3 n3 ?n6"},
     {"n": MANY, "k": (0, 1, 2, 3, 4, 9)},
     {"NOISE": (0.1, 0.0, NAN, 3e38), "INDEX": (1.5, 1.5, 1.0, -1.0, 1e30, np.inf, NAN)}),
    ({"direction": "n3 n3 ?n NOISE FLAG n3"}, {"n": MANY}, {"NOISE": (0.1, 0.0, NAN), "FLAG": (True, False)}),
)  # fmt: skip


def rasterizer(draw: Draw) -> None:
    n, d, h, w = draw.choice(SIZES), draw.randint(1, 12), draw.choice(SIZES), draw.choice(SIZES)
    order = list(range(d))
    draw.shuffle(order)
    if draw.random() < 0.1:
        order[draw.randrange(d)] = draw.choice((-1, d, LARGEST, 0))
    place = [draw.choice(VALUES) if draw.random() < 0.1 else draw.gauss(0, 1) for _ in range(3)]
    turn = np.linalg.qr(draw.numbers().normal(size=(3, 3)))[0].flatten().tolist()
    lens = [30.0, 30.0, w / 2, h / 2]
    made = _native.Rasterizer(turn, place, lens, w, h, 0.01, order, draw.randint(-1, d + 1))
    scales, opacities = np.abs(draw(n, 3)), np.clip(np.abs(draw(n)), 0, 1)
    inputs = [draw(n, 3), draw(n, 4), scales, opacities, draw(n, d)]
    out, alpha, radius = draw(h, w, d), draw(h, w), draw(n)
    if draw.random() < 0.9:
        with contextlib.suppress(ValueError, TypeError):
            made.forward(*inputs, out, alpha, radius, draw.random() < 0.5, draw.random() < 0.8)
    m = n if draw.random() < 0.9 else draw.choice(SIZES)
    e = d if draw.random() < 0.9 else draw.randint(1, 12)
    if m != n:
        inputs = [draw(m, 3), draw(m, 4), draw(m, 3), draw(m), draw(m, d)]
    gradients = [draw(m, 3), draw(m, 4), draw(m, 3), draw(m), draw(m, e)]
    made.backward(*inputs, out, draw(h, w, d), draw(h, w), *gradients, draw.maybe(draw(m, 2)))


def reflect(draw: Draw) -> None:
    n, d, local = draw.choice(MANY), draw.randint(5, 12), draw.random() < 0.5
    features, rays, three = draw(n, d), draw(n, 3), [draw(n, 3) for _ in range(7)]
    _native.turn(rays, [draw.uniform(-1, 1) for _ in range(draw.choice((9, 9, 9, 8)))], three[0])
    index, further = draw.choice((1.5, 0.0, NAN)), draw.choice((-1, -1, 0, d - 1, d, LARGEST))
    model = draw.random() < 0.5, local, index, further
    side = draw.choice((1, 2, 5))
    texels = [draw(6, size, size, draw.choice((3, 3, 3, 4))) for size in (side, 1)[: draw.choice((1, 2, 2))]]
    rough = (
        draw.choice((-1, -1, 7, 0, d - 1, d, -2, LARGEST)),
        draw.choice((4.0, NAN, 3e38)),
        draw.maybe(draw(n)),
    )
    looked_up = draw.maybe(three[0]), draw.maybe(draw(n)), draw.maybe(three[5])
    _native.reflect_forward(features, rays, texels, *model, *rough, *looked_up, *three[1:5])
    layers = [draw.maybe(values) for values in (*three[1:5], *three[1:3])]
    by_look_up = three[5], draw.maybe(three[6])
    _native.reflect_backward_layers(features, rays, three[0], *model, *layers, *by_look_up, draw(n, d))
    _native.reflect_backward_directions(features, rays, *rough, three[0], draw.maybe(draw(n)), draw(n, d))


def splatting(draw: Draw) -> None:
    n, degree, k = draw.choice(MANY), draw.randint(-1, 4), draw.choice((0, 1, 5, 6, 30))
    core = [draw(n, *shape) for shape in ((3,), (4,), (3,), (), (3,), (15, 3))]
    light = draw.random() < 0.5
    lit = [draw(n, 3), draw(n, 15, 3)] if light else [None, None]
    others = [draw.maybe(draw(n, 3)), draw.maybe(draw(n)), *lit, draw.maybe(draw(n)), draw.maybe(draw(n, k))]
    normals, grazing = light or draw.random() < 0.5, draw.choice((0.3, NAN))
    made = _native.Splatting(*core, degree, draw(3), draw.maybe(draw(3)), normals, grazing, *others)
    d = made.channels
    results, mirrored = (draw(n, 3), draw(n), draw(n, d)), draw(n, 3) if light else None
    with contextlib.suppress(ValueError, TypeError):
        made.forward(*results, draw.maybe(mirrored) if light else None)
    by = [draw(n, *shape) for shape in ((3,), (4,), (3,), (), (d,))]
    learned = (others[1], others[2], others[3], others[5])
    to = [None if given is None else np.zeros_like(given) for given in (*core, *learned)]
    made.backward(*results, mirrored, *by, *to)


def finite(draw: Draw) -> None:
    _native.first_not_finite(draw(*(draw.choice(SIZES) for _ in range(draw.randint(0, 3)))))


def metal(draw: Draw) -> None:
    n, d = draw.choice(MANY), draw.randint(10, 18)
    first = draw.choice((7, 7, 10, 12, 3, d, LARGEST))
    pixels = np.flatnonzero(draw.numbers().random(n) < 0.4)
    if len(pixels) and draw.random() < 0.1:
        pixels[draw.randrange(len(pixels))] = draw.choice((-1, n, 2**62))
    k = len(pixels)
    given = draw(n, d), draw(n, 3), pixels, first, draw.choice((0.01, 0.01, 0.0)), draw(n, 3)
    _native.metal_layers(*given, draw(k), draw(k, 3), draw(k, 3), draw(n, 3), draw(n, 3))
    layers = [draw.maybe(draw(n, 3)) for _ in range(3)]
    by = [draw.maybe(draw(k, 3)) for _ in range(2)]
    _native.metal_backward(*given, *layers, *by, draw(n, 3), draw(k, 3), draw(k, 4))


def mips(draw: Draw) -> None:
    n, c = draw.choice(MANY), draw.choice((1, 3, 3, 5, 64, 65, 0))
    sides = [draw.choice((1, 2, 5, 16)) for _ in range(draw.choice((1, 2, 5, 16, 17, 0)))]
    given = [draw(6, side, side, c) for side in sides], draw(n, 3), 3 * draw(n)
    _native.mips_forward(*given, draw(n, c))
    flat = draw.maybe(draw(sum(6 * side * side * c for side in sides)))
    _native.mips_backward(*given, draw(n, c), draw.maybe(draw(n, c)), flat, draw(n, 3), draw(n))


def consistency(draw: Draw) -> None:
    h, w = draw.choice((2, 3, 5, 16, 17, 70)), draw.choice((2, 3, 5, 16, 17, 70))
    n = h * w if draw.random() < 0.95 else draw.choice(SIZES)
    given = draw(n, 3), draw(n, 3), draw(3, 3), draw(h, w), draw(h, w), draw.maybe(draw(n))
    _native.consistency(*given, draw.choice((0.1, NAN)), draw(n, 3), draw(h, w))


KINDS = (rasterizer, reflect, splatting, finite, metal, mips, consistency)


def _call(draw: Draw, name: str, *of_row: Any) -> None:
    getattr(_native, name)(*draw.arguments(*of_row))


def calls(draw: Draw) -> Iterator[tuple[str, Callable[[], object]]]:
    """All calls of a round."""
    yield from ((kind.__name__, functools.partial(kind, draw)) for kind in KINDS)
    for functions, letters, words in ROWS:
        sizes = {letter: draw.choice(given) for letter, given in letters.items()}
        values = {word: draw.choice(given) for word, given in words.items()}
        for name, text in functions.items():
            yield name, functools.partial(_call, draw, name, text, sizes, values)


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
        for name, call in calls(Draw(f"{asked.seed} {number}")):
            try:
                call()
                ran[name] += 1
            except (ValueError, TypeError):
                refused[name] += 1
    idle = sorted(refused.keys() - ran.keys())
    assert not idle, f"never ran: {idle}"
    print(f"bindings: {ran.total()} calls ran, {refused.total()} were refused, with {', '.join(sets)}")


if __name__ == "__main__":
    main()
