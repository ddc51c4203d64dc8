"""Import phasestack's `runtime`, `calib` and `model_export` packages.

They are loaded from phasestack's own folder, even if `sys.path` contains other packages with these names. Raises
ImportError if the program has already imported another module under one of these names.
"""

from __future__ import annotations

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def _import_ours(name: str) -> None:
    init = ROOT / name / "__init__.py"
    loaded = sys.modules.get(name)
    if loaded is not None:
        if not loaded.__file__ or Path(loaded.__file__).resolve() != init:
            raise ImportError(
                f"phasestack needs the package name `{name}`; rename yours at {loaded.__file__ or loaded.__path__}"
            )
        return
    spec = spec_from_file_location(name, init, submodule_search_locations=[str(init.parent)])
    assert spec is not None and spec.loader is not None
    sys.modules[name] = module = module_from_spec(spec)
    spec.loader.exec_module(module)


for _name in ("runtime", "calib", "model_export"):
    _import_ours(_name)
