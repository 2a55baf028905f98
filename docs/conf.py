"""The documentation site: `pip install -e '.[docs]'`, then `sphinx-build -W docs build/docs`."""

from importlib.metadata import version as installed_version

project = "lang3dxl-ns"
author = "the lang3dxl-ns authors"
copyright = "lang3dxl-ns authors, Apache-2.0"
version = release = installed_version(project)

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

html_theme = "furo"
html_title = "lang3dxl-ns"

autodoc_typehints = "description"
autodoc_member_order = "bysource"
# jaxtyping writes shapes as strings in annotations, which are no references to anything.
autodoc_type_aliases = {"Tensor": "torch.Tensor"}
napoleon_google_docstring = True
exclude_patterns = ["build"]
