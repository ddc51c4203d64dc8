"""Fixtures for all tests: separate folders, one thread per library, restored logs, no time limits."""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from runtime.support.background import wait_for_all
from runtime.support.logs import ROOTS

# A busy machine must not fail a property, nor chance a change that has nothing to do with it: new examples each time
# are the night's work.
settings.register_profile("same", deadline=None, derandomize=True)
settings.register_profile("new", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))

# A worker has a core; libraries that take all cores for each worker make both slower.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


def pytest_configure(config: pytest.Config) -> None:
    """Give this process, and every process that a test starts, folders for state, caches and sockets that are new."""
    if hasattr(config, "workerinput"):
        for name in THREADS:
            os.environ.setdefault(name, "1")
    folder = Path(tempfile.mkdtemp(prefix="phasestack-tests-"))  # short: a socket's path has at most 107 bytes
    config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
    for name in ("STATE", "CACHE", "RUNTIME", "CONFIG", "DATA"):
        own = folder / name.lower()
        own.mkdir(mode=0o700)
        os.environ[f"XDG_{name}_{'DIR' if name == 'RUNTIME' else 'HOME'}"] = str(own)


@pytest.fixture(autouse=True)
def logs_as_they_were() -> Iterator[None]:
    """A test that configures the logs leaves neither its handlers nor the lines that they lost to the next one."""
    loggers = [logging.getLogger(name) for name in ROOTS]
    before = [(logger.handlers[:], logger.level, logger.propagate) for logger in loggers]
    yield
    for handler in {handler for logger in loggers for handler in logger.handlers}:
        if not any(handler in handlers for handlers, _, _ in before):
            handler.close()
    for logger, (handlers, level, propagate) in zip(loggers, before, strict=True):
        logger.handlers[:], logger.level, logger.propagate = handlers, level, propagate


def pytest_sessionfinish() -> None:
    """A process that ends while a job measures or loads is ended by the libraries in it, with another exit code."""
    wait_for_all(60.0)
