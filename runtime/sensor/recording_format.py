"""What stands in a recording: topics, schemas, and each message as bytes and back."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from typing import Any

import cv2
import numpy as np

from runtime.clock import NS_PER_S
from runtime.errors import InputError
from runtime.records import F64, U8, U16, EyePoints, Intrinsics, SensorFrame
from runtime.support.foreign import parsed_json, real, shown, whole
from runtime.support.picture_header import is_cut_off, picture_size

SCHEMA_VERSION = 1
METADATA_NAME = "phasestack.recording"
EYES_TOPIC, COLOUR_TOPIC, DEPTH_TOPIC, CALIBRATION_TOPIC = "/eyes", "/colour", "/depth", "/camera"
POSITION_DIGITS = 7  # a tenth of a micrometre: four digits below the best sensor's noise
JPEG_QUALITY = 92
TIME_MAX_NS = 1 << 62  # 146 years: sums and differences of two still fit 64 bits
SEQUENCE_MAX = 1 << 62
COORDINATE_MAX_M = 1e6  # beyond what any sensor says, in any unit; the tracker judges what a viewer's eyes are
IMAGE_SIDE_MAX_PX = 1 << 15
MESSAGE_DEPTH_MAX = 16

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
        "covariance_m2": {
            "type": "array",
            "description": "3x3, of the middle between the eyes; where it is known",
        },
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
        if frame.eyes.covariance_m2 is not None and np.isfinite(frame.eyes.covariance_m2).all():
            record["covariance_m2"] = [[float(f"{x:.4g}") for x in row] for row in frame.eyes.covariance_m2]
    if frame.true_eyes_m is not None:
        record["true_eyes_m"] = _points(frame.true_eyes_m)
    return json.dumps(record, separators=(",", ":"), allow_nan=False).encode()


def _pair(value: Any) -> F64 | None:
    if value is None:
        return None
    if not (_has(value, 2) and all(_has(point, 3) for point in value)):
        raise ValueError(f"two points of three coordinates expected, got {shown(value)}")
    return np.array([[_coordinate(number) for number in point] for point in value])


def _covariance(value: Any) -> F64 | None:
    if value is None:
        return None
    if not (_has(value, 3) and all(_has(row, 3) for row in value)):
        raise ValueError(f"covariance_m2: three rows of three numbers expected, got {shown(value)}")
    limit = COORDINATE_MAX_M**2
    rows = [[real(x, least=-limit, most=limit, problem=_of("covariance_m2")) for x in row] for row in value]
    matrix = np.array(rows)
    if not np.allclose(matrix, matrix.T, rtol=1e-3, atol=0) or np.linalg.eigvalsh(matrix)[0] < -1e-3 * matrix.max():
        raise ValueError("covariance_m2 is no covariance")
    return matrix


def _has(value: Any, count: int) -> bool:
    return isinstance(value, list) and len(value) == count


def _coordinate(value: Any) -> float:
    if value is None:  # this one was not measured
        return float("nan")
    return real(value, least=-COORDINATE_MAX_M, most=COORDINATE_MAX_M, problem=_of("a coordinate"))


def _of(name: str) -> Callable[[str], ValueError]:
    return lambda problem: ValueError(f"{name} {problem}")


def _table(data: bytes) -> dict[str, Any]:
    """A message's JSON object. Raises ValueError."""
    try:
        table = parsed_json(data, source="", most_depth=MESSAGE_DEPTH_MAX)
    except InputError as error:
        raise ValueError(str(error)) from None
    if not isinstance(table, dict):
        raise ValueError(f"an object expected, got {shown(table)}")
    return table


def _required(table: dict[str, Any], name: str) -> Any:
    if name not in table:
        raise ValueError(f"{name} is missing")
    return table[name]


def frame_from_eyes_message(data: bytes) -> SensorFrame:
    """Back from `eyes_message`. Raises ValueError where the message is not one."""
    record = _table(data)
    eyes_m = _pair(_required(record, "eyes_m"))
    eyes = None
    if eyes_m is not None:
        confidence = record.get("confidence", [1.0, 1.0])
        completed = record.get("completed", "")
        if not _has(confidence, 2) or completed not in ("", "left", "right"):
            raise ValueError("malformed confidence or completed")
        certain = [real(c, least=0, most=1, problem=_of("confidence")) for c in confidence]
        eyes = EyePoints(eyes_m, np.array(certain), completed, _covariance(record.get("covariance_m2")))
    return SensorFrame(
        sequence=whole(_required(record, "sequence"), least=0, most=SEQUENCE_MAX, problem=_of("sequence")),
        capture_ns=whole(_required(record, "capture_ns"), least=0, most=TIME_MAX_NS, problem=_of("capture_ns")),
        eyes=eyes,
        true_eyes_m=_pair(record.get("true_eyes_m")),
    )


