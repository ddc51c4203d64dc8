"""Imports a module from another source text than its file's: nothing on disk is changed."""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import importlib.util
import sys
from types import CodeType, ModuleType
from typing import Any


class _Loader(importlib.machinery.SourceFileLoader):
    """The file's loader, but for what it compiles."""

    def __init__(self, name: str, path: str, code: CodeType) -> None:
        super().__init__(name, path)
        self._mutant = code

    def get_code(self, fullname: str) -> CodeType:
        return self._mutant


class _Finder(importlib.abc.MetaPathFinder):
    def __init__(self, name: str, code: CodeType) -> None:
        self._name, self._code = name, code
        self.used = False

    def find_spec(self, fullname: str, path: Any, target: ModuleType | None = None) -> Any:
        if fullname != self._name:
            return None
        found = importlib.machinery.PathFinder.find_spec(fullname, path)
        assert found is not None and found.origin is not None
        self.used = True
        return importlib.util.spec_from_file_location(
            fullname, found.origin, loader=_Loader(fullname, found.origin, self._code)
        )


def put_in_place_of(module: str, code: CodeType) -> _Finder:
    """From now on `module` is made of `code` in this process. Raises RuntimeError where it is imported already."""
    if module in sys.modules:
        raise RuntimeError(f"{module} is imported already")
    finder = _Finder(module, code)
    sys.meta_path.insert(0, finder)
    return finder
