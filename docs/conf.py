"""Sphinx: ``make docs`` writes docs/_build/index.html. The API reference and most texts come from docstrings."""

from __future__ import annotations

from pathlib import Path

import gpvo
from sphinx.ext import apidoc

project = "gpvo"
author = "the gpvo contributors"
version = release = gpvo.__version__
extensions = ["sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
html_theme = "alabaster"
html_theme_options = {
    "description": "Tells your filter how wrong stereo visual odometry is, right now.",
    "page_width": "1080px",
    "sidebar_width": "240px",
}
html_static_path = ["_static"]  # custom.css
html_copy_source = False
html_show_copyright = False
# Each name once, where it is defined: packages that pass names on list none of them again.
autodoc_default_options = {
    "members": True,
    "member-order": "bysource",
    "undoc-members": False,
    "ignore-module-all": True,
}
autodoc_typehints = "signature"
autodoc_class_signature = "mixed"
napoleon_use_ivar = True
default_role = "literal"
# Fields of equal name in several dataclasses are no mistake.
suppress_warnings = ["ref.python"]

HERE = Path(__file__).parent


def write_api(app: object) -> None:
    """A page per package, made anew at every build so that no module is forgotten."""
    package = Path(gpvo.__file__).parent
    apidoc.main(["--force", "--no-toc", "--module-first", "--output-dir", str(HERE / "api"), str(package)])


def bars(app: object, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Docstrings write norms as |x|, which is no substitution."""
    for i, line in enumerate(lines):
        if not line.startswith("    "):
            parts = line.split("``")
            lines[i] = "``".join(p if k % 2 else p.replace("|", "\\|") for k, p in enumerate(parts))


def setup(app: object) -> None:
    """Called by Sphinx."""
    app.connect("builder-inited", write_api)  # type: ignore[attr-defined]
    app.connect("autodoc-process-docstring", bars)  # type: ignore[attr-defined]
