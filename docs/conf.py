"""How Sphinx builds the documentation: ``make docs``."""

import sys
from pathlib import Path

import torchrl_mcp

sys.path.append(str(Path(__file__).parent / "_extensions"))

project = "torchrl-mcp"
author = "the torchrl-mcp authors"
project_copyright = "the torchrl-mcp authors"
release = version = torchrl_mcp.__version__

extensions = [
    "commands",
    "docstrings",
    "local_names",
    "pages",
    "repository_links",
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx-mathjax-offline",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["_build"]
myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

# Every name that the documentation links to must exist. Those of other projects are not looked up, which would need a
# network.
nitpicky = True
nitpick_ignore_regex = [
    (r"py:.*", r"(abc|argparse|collections|dataclasses|datetime|pathlib|typing)\..*"),
    (r"py:.*", r"(gymnasium|hydra|matplotlib|mujoco|numpy|omegaconf|PIL|tensordict|torch|torchrl)\..*"),
    (r"py:class", r".*\._AcceptedKeys"),  # TorchRL's way of naming keys
    (r"py:class", r".*\.(threads\.Result|falls\.Numbers)"),  # type variables
]

autodoc_mock_imports = ["mujoco_warp", "warp"]  # an extra
autodoc_default_options = {"members": True, "member-order": "bysource", "show-inheritance": True}
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_class_signature = "mixed"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"
napoleon_numpy_docstring = False
napoleon_custom_sections = ["Reference"]
napoleon_use_ivar = True

# On its own page, and with characters as vectors: nothing is fetched, whatever the browser has.
mathjax_path = "mathjax/tex-svg.js"
mathjax3_config = {"svg": {"fontCache": "global"}, "options": {"enableMenu": False}}

pygments_dark_style = "github-dark"
html_theme = "furo"
html_title = "torchrl-mcp"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_copy_source = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0b4f9e", "color-brand-content": "#0b4f9e"},
    "dark_css_variables": {"color-brand-primary": "#6cb6f0", "color-brand-content": "#6cb6f0"},
}
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
