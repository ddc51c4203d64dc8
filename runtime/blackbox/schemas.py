"""Topics of a black box and the schema of each: Foxglove's well-known ones, the recording's, and three of its own."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any

from runtime.sensor import recording_format as fmt

LOG, SCENE, TRANSFORMS = "/log", "/scene", "/tf"
REFRESH, STATE, CLOCK = "/refresh", "/state", "/clock"
PICTURES = "/picture/"  # followed by the picture's name: layer-0, ..., seen-left, seen-right

_TIME = {"type": "integer", "description": "nanoseconds of the run's monotonic clock"}
_EYES = {
    "type": ["array", "null"],
    "minItems": 2,
    "maxItems": 2,
    "items": {"type": "array", "minItems": 3, "maxItems": 3, "items": {"type": "number"}},
}
_NUMBER, _OR_NONE = {"type": "number"}, {"type": ["number", "null"]}
REFRESH_SCHEMA: dict[str, Any] = {
    "title": "phasestack.Refresh",
    "description": "One refresh of the panels: the eyes that it is aligned to at its light, and how long it took.",
    "type": "object",
    "required": ["frame", "present_ns", "photon_ns", "eyes_m", "eyes_label", "state", "presented", "stage_ms"],
    "properties": {
        "frame": {"type": "integer", "description": "its number"},
        "capture_ns": _TIME,
        "predicted_for_ns": _TIME,
        "present_ns": _TIME,
        "photon_ns": _TIME,
        "eyes_m": _EYES | {"description": "left, right; metres; frame `stack`; at the light; null: no viewer"},
        "eyes_label": {"enum": ["exact", "interpolated", "predicted", "held", "rested", "none"]},
        "eye_sigma_mm": _OR_NONE | {"description": "standard deviation of an axis of the middle between the eyes"},
        "eye_covariance_m2": {
            "type": ["array", "null"],
            "minItems": 9,
            "maxItems": 9,
            "items": _NUMBER,
            "description": "of the middle between the eyes, frame `stack`, row by row",
        },
        "state": {"type": "string"},
        "solution": {"type": ["integer", "null"], "description": "number of the solution that is shown"},
        "solved_for_m": _EYES,
        "solution_age_ms": _OR_NONE | {"description": "the light less the instant that the solution is for"},
        "inference": {"enum": ["ran", "reused", "skipped"]},
        "presented": {"type": "boolean"},
        "skew_ms": _NUMBER,
        "capture_to_light_ms": _OR_NONE,
        "stage_ms": {"type": "object", "additionalProperties": _NUMBER},
    },
}
STATE_SCHEMA: dict[str, Any] = {
    "title": "phasestack.State",
    "description": "The state from now on, and why.",
    "type": "object",
    "required": ["monotonic_ns", "state", "reason", "missing"],
    "properties": {
        "monotonic_ns": _TIME,
        "state": {"enum": ["starting", "tracking", "holding", "flat", "degraded", "stopping"]},
        "missing": {"type": "array", "items": {"type": "string"}, "description": "parts that do not work"},
        "reason": {"type": "string"},
    },
}
CLOCK_SCHEMA: dict[str, Any] = {
    "title": "phasestack.Clock",
    "description": "Both clocks at one instant; entries of this black box that were lost because nobody kept up.",
    "type": "object",
    "required": ["monotonic_ns", "wall_ns", "lost"],
    "properties": {
        "monotonic_ns": _TIME,
        "wall_ns": {"type": "integer", "description": "nanoseconds since 1970"},
        "lost": {"type": "integer", "description": "entries, since the start"},
    },
}
_OWN = {REFRESH: REFRESH_SCHEMA, STATE: STATE_SCHEMA, CLOCK: CLOCK_SCHEMA, **fmt.SCHEMAS}
_FOXGLOVE = {LOG: "foxglove.Log", SCENE: "foxglove.SceneUpdate", TRANSFORMS: "foxglove.FrameTransforms"}
PICTURE_SCHEMA = "foxglove.CompressedImage"


def schema_of(topic: str) -> dict[str, Any]:
    """The JSON schema of a topic's messages; its title is the schema's name. Raises KeyError."""
    if topic in _OWN:
        return _OWN[topic]
    return published(PICTURE_SCHEMA if topic.startswith(PICTURES) else _FOXGLOVE[topic])


@cache
def published(name: str) -> dict[str, Any]:
    """A schema of Foxglove's, as it publishes it."""
    text = (files("runtime.blackbox") / "schemas" / f"{name}.json").read_text(encoding="utf-8")
    schema: dict[str, Any] = json.loads(text)
    return schema
