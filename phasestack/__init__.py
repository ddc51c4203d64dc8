"""phasestack's public, stable Python interface (docs/contracts.md, "From Python")."""

from __future__ import annotations

from phasestack import _rooms as _rooms  # must be the first import
from phasestack.attaching import Attachment, attach
from phasestack.example import ExamplePair, example_pair
from phasestack.many import solve_each
from phasestack.pair import Cameras, Eyes, Measuring, Result, camera, evaluate, project, solve
from phasestack.pictures import find_eyes
from phasestack.stack import Stack
from runtime.content.base import ContentSource
from runtime.errors import SensorLost, SensorTimeout
from runtime.evaluation.solved import PairQuality
from runtime.evaluation.solved import PairQuality as Quality
from runtime.eyes.pupils import Pupils
from runtime.optics.real.cells import Cell
from runtime.optics.real.panels import Lighting, Optics, Placement, RealPanels, Timing
from runtime.records import EyePoints, SensorFrame
from runtime.sensor.base import Capabilities, DeviceClock, Sensor
from runtime.support.version import version

__version__ = version()

__all__ = [
    "Attachment",
    "Cameras",
    "Capabilities",
    "Cell",
    "ContentSource",
    "DeviceClock",
    "ExamplePair",
    "EyePoints",
    "Eyes",
    "Lighting",
    "Measuring",
    "Optics",
    "PairQuality",
    "Placement",
    "Pupils",
    "Quality",
    "RealPanels",
    "Result",
    "Sensor",
    "SensorFrame",
    "SensorLost",
    "SensorTimeout",
    "Stack",
    "Timing",
    "__version__",
    "attach",
    "camera",
    "evaluate",
    "example_pair",
    "find_eyes",
    "project",
    "solve",
    "solve_each",
]
