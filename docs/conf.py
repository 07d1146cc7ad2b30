"""Settings of the documentation site: Sphinx with MyST, built by `make docs`."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[1]
#: OWNER/NAME of the repository, which GitHub sets in its workflows; without one, the site links to none.
REPOSITORY = os.environ.get("GITHUB_REPOSITORY", "")
sys.path.insert(0, str(ROOT))

project = "PIAvatar Envs"
author = "The PIAvatar Envs authors"
copyright = "2026, the PIAvatar Envs authors"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["conf.py"]

myst_enable_extensions = ["colon_fence", "dollarmath", "deflist"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_custom_sections = [("Class attributes", "Attributes"), ("Page attributes", "Attributes")]

html_theme = "furo"
html_title = "PIAvatar Envs"
html_theme_options = {"navigation_with_keys": True} | (
    {
        "source_repository": f"https://github.com/{REPOSITORY}/",
        "source_branch": "main",
        "source_directory": "docs/",
    }
    if REPOSITORY
    else {}
)
html_copy_source = False
html_show_sourcelink = False
# Prompts are not copied.
copybutton_prompt_text = r">>> |\$ "
copybutton_prompt_is_regexp = True

# `make docs LINKS=1`
linkcheck_anchors = False
linkcheck_retries = 2
linkcheck_timeout = 15
linkcheck_report_timeouts_as_broken = False


def plain_links_to_folders(app: Sphinx, name: str, source: list[str]) -> None:
    """Replace links to folders and to Markdown outside of the site, which have no page, by paths in the repository."""
    page = (Path(app.srcdir) / name).parent

    def replaced(match: re.Match[str]) -> str:
        target = (page / match[2].partition("#")[0]).resolve()
        outside = not target.is_relative_to(app.srcdir)
        if outside and (target.is_dir() or target.suffix == ".md"):
            return f"{match[1]} (`{target.relative_to(ROOT)}`)"
        return match[0]

    source[0] = re.sub(r"(?<!!)\[([^\]]+)\]\((\.\.[^)\s]*)\)", replaced, source[0])


def links_to_notebooks(app: Sphinx, name: str, source: list[str]) -> None:
    """Replace links to notebooks, which have no page, by links to GitHub and Colab, or by paths without GitHub."""
    source[0] = re.sub(r"\[([^\]]+)\]\((?:\.\./)*(notebooks/\w+\.ipynb)\)", _notebook, source[0])


def _notebook(match: re.Match[str]) -> str:
    """Return the replacement of a link to a notebook."""
    title, file = match.groups()
    if not REPOSITORY:
        return f"{title} (`{file}`)"
    place, colab = f"github/{REPOSITORY}/blob/main/{file}", "https://colab.research.google.com"
    badge = f"[![Open in Colab]({colab}/assets/colab-badge.svg)]({colab}/{place})"
    return f"[{title}](https://{place.replace('github', 'github.com', 1)}) {badge}"


def setup(app: Sphinx) -> None:
    """Connect the handlers of this file."""
    app.connect("source-read", links_to_notebooks)
    app.connect("source-read", plain_links_to_folders)
