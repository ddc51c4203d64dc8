"""Validated, immutable settings, read from TOML files. `settings.py` holds defaults and descriptions."""

from runtime.config.files import changed, load_settings, load_stack, with_options
from runtime.config.settings import (
    MOST,
    PLACING,
    TWO_VIEWERS_PANELS,
    CalibrationSettings,
    ContentSettings,
    LoopSettings,
    ModelSettings,
    OutputSettings,
    PanelSettings,
    PoseSettings,
    SensorSettings,
    ServiceSettings,
    Settings,
    StackGeometry,
    TrackerSettings,
)
from runtime.support.sections import Section, read_table, validated

__all__ = [
    "MOST",
    "PLACING",
    "TWO_VIEWERS_PANELS",
    "CalibrationSettings",
    "ContentSettings",
    "LoopSettings",
    "ModelSettings",
    "OutputSettings",
    "PanelSettings",
    "PoseSettings",
    "Section",
    "SensorSettings",
    "ServiceSettings",
    "Settings",
    "StackGeometry",
    "TrackerSettings",
    "changed",
    "load_settings",
    "load_stack",
    "read_table",
    "validated",
    "with_options",
]