def _stamp(capture_ns: int) -> dict[str, Any]:
    seconds, nanoseconds = divmod(capture_ns, 1_000_000_000)
    return {"timestamp": {"sec": seconds, "nsec": nanoseconds}, "frame_id": "sensor"}


def capture_ns_of_image(data: bytes) -> int:
    """The capture time that a colour or depth message carries. Raises ValueError."""
    stamp = _required(_table(data), "timestamp")
    if not isinstance(stamp, dict):
        raise ValueError("timestamp is not an object")
    seconds = whole(stamp.get("sec"), least=0, most=TIME_MAX_NS // NS_PER_S, problem=_of("timestamp.sec"))
    return seconds * NS_PER_S + whole(stamp.get("nsec"), least=0, most=NS_PER_S - 1, problem=_of("timestamp.nsec"))


def _coded_bytes(table: dict[str, Any]) -> bytes:
    text = _required(table, "data")
    if not isinstance(text, str):
        raise ValueError("data is not text")
    return base64.b64decode(text)  # raises ValueError


def colour_message(colour: U8, *, capture_ns: int) -> bytes:
    """(h, w, 3) RGB as a JPEG in JSON."""
    done, jpeg = cv2.imencode(".jpg", colour[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError("JPEG encoding failed")
    text = base64.b64encode(jpeg.tobytes()).decode()
    return json.dumps(_stamp(capture_ns) | {"data": text, "format": "jpeg"}).encode()


def colour_from_message(data: bytes, *, most_pixels: int = 1 << 26) -> U8:
    """(h, w, 3) back from `colour_message` (JPEG is lossy). Raises ValueError."""
    coded = _coded_bytes(_table(data))
    width, height = picture_size(coded)
    if max(width, height) > IMAGE_SIDE_MAX_PX or width * height > most_pixels:
        raise ValueError(f"a colour image has {width} by {height} pixels; at most {most_pixels:,}")
    image = None if is_cut_off(coded) else cv2.imdecode(np.frombuffer(coded, np.uint8), cv2.IMREAD_COLOR)
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
    """(h, w) millimetres back from `depth_message`, exactly. Raises ValueError."""
    record = _table(data)
    width, height = (
        whole(record.get(name), least=1, most=IMAGE_SIDE_MAX_PX, problem=_of(name)) for name in ("width", "height")
    )
    raw = _coded_bytes(record)
    if len(raw) != 2 * width * height:
        raise ValueError(f"{width} by {height} pixels of 16 bits don't have {len(raw)} bytes")
    return np.frombuffer(raw, "<u2").reshape(height, width).astype(np.uint16)


def calibration_message(intrinsics: Intrinsics, *, capture_ns: int) -> bytes:
    """Intrinsics as a pinhole without distortion. Foxglove's pixel centres are integers, ours half-integers."""
    i = intrinsics
    matrix = [i.fx_px, 0.0, i.cx_px - 0.5, 0.0, i.fy_px, i.cy_px - 0.5, 0.0, 0.0, 1.0]
    projection = [*matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0]
    record = _stamp(capture_ns) | {"width": i.width_px, "height": i.height_px, "distortion_model": "", "D": []}
    return json.dumps(record | {"K": matrix, "R": [1, 0, 0, 0, 1, 0, 0, 0, 1], "P": projection}).encode()


def intrinsics_from_message(data: bytes) -> Intrinsics:
    """Back from `calibration_message`. Raises ValueError."""
    record = _table(data)
    width, height = (
        whole(record.get(name), least=1, most=IMAGE_SIDE_MAX_PX, problem=_of(name)) for name in ("width", "height")
    )
    if not _has(record.get("K"), 9):
        raise ValueError("K is not nine numbers")
    k = [real(number, least=-1e6, most=1e6, problem=_of("K")) for number in record["K"]]
    if k[0] <= 0 or k[4] <= 0:
        raise ValueError(f"K: focal lengths of {k[0]:g} and {k[4]:g} pixels")
    return Intrinsics(width, height, k[0], k[4], k[2] + 0.5, k[5] + 0.5)
