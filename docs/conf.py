"""Sphinx's settings. `./run --group docs sphinx-build -W docs docs/_build` builds the pages."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

project, author, html_title = "beadline", "The beadline maintainers", "beadline"
extensions = ["myst_parser", "sphinx.ext.autodoc", "generated"]
exclude_patterns = ["_build"]
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
html_theme, pygments_style = "furo", "default"
html_show_sourcelink = html_copy_source = False
autodoc_member_order, autodoc_typehints = "bysource", "signature"
smartquotes = False
