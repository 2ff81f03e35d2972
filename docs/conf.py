"""Settings of Sphinx. `python -m sphinx -W -c docs . docs/_build` writes the documentation.

The source folder is that of the repository, so that links between pages, notebooks and files at the top hold
both here and where the repository is browsed.
"""

import importlib.metadata
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

project = "jaxcrumple"
author = "The jaxcrumple developers"
copyright = f"2026, {author}"
release = version = importlib.metadata.version("jaxcrumple")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "source_signatures",
]
root_doc = "docs/index"
include_patterns = [
    "docs/*.md",
    "docs/api/*.md",
    "docs/gallery/*.md",
    "docs/gallery/*.py",
    "notebooks/*.ipynb",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "CODE_OF_CONDUCT.md",
]

# Pages are Markdown. Scripts of the gallery and notebooks are pages too, with pictures and outputs that
# are stored with them: nothing runs while the pages are built.
myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
nb_execution_mode = "off"
nb_custom_formats = {".py": "percent_scripts.read"}

# A name in single backticks in a docstring is a link where it is one of ours.
default_role = "py:obj"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
python_use_unqualified_type_names = True
add_module_names = False
maximum_signature_line_length = 100

html_theme = "furo"
html_static_path = ["static"]
html_css_files = ["style.css"]
html_title = f"jaxcrumple {release}"
