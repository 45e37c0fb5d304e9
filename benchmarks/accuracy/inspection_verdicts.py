"""Check the verdicts of ``polarguide inspect`` on scenes with known faults.

    python benchmarks/accuracy/inspection_verdicts.py SCENE [SCENE ...]

Each scene is changed in memory: the eight orders with the same pairs, a zero turned by 10 degrees, gamma-encoded files,
one angle exposed 5 % longer, and threefold overexposure. The verdicts come from points in several views and from the
pictures alone, without a training.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from polarguide.capture.angle_evidence import ORDERS
from polarguide.capture.calibration import Calibration, oriented
from polarguide.geometry.polarizer import ANGLES
from polarguide.inspection.angles import angle_checks, combine_evidence
from polarguide.inspection.capture import Capture, measure_view, read_capture
from polarguide.inspection.evidence import point_evidence
from polarguide.inspection.picture_checks import find_pairing, picture_checks
from polarguide.optics.color import srgb_encode_array

Change = Callable[[NDArray[np.float32]], NDArray[np.float32]]


def altered(capture: Capture, change: Change) -> Capture:
    """Return the capture with other intensities [4, H, W, 3]. Values at full scale are saturated."""
    views = []
    for view in capture.views:
        values = change(view.intensities().numpy())
        codes = np.rint(np.clip(values, 0, 1) * 65535).astype(np.uint16)
        saturated = view.saturated.numpy() | (codes == 65535).any(axis=(0, 3))
        views.append(
            dataclasses.replace(view, codes=torch.from_numpy(codes), saturated=torch.from_numpy(saturated))
        )
    return dataclasses.replace(capture, views=tuple(views))


def turned(degrees: float) -> Change:
    """Return a change that turns the instrument's zero to ``degrees``. Measured angles decrease by the same amount."""
    return lambda values: oriented(values, Calibration(zero=-degrees))


def misnamed(files: tuple[int, int, int, int]) -> Change:
    """Return a change of pictures with the names 0, 45, 90, 135 that were taken at ``files``."""
    return lambda values: values[[ANGLES.index(angle) for angle in files]]


def exposed(place: int) -> Change:
    """Expose one picture 5 % longer."""
    gains = np.ones((4, 1, 1, 1), np.float32)
    gains[place] = 1.05
    return lambda values: values * gains


def angles_line(capture: Capture, refractive_index: float) -> str:
    pairing = find_pairing(capture) or 0
    evidence, _ = point_evidence(capture.posed, capture.model, refractive_index, pairing)
    angles = combine_evidence([evidence], pairing)
    order, _, zero = angle_checks(angles)
    if angles.posterior is None:
        return f"order {order.verdict}: {evidence.note}"
    best = ORDERS[angles.posterior.best].files()
    return (
        f"order {order.verdict:5} {','.join(map(str, best)):14} p {max(angles.posterior.probabilities):.4f}  "
        f"zero {zero.verdict:5} {angles.posterior.offset:+.2f} +- {angles.posterior.offset_error:.2f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--pictures-only", action="store_true", help="leave out what takes poses")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for path in arguments.scenes:
        capture = read_capture(path)
        refractive_index = capture.refractive_index or 1.5
        plants: dict[str, Change] = {
            "untouched": lambda values: values,
            "gamma": srgb_encode_array,
            **{f"5 % at {ANGLES[k]}": exposed(k) for k in range(4)},
            "overexposed x3": lambda values: values * 3,
        }
        for name, change in plants.items():
            planted = altered(capture, change)
            measurements = [measure_view(view, refractive_index) for view in planted.views]
            found = picture_checks(planted, measurements, find_pairing(planted))
            flagged = [f"{check.key} {check.verdict}" for check in found if check.verdict != "ok"]
            print(f"{path.name:9} {name:15} {', '.join(flagged) or 'all ok'}", flush=True)
        if arguments.pictures_only:
            continue
        for order in ORDERS:
            line = angles_line(altered(capture, misnamed(order.files())), refractive_index)
            print(f"{path.name:9} {','.join(map(str, order.files())):15} {line}", flush=True)
        print(
            f"{path.name:9} {'zero at 10':15} {angles_line(altered(capture, turned(10.0)), refractive_index)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
