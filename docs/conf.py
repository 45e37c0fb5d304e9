"""How Sphinx builds the documentation: ``make docs``, or ``sphinx-build -W -n docs build/docs``."""

import sys
from importlib.metadata import version as installed_version
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))

project = "polarguide"
author = "The polarguide authors"
copyright = author
version = release = installed_version("polarguide")

extensions = [
    "myst_nb",  # Markdown, and notebooks in it, which are run
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinxcontrib.bibtex",
    "formulas",
    "plain_docstrings",
    "generated_pages",
    "offline",
    "sphinx.ext.githubpages",  # for hosts that would leave out folders such as _static
]
exclude_patterns = ["_extensions", "generated"]
suppress_warnings = ["config.cache"]
# References into the package have to lead somewhere; those into other packages are shown as they are.
nitpicky = True
nitpick_ignore_regex = [("py:.*", r"(?!polarguide[._]).*|.*\[.*|.*\.T")]  # the last: type variables

myst_enable_extensions = ["attrs_block", "attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
# A notebook that fails is an error. Its files are temporary.
nb_execution_mode = "auto"
nb_execution_in_temp = True
nb_execution_timeout = 900  # a cell takes a minute; a machine with other work is slow
nb_execution_raise_on_error = True
nb_merge_streams = True
math_number_all = False
html_math_renderer = "formulas"

bibtex_bibfiles = ["reference/bibliography.bib"]
bibtex_reference_style = "author_year"
bibtex_default_style = "plain"

autodoc_member_order = "bysource"
add_module_names = False
toc_object_entries_show_parents = "hide"
highlight_language = "none"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
# Optional extras: modules that import them at the top are described without them.
autodoc_mock_imports = ["gsplat", "mitsuba", "drjit"]
python_maximum_signature_line_length = 90
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_param = False
napoleon_use_rtype = False
# One entry may describe several names ("width, height: ..."), which Sphinx' own field lists do not know. And a public
# class stands both in the interface and in its room, so that its bare name leads nowhere.
napoleon_custom_sections = [("Attributes", "params_style"), ("Raises", "params_style")]

html_theme = "furo"
html_title = f"polarguide {release}"
html_static_path = ["_static"]
html_css_files = ["polarguide.css"]
html_js_files = [("wipes.js", {"defer": "defer"})]
html_copy_source = False
html_show_sourcelink = False
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
