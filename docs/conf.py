"""How sphinx makes the site of these pages: ``make docs``."""

from __future__ import annotations

import inspect
import re
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

import saferl

project = "saferl"
author = copyright = "the saferl authors"
version = release = saferl.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]

html_theme = "furo"
html_title = "saferl"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_math_renderer = "mathml"

myst_enable_extensions = ["dollarmath"]
myst_dmath_double_inline = True
myst_heading_anchors = 3

# Docstrings say the kinds and shapes of what a function takes; the signature shows names and defaults.
autodoc_default_options = {"members": True, "exclude-members": "activation, default_keys"}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_inherit_docstrings = False
autodoc_typehints = "none"
napoleon_use_ivar = True
napoleon_use_keyword = False  # so that several names may share a line
maximum_signature_line_length = 88


def as_rest(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Shapes such as [*B, A] are no emphasis, one letter is no list, and what is read and what is written are paragraphs."""
    told, inside = [], False
    for line in lines:
        begins = re.match(r"(Reads|Writes) ", line)
        if begins:
            told.append("")
            line = f"**{begins[1]}** {line[begins.end() :]}"
        inside = bool(begins) or (inside and line.startswith(" "))
        line = line.strip() if inside else line
        line = re.sub(r"(``.*?``)|(?<![\w\\])\*(?=B\b)", lambda m: m[1] or r"\*", line)
        told.append(re.sub(r"(?<=: )(?=[A-Za-z]\.$)", r"\\", line))
    lines[:] = told


def signature(app: Any, what: str, name: str, obj: Any, options: Any, given: str, returns: str):
    """A loss's metaclass hides what its constructor takes, and a class as default is no Python."""
    if what == "class" and given == "(*args, **kwargs)":
        taken = inspect.signature(obj.__init__)
        own = list(taken.parameters.values())[1:]
        plain = [each.replace(annotation=inspect.Parameter.empty) for each in own]
        given = str(taken.replace(parameters=plain, return_annotation=taken.empty))
    return given and re.sub(r"<class '[\w.]*?(\w+)'>", r"\1", given), returns


def mathml(text: str, **options: Any) -> str:
    """MathML of what docutils reads: no sizes of brackets, and braces around what a command takes."""
    text = re.sub(r"\\[Bb]ig(?![a-z])", "", text)
    text = re.sub(r"\\tfrac(\d)(\d)", r"\\tfrac{\1}{\2}", text)
    text = re.sub(r"\\(bar|tilde) (\\?\w+)", r"{\\\1{\2}}", text)
    return tex2mathml(text, **options)


def inline_math(translator: Any, node: nodes.math) -> None:
    translator.body.append(mathml(node.astext()))
    raise nodes.SkipNode


def block_math(translator: Any, node: nodes.math_block) -> None:
    text = node.astext()
    if r"\\" in text and r"\begin" not in text:
        text = rf"\begin{{aligned}}{text}\end{{aligned}}"
    translator.body.append(f'<div class="math">{mathml(text, as_block=True)}</div>\n')
    raise nodes.SkipNode


def setup(app: Any) -> None:
    app.connect("autodoc-process-docstring", as_rest)
    app.connect("autodoc-process-signature", signature)
    # MathML needs neither a script nor a network; Sphinx has no renderer for it.
    app.add_html_math_renderer("mathml", (inline_math, None), (block_math, None))
