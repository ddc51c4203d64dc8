"""What stands in a recording: topics, schemas, and each message as bytes and back."""

from __future__ import annotations

import base64
import json
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from runtime.records import F64, U8, U16, EyePoints, Intrinsics, SensorFrame

SCHEMA_VERSION = 1
METADATA_NAME = "phasestack.recording"
EYES_TOPIC, COLOUR_TOPIC, DEPTH_TOPIC, CALIBRATION_TOPIC = "/eyes", "/colour", "/depth", "/camera"
POSITION_DIGITS = 7  # a tenth of a micrometre: four digits below the best sensor's noise
JPEG_QUALITY = 92

_PAIR = {"type": ["array", "null"], "minItems": 2, "maxItems": 2}
EYES_SCHEMA = {
    "title": "phasestack.EyeSample",
    "description": "One sample of an eye-tracking sensor: the viewer's left eye, then the right; metres.",
    "type": "object",
    "required": ["sequence", "capture_ns", "eyes_m"],
    "properties": {
        "sequence": {"type": "integer", "description": "counts the device's frames; gaps are losses"},
        "capture_ns": {"type": "integer", "description": "monotonic clock when the light was integrated"},
        "eyes_m": _PAIR | {"description": "frame `sensor` (+x right, +y down, +z away); null: no face"},
        "confidence": {"type": "array", "description": "0 to 1, left and right"},
        "completed": {"enum": ["", "left", "right"], "description": "the eye that was hidden and filled in"},
        "true_eyes_m": _PAIR | {"description": "frame `stack`; only where the truth is known"},
    },
}
# The image messages follow Foxglove's well-known schemas, so that its viewer and others show them.
_STAMP = {"timestamp": {"type": "object"}, "frame_id": {"type": "string"}}
_BYTES = {"type": "string", "contentEncoding": "base64"}
COLOUR_SCHEMA = {
    "title": "foxglove.CompressedImage",
    "type": "object",
    "properties": _STAMP | {"data": _BYTES, "format": {"type": "string"}},
}
_SIZE = {"width": {"type": "integer"}, "height": {"type": "integer"}}
DEPTH_SCHEMA = {
    "title": "foxglove.RawImage",
    "type": "object",
    "properties": _STAMP | _SIZE | {"encoding": {"type": "string"}, "step": {"type": "integer"}, "data": _BYTES},
}
_NUMBERS = {"type": "array", "items": {"type": "number"}}
CALIBRATION_SCHEMA = {
    "title": "foxglove.CameraCalibration",
    "type": "object",
    "properties": _STAMP
    | _SIZE
    | {"distortion_model": {"type": "string"}, "D": _NUMBERS, "K": _NUMBERS, "R": _NUMBERS, "P": _NUMBERS},
}
SCHEMAS = {
    EYES_TOPIC: EYES_SCHEMA,
    COLOUR_TOPIC: COLOUR_SCHEMA,
    DEPTH_TOPIC: DEPTH_SCHEMA,
    CALIBRATION_TOPIC: CALIBRATION_SCHEMA,
}


@dataclass(frozen=True, slots=True)
class RecordingHeader:
    """What is true of the whole recording."""

    driver: str  # name of the driver that delivered it
    serial: str = ""
    eye_points: bool = True  # every sample says where the eyes are, or that there is no face
    colour: bool = False
    depth: bool = False
    truth: bool = False

    def metadata(self) -> dict[str, str]:
        """As MCAP metadata: text to text."""
        return {"schema_version": str(SCHEMA_VERSION)} | {
            key: (str(int(value)) if isinstance(value, bool) else value) for key, value in asdict(self).items()
        }

    @classmethod
    def from_metadata(cls, metadata: dict[str, str]) -> RecordingHeader:
        """Back from `metadata`. Raises ValueError for a version that is not ours."""
        version = metadata.get("schema_version", "missing")
        if version != str(SCHEMA_VERSION):
            raise ValueError(f"schema version {version}; this program reads {SCHEMA_VERSION}")
        flags = {f.name: metadata.get(f.name) == "1" for f in fields(cls) if f.type == "bool"}
        return cls(metadata.get("driver", ""), metadata.get("serial", ""), **flags)


def _points(eyes_m: F64 | None) -> list[list[float | None]] | None:
    if eyes_m is None:
        return None
    return [[round(float(x), POSITION_DIGITS) if np.isfinite(x) else None for x in eye] for eye in eyes_m]


