"""Make the shipped models anew from their recipes: `python -m model_export.ship`."""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

from model_export.checkpoint import solver_of
from model_export.export import spectral_file
from model_export.recipe import read_recipe
from model_export.validate import check_model
from runtime.model.predictor import SHIPPED, SUMS, model_path
from runtime.support.artifacts import write_bytes, write_text


def shipped_bytes(name: str) -> bytes:
    """The file of a shipped model, the same bytes every time (with one version of torch and onnx)."""
    recipe = read_recipe(name)
    return spectral_file(solver_of(recipe, source=name), recipe)


def main() -> int:
    """Write them where the runtime finds them; 1 where one fails its checks."""
    rows: list[str] = []
    for name in SHIPPED:
        path = Path(str(model_path(name)))
        data = shipped_bytes(name)
        report = check_model(data, source=str(path))
        print(report.table())
        if not report.passed:
            return 1
        write_bytes(path, data)
        rows.append(f"{hashlib.sha256(data).hexdigest()}  {path.name}\n")
    write_text(path.parent / SUMS, "".join(sorted(rows, key=lambda row: row.split()[1])))
    return 0


if __name__ == "__main__":
    sys.exit(main())
