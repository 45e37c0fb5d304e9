"""Small pictures and tables as HTML, for notebooks: each is whole in itself, without a file or a script."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.optics.color import srgb_encode_array

_WIDTH = 160
"""Pixels of a thumbnail."""


def figure(radiance: NDArray[Any], caption: str) -> str:
    """A picture of linear radiance [H, W, 3] as a thumbnail with a caption; white is its 99th percentile at most."""
    white = min(1.0, max(float(np.percentile(radiance, 99)), 1e-6))
    shades = srgb_encode_array(np.clip(radiance / white, 0, 1)) * 255
    height, width = shades.shape[:2]
    size = _WIDTH, max(1, round(_WIDTH * height / width))
    way = cv2.INTER_AREA if width > _WIDTH else cv2.INTER_NEAREST
    small = cv2.resize(np.rint(shades[..., ::-1]).astype(np.uint8), size, interpolation=way)
    data = base64.b64encode(cv2.imencode(".jpg", small)[1].tobytes()).decode()
    return (
        '<figure style="display:inline-block;margin:0 8px 8px 0">'
        f'<img src="data:image/jpeg;base64,{data}" width="{size[0]}" alt="{html.escape(caption)}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def table(title: str, facts: Mapping[str, str]) -> str:
    """Facts in two columns, below a title."""
    rows = "".join(
        f'<tr><th style="text-align:left">{html.escape(name)}</th>'
        f'<td style="text-align:left;white-space:pre-line">{html.escape(text)}</td></tr>'
        for name, text in facts.items()
    )
    return f"<table><caption>{html.escape(title)}</caption>{rows}</table>"
