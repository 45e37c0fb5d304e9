"""Formulas as SVG, so that pages need no script, network or font."""

from __future__ import annotations

import html
from typing import Any

import ziamath
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util import logging

logger = logging.getLogger(__name__)
# Sizes in pixels; glyphs are drawn to a tenth of one.
BLOCK_SIZE, INLINE_SIZE = 18, 16.5
ziamath.config.precision = 1
ziamath.config.svg2 = False


def drawn(node: nodes.Node, *, inline: bool) -> str:
    """Draw the formula of a node as SVG in the color of the text. Its source and a warning replace it on failure."""
    source = " ".join(node.astext().split())
    try:
        size = INLINE_SIZE if inline else BLOCK_SIZE
        formula = ziamath.Latex(source, size=size, inline=inline, color="currentColor", margin=1.5)
        below, picture = formula.getyofst() - 1.5, formula.svg()
    except Exception as error:
        logger.warning("formula %r cannot be drawn: %r", source, error, location=node)
        return f"<code>{html.escape(source)}</code>"
    label = html.escape(source, quote=True)
    return picture.replace(
        "<svg ", f'<svg role="img" aria-label="{label}" style="vertical-align:{below:.1f}px" ', 1
    )


def visit_inline(self: Any, node: nodes.math) -> None:
    self.body.append(f'<span class="formula">{drawn(node, inline=True)}</span>')
    raise nodes.SkipNode


def visit_block(self: Any, node: nodes.math_block) -> None:
    anchors = "".join(f' id="{name}"' for name in node.get("ids", [])[:1])
    number = f'<span class="eqno">({node["number"]})</span>' if node.get("number") else ""
    self.body.append(
        f'<div class="equation"{anchors}><span>{drawn(node, inline=False)}</span>{number}</div>\n'
    )
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_html_math_renderer("formulas", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
