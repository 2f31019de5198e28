"""How the documentation is built: pages in Markdown, the reference from the docstrings, pictures drawn on the way.

``make docs`` builds it with warnings as errors and without a network.
"""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import drawing

import stereokit

project = "stereokit"
author = "The stereokit developers"
copyright = author
release = version = stereokit.__version__

extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx.ext.viewcode"]
exclude_patterns = ["_build", "_generated"]
default_role = "py:obj"  # `Matcher` in a docstring is a link if there is such a thing, else code
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say more: shapes and units
autodoc_mock_imports = [name for name in ("torch",) if find_spec(name) is None]
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False

html_theme = "furo"
html_title = f"stereokit {release}"
html_static_path = ["_static"]
html_css_files = ["stereokit.css"]
html_copy_source = False
html_show_copyright = False


def setup(app: Any) -> None:
    """Draw the pictures and write the commands' help before the pages are read."""
    app.connect("builder-inited", lambda app: drawing.write_all(Path(app.srcdir) / "_generated"))
