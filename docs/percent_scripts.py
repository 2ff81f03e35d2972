"""Reader of the scripts of the gallery for MyST-NB."""

import jupytext
from nbformat import NotebookNode


def read(text: str) -> NotebookNode:
    """Return a script in cells (`# %%`) as a notebook whose code is highlighted as Python."""
    notebook = jupytext.reads(text, fmt="py:percent")
    notebook.metadata["language_info"] = {"name": "python", "pygments_lexer": "ipython3"}
    return notebook
