"""Self-contained HTML pages and SVG files from the templates in the ``page`` folders of packages.

Pictures in pages are data URIs with a limited size.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
from functools import lru_cache
from typing import Any

import cv2
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, select_autoescape
from PIL import Image

from polarguide.visualization.figures import Picture, check_picture

BASE = "polarguide.visualization"
"""Package whose folder ``page`` contains the common template ``base.html``."""


@lru_cache
def templates(package: str) -> Environment:
    """Load the common templates and those in a package's folder ``page``. Values in HTML and SVG are escaped."""
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package, "page"), PackageLoader(BASE, "page")]),
        autoescape=select_autoescape(["html", "svg"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["script_json"] = script_json
    return environment


def page_part(package: str, name: str) -> str:
    """Return the text of a file in a package's folder ``page``."""
    loader = templates(package).loader
    assert loader is not None
    return loader.get_source(templates(package), name)[0]


def page(package: str, name: str, *, script: str = "", more: str = "", **values: Any) -> str:
    """Render an HTML page from a template that extends ``base.html``.

    Args:
        package, name: the template.
        script: content of the page's script element; empty forbids scripts.
        more: additional sources of scripts; further directives follow a semicolon.
        values: values of the template, at least ``title``.
    """
    return (
        templates(package)
        .get_template(name)
        .render(policy=content_policy(script, more=more), script=script, **values)
    )


def script_json(data: Any) -> str:
    """Return JSON that is safe inside a script element of a page."""
    text = json.dumps(data, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def content_policy(script: str = "", *, more: str = "") -> str:
    """Return a content policy that allows only inline pictures, styles and one script, and no requests.

    Args:
        script: content of the page's script element; empty forbids scripts.
        more: additional sources of scripts; further directives follow a semicolon.
    """
    allowed = ""
    if script:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        allowed = f" script-src 'sha256-{digest}'{more};"
    return f"default-src 'none';{allowed} img-src data:; style-src 'unsafe-inline'; form-action 'none'; base-uri 'none'"


LAYERS: dict[str, str] = {
    "final": "final",
    "diffuse": "diffuse",
    "specular": "specular",
    "normal": "normal",
    "error": "error of final",
    "normal_error": "normal error",
    "metalness": "metalness",
}
"""Layers that the report shows, in order, with key and label."""
LOSSLESS = ("normal",)
JPEG_QUALITY = 90


def data_uri(picture: Picture, layer: str, side: int) -> str:
    """Encode a picture uint8 RGB [H, W, 3] as a data URI. Its longer side is reduced to ``side`` pixels."""
    check_picture(picture, layer)
    factor = min(1.0, side / max(picture.shape[:2]))
    size = [max(1, round(factor * length)) for length in (picture.shape[1], picture.shape[0])]
    resized = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    kind = "png" if layer in LOSSLESS else "jpeg"
    file = io.BytesIO()
    Image.fromarray(resized).save(file, kind, optimize=True, quality=JPEG_QUALITY)
    return f"data:image/{kind};base64,{base64.b64encode(file.getvalue()).decode()}"
