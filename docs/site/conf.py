"""Sphinx: `make site` builds README, docs/ and an API reference from the docstrings into out/site."""

project = "phasestack"
author = "the phasestack authors"
html_title = "phasestack"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
include_patterns = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "THIRD_PARTY.md", "docs/*.md"]
exclude_patterns = [
    ".*",
    "out",
    "build",
    "dist",
    "runtime",
    "tests",
    "calib",
    "model_export",
    "requirements",
    "systemd",
]
source_suffix = {".md": "markdown"}
root_doc = "docs/index"
html_theme = "furo"
html_show_sphinx = html_show_copyright = False
html_copy_source = False
html_static_path = ["static"]
html_css_files = ["site.css"]
templates_path: list[str] = []
myst_heading_anchors = 3
myst_enable_extensions = ["deflist"]
# Code blocks without a language contain shell commands or Python; they are shown verbatim.
highlight_language = "none"
# Names in docstrings have single backticks; `--out` keeps both dashes.
default_role = "code"
smartquotes = False
suppress_warnings = ["myst.xref_ambiguous"]
autodoc_typehints = "description"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
nitpicky = False
