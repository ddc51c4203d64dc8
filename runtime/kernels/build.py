"""Build the compiled loops (pyproject.toml) with nanobind."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import nanobind  # type: ignore[import-untyped]
from setuptools.command.build_ext import build_ext  # type: ignore[import-untyped]

# nanobind is not written for strict aliasing, and its authors advise to compile it for size.
BINDING_ARGUMENTS = ["-fno-strict-aliasing", "-Os"]


class BuildKernels(build_ext):  # type: ignore[misc]
    """`build_ext` with nanobind's headers and source, and a compiler process per core."""

    def build_extension(self, ext: Any) -> None:
        folder, sources = Path(nanobind.source_dir()), ext.sources
        compile_one, compile_all = self.compiler._compile, self.compiler.compile

        def compiled(obj: str, source: str, suffix: str, before: Any, after: list[str], options: Any) -> None:
            binds = Path(source).stem in ("binding", "nb_combined")
            compile_one(obj, source, suffix, before, [*after, *BINDING_ARGUMENTS] if binds else after, options)

        def at_once(sources: list[str], **how: Any) -> list[str]:
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                return [
                    made
                    for objects in pool.map(lambda source: compile_all([source], **how), sources)
                    for made in objects
                ]

        ext.include_dirs = [nanobind.include_dir(), str(folder.parent / "ext/robin_map/include")]
        ext.sources = [*sources, str(folder / "nb_combined.cpp")]
        self.compiler._compile, self.compiler.compile = compiled, at_once
        try:
            super().build_extension(ext)
        finally:
            self.compiler._compile, self.compiler.compile, ext.sources = compile_one, compile_all, sources