def eyes_message(frame: SensorFrame) -> bytes:
    """A sample's eye points as JSON; coordinates that are not finite become null."""
    record: dict[str, Any] = {"sequence": frame.sequence, "capture_ns": frame.capture_ns}
    record["eyes_m"] = _points(frame.eyes.eyes_m if frame.eyes else None)
    if frame.eyes is not None:
        record["confidence"] = [round(float(c), 4) if np.isfinite(c) else 0.0 for c in frame.eyes.confidence]
        if frame.eyes.completed:
            record["completed"] = frame.eyes.completed
    if frame.true_eyes_m is not None:
        record["true_eyes_m"] = _points(frame.true_eyes_m)
    return json.dumps(record, separators=(",", ":"), allow_nan=False).encode()


def _pair(value: Any) -> F64 | None:
    if value is None:
        return None
    array = np.array(value, dtype=np.float64)  # None becomes NaN
    if array.shape != (2, 3):
        raise ValueError(f"two points of three coordinates expected, got shape {array.shape}")
    return array


def frame_from_eyes_message(data: bytes) -> SensorFrame:
    """Back from `eyes_message`. Raises ValueError where the message is not one."""
    try:
        record = json.loads(data)
        eyes_m = _pair(record["eyes_m"])
        eyes = None
        if eyes_m is not None:
            confidence = np.array(record.get("confidence", [1.0, 1.0]), dtype=np.float64)
            completed = record.get("completed", "")
            if confidence.shape != (2,) or completed not in ("", "left", "right"):
                raise ValueError("malformed confidence or completed")
            eyes = EyePoints(eyes_m, confidence, completed)
        return SensorFrame(
            sequence=int(record["sequence"]),
            capture_ns=int(record["capture_ns"]),
            eyes=eyes,
            true_eyes_m=_pair(record.get("true_eyes_m")),
        )
    except (KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"not an eye sample: {error!r}") from None


def _stamp(capture_ns: int) -> dict[str, Any]:
    seconds, nanoseconds = divmod(capture_ns, 1_000_000_000)
    return {"timestamp": {"sec": seconds, "nsec": nanoseconds}, "frame_id": "sensor"}


def colour_message(colour: U8, *, capture_ns: int) -> bytes:
    """(h, w, 3) RGB as a JPEG in JSON."""
    import cv2

    done, jpeg = cv2.imencode(".jpg", colour[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError("JPEG encoding failed")
    text = base64.b64encode(jpeg.tobytes()).decode()
    return json.dumps(_stamp(capture_ns) | {"data": text, "format": "jpeg"}).encode()


def colour_from_message(data: bytes) -> U8:
    """Back from `colour_message` (JPEG is lossy). Raises ValueError."""
    import cv2

    coded = np.frombuffer(base64.b64decode(json.loads(data)["data"]), np.uint8)
    image = cv2.imdecode(coded, cv2.IMREAD_COLOR) if coded.size else None
    if image is None:
        raise ValueError("a colour image cannot be decoded")
    return np.ascontiguousarray(image[..., ::-1])


def depth_message(depth_mm: U16, *, capture_ns: int) -> bytes:
    """(h, w) depth as raw 16-bit little-endian numbers in JSON."""
    height, width = depth_mm.shape
    raw = np.ascontiguousarray(depth_mm, dtype="<u2").tobytes()
    record = _stamp(capture_ns) | {"width": width, "height": height, "encoding": "16UC1", "step": 2 * width}
    return json.dumps(record | {"data": base64.b64encode(raw).decode()}).encode()


def depth_from_message(data: bytes) -> U16:
    """Back from `depth_message`, exactly. Raises ValueError."""
    record = json.loads(data)
    raw = np.frombuffer(base64.b64decode(record["data"]), "<u2")
    return raw.reshape(int(record["height"]), int(record["width"])).astype(np.uint16)


def calibration_message(intrinsics: Intrinsics, *, capture_ns: int) -> bytes:
    """Intrinsics as a pinhole without distortion. Foxglove's pixel centres are integers, ours half-integers."""
    i = intrinsics
    matrix = [i.fx_px, 0.0, i.cx_px - 0.5, 0.0, i.fy_px, i.cy_px - 0.5, 0.0, 0.0, 1.0]
    projection = [*matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0]
    record = _stamp(capture_ns) | {"width": i.width_px, "height": i.height_px, "distortion_model": "", "D": []}
    return json.dumps(record | {"K": matrix, "R": [1, 0, 0, 0, 1, 0, 0, 0, 1], "P": projection}).encode()


def intrinsics_from_message(data: bytes) -> Intrinsics:
    """Back from `calibration_message`. Raises ValueError."""
    record = json.loads(data)
    k = record["K"]
    return Intrinsics(int(record["width"]), int(record["height"]), k[0], k[4], k[2] + 0.5, k[5] + 0.5)
