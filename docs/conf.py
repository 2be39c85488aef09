"""Sphinx configuration: `make docs` builds the site into build/docs from these pages.

Nothing is fetched during the build, and the pages load nothing from other sites. Pages that would
go stale are generated into docs/generated (`docs/site`): each verb's page from the command line,
the Python reference from the docstrings, the examples from their files.
"""

import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS / "site"))

from surgicai_vision import __version__  # noqa: E402

project = "surgicai-vision"
release = version = __version__
copyright = "the authors of surgicai-vision, MIT licence"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "generated_pages",
    "docstrings",
    "repository_links",
]
exclude_patterns = ["site", "results/*/**"]
suppress_warnings = [
    "ref.python"
]  # an annotation's bare name, such as Plugin, may exist in two modules

myst_enable_extensions = ["attrs_block", "colon_fence", "deflist", "substitution"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_mock_imports = ["genpy", "rclpy", "rosgraph", "rospy"]  # ROS itself; in no package index
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
python_maximum_signature_line_length = 88
python_use_unqualified_type_names = True
add_module_names = False
toc_object_entries = False  # one line per module; each copy of the contents costs time

html_theme = "furo"
html_title = f"surgicai-vision {__version__}"
html_static_path = ["static"]
html_favicon = html_logo = "static/needle.svg"
html_css_files = ["site.css"]
html_copy_source = False
html_theme_options = {
    "light_css_variables": {
        "color-brand-primary": "#0b6e75",
        "color-brand-content": "#0b6e75",
    },
    "dark_css_variables": {
        "color-brand-primary": "#5cc8c2",
        "color-brand-content": "#5cc8c2",
    },
}
