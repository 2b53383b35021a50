"""How Sphinx makes the site: ``make docs``, without a network."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import zmq
from jupyter_client.connect import ConnectionFileMixin

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE / "_ext")]

project = "Yardstick"
author = "The Yardstick authors"
html_title = "Yardstick"

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "agent_classes",
    "fill_pages",
    "mathml",
    "root_documents",
    "site_contents",
    "site_docstrings",
]
exclude_patterns = ["_ext", "decisions", "images", "measured", "scripts"]

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3

# Lessons run in processes of their own, which find the project here. They talk through a port:
# with keys, nobody else on this machine can.
os.environ["PYTHONPATH"] = os.pathsep.join([str(HERE.parent), os.environ.get("PYTHONPATH", "")])
public_key, secret_key = zmq.curve_keypair()
ConnectionFileMixin.curve_publickey.default_value = public_key
ConnectionFileMixin.curve_secretkey.default_value = secret_key

# A lesson is run where it lies, so that it can import its checker. One that fails fails the build.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300  # of a cell, on a busy machine that has compiled nothing yet
nb_execution_excludepatterns = ["*.ipynb"]  # tests run them; the site shows their own outputs
nb_merge_streams = True
nb_render_markdown_format = "myst"  # it has tables

# Blocks without a language are outputs.
highlight_language = "text"

# Docstrings have their names between single backticks.
default_role = "literal"
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
napoleon_numpy_docstring = False
napoleon_use_ivar = True

# Two classes in different packages may have the same name.
suppress_warnings = ["ref.python"]

html_theme = "furo"
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_js_files = ["site.js"]
html_show_copyright = False
html_show_sphinx = False
# What a search shows of pages is fetched, which browsers refuse where pages are files.
html_show_search_summary = False
html_copy_source = False
