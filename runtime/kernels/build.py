"""Build the compiled loops (pyproject.toml) with nanobind."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nanobind  # type: ignore[import-untyped]
from setuptools.command.build_ext import build_ext  # type: ignore[import-untyped]

# nanobind is not written for strict aliasing, and its authors advise to compile it for size.
BINDING_ARGUMENTS = ["-fno-strict-aliasing", "-Os"]


class BuildKernels(build_ext):  # type: ignore[misc]
    """`build_ext` with nanobind's headers and source."""

    def build_extension(self, ext: Any) -> None:
        folder, sources, compile_one = Path(nanobind.source_dir()), ext.sources, self.compiler._compile

        def compiled(obj: str, source: str, suffix: str, before: Any, after: list[str], options: Any) -> None:
            binds = Path(source).stem in ("binding", "nb_combined")
            compile_one(obj, source, suffix, before, [*after, *BINDING_ARGUMENTS] if binds else after, options)

        ext.include_dirs = [nanobind.include_dir(), str(folder.parent / "ext/robin_map/include")]
        ext.sources = [*sources, str(folder / "nb_combined.cpp")]
        self.compiler._compile = compiled
        try:
            super().build_extension(ext)
        finally:
            self.compiler._compile, ext.sources = compile_one, sources
