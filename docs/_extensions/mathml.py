"""Writes formulas as MathML, which browsers draw without a script.

Docutils brings the translation from LaTeX; this makes it a math renderer of Sphinx.
"""

from __future__ import annotations

from docutils import nodes
from docutils.utils.math import latex2mathml


def visit_inline(writer, node) -> None:
    writer.body.append(latex2mathml.tex2mathml(node.astext()))
    raise nodes.SkipNode


def visit_block(writer, node) -> None:
    formula = latex2mathml.tex2mathml(node.astext(), as_block=True)
    writer.body.append(
        f'<div class="math" style="overflow-y: hidden; padding: 0.3em 0">{formula}</div>'
    )
    raise nodes.SkipNode


def setup(app) -> dict[str, bool]:
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
