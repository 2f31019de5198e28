"""How the documentation is built: pages in Markdown, the reference from the docstrings, pictures drawn on the way.

``make docs`` builds it with warnings as errors and without a network.
"""

from __future__ import annotations

import pkgutil
import re
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import drawing
from sphinx.util import logging

import stereokit

project = "stereokit"
author = "The stereokit developers"
copyright = author
release = version = stereokit.__version__

extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
exclude_patterns = ["_build", "_generated"]
default_role = "py:obj"  # `Matcher` in a docstring is a link if there is such a thing, else code
myst_enable_extensions = ["colon_fence"]
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


def resolve(app: Any, env: Any, node: Any, content: Any) -> Any:
    """Find what a docstring calls by another path than its page does, such as `stereokit_refiners.Refiner`.

    A path within the project that leads nowhere is a mistake in the docstring, and reported.
    """
    target, module = node.get("reftarget", ""), node.get("py:module")
    if node.get("refdomain") != "py" or not re.fullmatch(r"\w[\w.]*", target):
        return None
    domain = env.domains["py"]
    for path in (target, f"{module}.{target}"):
        try:
            target_object = pkgutil.resolve_name(path)
        except (ImportError, AttributeError, ValueError):
            continue
        for name in domain.objects:
            if (
                name.split(".")[-1] == getattr(target_object, "__name__", "")
                and pkgutil.resolve_name(name) is target_object
            ):
                return domain.resolve_xref(env, node["refdoc"], app.builder, "obj", name, node, content)
        return None
    if re.match(r"stereokit\w*\.", target):
        logging.getLogger("conf").warning("nothing is called %s", target, location=node)
    return None


def setup(app: Any) -> None:
    """Draw the pictures and write the commands' help before the pages are read."""
    app.connect("missing-reference", resolve)
    app.connect("builder-inited", lambda app: drawing.write_all(Path(app.srcdir) / "_generated"))
