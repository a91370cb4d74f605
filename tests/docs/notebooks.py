"""The notebooks of docs/notebooks run anew, in place: `make notebooks`."""

from pathlib import Path

import nbformat
from nbclient import NotebookClient

from tests.docs.pages import DOCS

NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))
TIMEOUT_S = 1200  # of a cell


def executed(path: Path) -> nbformat.NotebookNode:
    """A notebook with new outputs, without progress bars and times."""
    notebook = nbformat.read(path, 4)
    NotebookClient(notebook, timeout=TIMEOUT_S, kernel_name="python3").execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            cell.outputs = [x for x in cell.outputs if x.get("name") != "stderr"]
    return notebook


if __name__ == "__main__":
    for notebook in NOTEBOOKS:
        nbformat.write(executed(notebook), notebook)
        print(notebook)
