"""Run the notebooks and keep their outputs: ``python tools/run_notebooks.py [NAME.ipynb ...]``.

Needs ``pip install nbclient ipykernel`` in addition to the package with ``[report]``. The tests need neither,
since they run the cells themselves. Files written by a notebook stay in a temporary directory.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent / "notebooks"
MOST_BYTES = 200_000
"""Largest size of a notebook with its outputs."""
KEPT = ("image/png", "text/html", "text/plain")


def main(names: list[str]) -> int:
    for path in [Path(name) for name in names] or sorted(HERE.glob("*.ipynb")):
        document = run(path)
        text = json.dumps(document, indent=1, ensure_ascii=False) + "\n"
        if len(text) > MOST_BYTES:
            raise SystemExit(f"{path} would have {len(text)} bytes; possible: up to {MOST_BYTES}")
        path.write_text(text, encoding="utf-8")
        print(f"{path}: {len(text)} bytes")
    return 0


def run(path: Path) -> dict[str, Any]:
    """Return the notebook with the outputs of all its cells. Raises what a cell raises."""
    import nbclient
    import nbformat

    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as directory:
        client = nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": directory}})
        client.execute()
    document: dict[str, Any] = json.loads(nbformat.writes(notebook))
    document["metadata"] = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    for cell in document["cells"]:
        cell["metadata"] = {}
        if cell["cell_type"] == "code":
            cell["outputs"] = [tidied(output) for output in cell["outputs"] if _is_shown(output)]
    return document


def _is_shown(output: dict[str, Any]) -> bool:
    """Whether to keep an output: not what a program writes to stderr."""
    return output["output_type"] != "stream" or output["name"] == "stdout"


def tidied(output: dict[str, Any]) -> dict[str, Any]:
    """Reduce an output to what a reader of the notebook sees."""
    if "data" in output:
        output["data"] = {kind: output["data"][kind] for kind in KEPT if kind in output["data"]}
        if "image/png" in output["data"]:
            output["data"].pop("text/plain", None)
        output["metadata"] = {}
    return output


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
