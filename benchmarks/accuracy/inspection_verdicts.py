"""Check the verdicts of ``polarguide inspect`` on scenes with known faults.

    python benchmarks/accuracy/inspection_verdicts.py SCENE... > benchmarks/records/inspection.md

Prints a Markdown table with a column for each scene. Each scene is changed in memory: the eight orders with the same
pairs, a zero turned by 10 degrees, gamma-encoded files, one angle exposed 5 % longer, and threefold overexposure. The
verdicts come from points in several views and from the pictures alone, without a training.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
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


def order_and_zero(capture: Capture, refractive_index: float) -> tuple[str, float, float, float]:
    """Return the verdict on the order of the angles, its probability, and the zero in degrees with its error."""
    pairing = find_pairing(capture) or 0
    evidence, _ = point_evidence(capture.posed, capture.model, refractive_index, pairing)
    angles = combine_evidence([evidence], pairing)
    order, *_ = angle_checks(angles)
    posterior = angles.posterior
    if posterior is None:
        return order.verdict, math.nan, math.nan, math.nan
    return order.verdict, max(posterior.probabilities), posterior.offset, posterior.offset_error


def reported(capture: Capture, change: Change, refractive_index: float) -> bool:
    """Return True if a check of the pictures finds fault with the changed capture."""
    planted = altered(capture, change)
    measurements = [measure_view(view, refractive_index) for view in planted.views]
    found = picture_checks(planted, measurements, find_pairing(planted))
    return any(check.verdict != "ok" for check in found)


def verdicts(path: Path) -> dict[str, str]:
    """Return the cells of a scene by test."""
    capture = read_capture(path)
    refractive_index = capture.refractive_index or 1.5
    right, *wrong = ORDERS
    order, probability, zero, error = order_and_zero(capture, refractive_index)
    others = [order_and_zero(altered(capture, misnamed(each.files())), refractive_index)[0] for each in wrong]
    _, _, turned_zero, _ = order_and_zero(altered(capture, turned(10.0)), refractive_index)
    faults = {"gamma": srgb_encode_array, "three times the exposure": lambda values: values * 3}
    faults |= {f"{ANGLES[k]} degrees exposed 5 % longer": exposed(k) for k in range(4)}
    assert right.files() == ANGLES
    return {
        "right order: verdict, probability": f"{order}, {100 * probability:.1f} %",
        "wrong orders that are reported, of seven": str(sum(verdict == "wrong" for verdict in others)),
        "estimated zero, degrees (truth 0)": f"{zero:.2f} ± {error:.2f}",
        "estimated zero, degrees (truth 10)": f"{turned_zero:.2f}",
        "without a fault": "reported" if reported(capture, lambda values: values, refractive_index) else "ok",
        **{
            name: "reported" if reported(capture, change, refractive_index) else "missed"
            for name, change in faults.items()
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="+", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    columns = [verdicts(path) for path in arguments.scenes]
    print(f"| test | {' | '.join(path.name for path in arguments.scenes)} |\n|---|{'---|' * len(columns)}")
    for test in columns[0]:
        print(f"| {test} | {' | '.join(column[test] for column in columns)} |")


if __name__ == "__main__":
    main()
