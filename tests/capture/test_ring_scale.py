"""The printable scale of a filter's ring."""

from __future__ import annotations

import math
import re
from xml.etree import ElementTree

import pytest

from polarguide.capture.filter.ring_scale import BAND, place, ring_scale

SVG = "{http://www.w3.org/2000/svg}"


def test_sizes_are_millimeters() -> None:
    root = ElementTree.fromstring(ring_scale(70.0))
    box = [float(value) for value in root.attrib["viewBox"].split()]
    assert root.attrib["width"] == f"{box[2]:.3f}mm"
    assert root.attrib["height"] == f"{box[3]:.3f}mm"
    radii = sorted(float(circle.attrib["r"]) for circle in root.iter(f"{SVG}circle"))
    assert radii == [35.0, 35.0 + BAND]
    lines = [{k: float(line.attrib[k]) for k in ("x1", "x2", "y1", "y2")} for line in root.iter(f"{SVG}line")]
    assert any(abs(line["x2"] - line["x1"] - 50) < 1e-9 and line["y1"] == line["y2"] for line in lines)
    for line in lines:
        assert all(0 <= line[k] <= box[2 if k[0] == "x" else 3] for k in line)


def test_angles_count_from_behind_the_camera_and_are_read_from_the_front() -> None:
    """A field at a degrees points to (cos a, -sin a) in the picture; from the front, right and left change places."""
    root = ElementTree.fromstring(ring_scale(58.0))
    middle = float(root.attrib["viewBox"].split()[2]) / 2
    seen: dict[int, int] = {}
    for text in root.iter(f"{SVG}text"):
        if not re.fullmatch(r"\d+", text.text or ""):
            continue
        degrees = int(text.text or "")
        x, y = float(text.attrib["x"]) - middle, float(text.attrib["y"]) - middle
        right, up = -x, -y  # of the picture
        turn = math.degrees(math.atan2(up, right)) % 180
        assert min(abs(turn - degrees), 180 - abs(turn - degrees)) < 0.01
        seen[degrees] = seen.get(degrees, 0) + 1
    assert seen == {angle: 2 for angle in range(0, 180, 15)}
    assert place(90, 0, 1) == pytest.approx((0, -1))
    assert place(45, 0, 1) == pytest.approx((-math.sqrt(0.5), -math.sqrt(0.5)))
