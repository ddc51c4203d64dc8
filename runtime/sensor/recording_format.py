"""Define the topics, messages and schemas used in recordings, and encode and decode the messages."""

from __future__ import annotations

import base64
import json
from dataclasses import asdict, dataclass, fields
from typing import Annotated, Any, Literal, TypeVar

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, WithJsonSchema

from runtime.clock import NS_PER_S
from runtime.records import F64, U8, U16, EyePoints, Eyes, Intrinsics, SensorFrame
from runtime.support.picture_header import is_cut_off, picture_size

SCHEMA_VERSION = 1
METADATA_NAME = "phasestack.recording"
EYES_TOPIC, COLOUR_TOPIC, DEPTH_TOPIC, CALIBRATION_TOPIC = "/eyes", "/colour", "/depth", "/camera"
POSITION_DIGITS = 7  # decimal places of a position in metres: 0.1 µm is far below any sensor's noise
JPEG_QUALITY = 92  # JPEG quality of recorded colour pictures
NUMBER_MAX = 1 << 62  # the sum of two such numbers fits in 64 bits; 146 years in nanoseconds
COORDINATE_MAX_M = 1e6  # beyond any sensor's range in any unit; the tracker checks plausibility
PEOPLE_MOST = 16  # maximum number of people in a sample
IMAGE_SIDE_MAX_PX = 1 << 15  # larger than any camera's pictures

Count = Annotated[int, Field(ge=0, le=NUMBER_MAX)]
Unit = Annotated[float, Field(ge=0, le=1)]
Side = Annotated[int, Field(ge=1, le=IMAGE_SIDE_MAX_PX)]
Coordinate = Annotated[float, Field(ge=-COORDINATE_MAX_M, le=COORDINATE_MAX_M)]
Point = tuple[Coordinate | None, Coordinate | None, Coordinate | None]  # null: not measured
Square = Annotated[float, Field(ge=-(COORDINATE_MAX_M**2), le=COORDINATE_MAX_M**2)]
Row = tuple[Square, Square, Square]
Bytes = Annotated[str, Field(json_schema_extra={"contentEncoding": "base64"})]
Number = Annotated[float, Field(ge=-1e6, le=1e6)]
M = TypeVar("M", bound=BaseModel)


class Message(BaseModel):
    """Base class for messages. Numbers must be finite JSON numbers, not strings or booleans."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False)


class OtherEyes(Message):
    """Eyes of a person other than the nearest. The fields are those of `EyeSample`."""

    model_config = ConfigDict(title="phasestack.OtherEyes")

    eyes_m: tuple[Point, Point]
    confidence: tuple[Unit, Unit] = (1.0, 1.0)
    covariance_m2: tuple[Row, Row, Row] | None = None
    completed: Literal["", "left", "right"] = ""


class EyeSample(Message):
    """One sample of an eye-tracking sensor: the viewer's left eye first, in metres."""

    model_config = ConfigDict(title="phasestack.EyeSample")

    sequence: Count = Field(description="frame number reported by the device (gaps indicate lost frames)")
    capture_ns: Count = Field(description="time of exposure on the monotonic clock")
    eyes_m: tuple[Point, Point] | None = Field(
        description="eye positions in the `sensor` frame (+x right, +y down, +z away from the sensor), or null if "
        "there is no face"
    )
    confidence: tuple[Unit, Unit] = Field((1.0, 1.0), description="confidence in the left and right eyes, from 0 to 1")
    covariance_m2: tuple[Row, Row, Row] | None = Field(
        None, description="3x3 covariance of the midpoint of the eyes, if known"
    )
    completed: Literal["", "left", "right"] = Field(
        "", description="eye that was hidden and whose position has been filled in"
    )
    true_eyes_m: tuple[Point, Point] | None = Field(
        None, description="true eye positions in the `stack` frame, if known"
    )
    others: Annotated[list[OtherEyes], Field(max_length=PEOPLE_MOST - 1)] = Field(
        [], description="further people, nearest first; `eyes_m` is then the nearest person"
    )
    others_true_eyes_m: Annotated[list[tuple[Point, Point]], Field(max_length=PEOPLE_MOST - 1)] = Field(
        [], description="true eye positions of further people, always in the same order; null coordinates: absent"
    )


class Stamp(Message):
    """Capture time of a picture, as seconds and nanoseconds on the monotonic clock."""

    sec: Annotated[int, Field(ge=0, le=NUMBER_MAX // NS_PER_S)]
    nsec: Annotated[int, Field(ge=0, lt=NS_PER_S)]


class Stamped(Message):
    """Base class for messages with a capture time. The fields are the ones in Foxglove's schemas."""

    timestamp: Annotated[Stamp, WithJsonSchema({"type": "object"})]
    frame_id: str = "sensor"


class ColourImage(Stamped):
    """A colour picture as a JPEG."""

    model_config = ConfigDict(title="foxglove.CompressedImage")

    data: Bytes
    format: str = "jpeg"


class DepthImage(Stamped):
    """A depth picture in millimetres, as 16-bit little-endian numbers."""

    model_config = ConfigDict(title="foxglove.RawImage")

    width: Side
    height: Side
    encoding: str = "16UC1"
    step: int = 0
    data: Bytes


class Camera(Stamped):
    """A pinhole camera without distortion."""

    model_config = ConfigDict(title="foxglove.CameraCalibration")

    width: Side
    height: Side
    distortion_model: str = ""
    D: tuple[Number, ...] = ()
    K: Annotated[tuple[Number, ...], Field(min_length=9, max_length=9)]
    R: tuple[Number, ...] = ()
    P: tuple[Number, ...] = ()


MESSAGES: dict[str, type[Message]] = {
    EYES_TOPIC: EyeSample,
    COLOUR_TOPIC: ColourImage,
    DEPTH_TOPIC: DepthImage,
    CALIBRATION_TOPIC: Camera,
}
SCHEMAS = {topic: message.model_json_schema() for topic, message in MESSAGES.items()}


@dataclass(frozen=True, slots=True)
class RecordingHeader:
    """Properties of a whole recording, stored as metadata."""

    driver: str  # name of the driver that delivered the samples
    serial: str = ""  # serial number of the sensor
    colour: bool = False  # True if the recording contains colour pictures
    depth: bool = False  # True if the recording contains depth pictures

    def metadata(self) -> dict[str, str]:
        """Return the header as MCAP metadata, a mapping from strings to strings."""
        flags = {name: str(int(value)) for name, value in asdict(self).items() if isinstance(value, bool)}
        # `eye_points`: every sample contains the eyes, or null if there is no face.
        texts = {"schema_version": str(SCHEMA_VERSION), "driver": self.driver, "serial": self.serial, "eye_points": "1"}
        return texts | flags

    @classmethod
    def from_metadata(cls, metadata: dict[str, str]) -> RecordingHeader:
        """Create a header from the result of `metadata`. Raises ValueError for another schema version."""
        version = metadata.get("schema_version", "missing")
        if version != str(SCHEMA_VERSION):
            raise ValueError(f"schema version {version} is not supported; this release reads version {SCHEMA_VERSION}")
        flags = {f.name: metadata.get(f.name) == "1" for f in fields(cls) if f.type == "bool"}
        return cls(metadata.get("driver", ""), metadata.get("serial", ""), **flags)


def _read(kind: type[M], data: bytes) -> M:
    """Parse a JSON message. Raises ValueError, one line that names the first invalid field."""
    try:
        return kind.model_validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise ValueError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None


def _points(eyes_m: Eyes | None) -> list[list[float | None]] | None:
    if eyes_m is None:
        return None
    return [[round(float(x), POSITION_DIGITS) if np.isfinite(x) else None for x in eye] for eye in eyes_m]


def _array(points: tuple[Point, Point] | None) -> F64 | None:
    return None if points is None else np.array(points, dtype=np.float64)  # None becomes NaN


def eyes_message(frame: SensorFrame) -> bytes:
    """Encode a sample's eye points as JSON. Non-finite coordinates become null."""
    record: dict[str, Any] = {"sequence": frame.sequence, "capture_ns": frame.capture_ns}
    record |= {"eyes_m": None} if frame.eyes is None else _person(frame.eyes)
    if frame.true_eyes_m is not None:
        record["true_eyes_m"] = _points(frame.true_eyes_m[:2])
    if frame.eyes is not None and frame.others:
        record["others"] = [_person(other) for other in frame.others[: PEOPLE_MOST - 1]]
    if frame.true_eyes_m is not None and len(frame.true_eyes_m) > 2:
        pairs = frame.true_eyes_m[2 : 2 * PEOPLE_MOST].reshape(-1, 2, 3)
        record["others_true_eyes_m"] = [_points(pair) for pair in pairs]
    return json.dumps(record, separators=(",", ":"), allow_nan=False).encode()


def _person(points: EyePoints) -> dict[str, Any]:
    record: dict[str, Any] = {"eyes_m": _points(points.eyes_m)}
    record["confidence"] = [round(float(c), 4) if np.isfinite(c) else 0.0 for c in points.confidence]
    if points.completed:
        record["completed"] = points.completed
    if points.covariance_m2 is not None and np.isfinite(points.covariance_m2).all():
        record["covariance_m2"] = [[float(f"{x:.4g}") for x in row] for row in points.covariance_m2]
    return record


def frame_from_eyes_message(data: bytes) -> SensorFrame:
    """Decode the result of `eyes_message`. Raises ValueError if the message is malformed."""
    sample = _read(EyeSample, data)
    true_m = _array(sample.true_eyes_m)
    if true_m is not None and sample.others_true_eyes_m:
        true_m = np.concatenate([true_m, *(np.array(pair, np.float64) for pair in sample.others_true_eyes_m)])
    eyes, others = _eyes(sample), tuple(filter(None, map(_eyes, sample.others)))
    if eyes is None and others:
        raise ValueError("others: must be empty because `eyes_m` is null")
    return SensorFrame(sample.sequence, sample.capture_ns, eyes, true_eyes_m=true_m, others=others)


def _eyes(person: EyeSample | OtherEyes) -> EyePoints | None:
    eyes_m, covariance_m2 = _array(person.eyes_m), person.covariance_m2
    if eyes_m is None:
        return None
    covariance = None if covariance_m2 is None else np.array(covariance_m2)
    return EyePoints(eyes_m, np.array(person.confidence), person.completed, covariance)


def _stamped(capture_ns: int, **values: Any) -> bytes:
    """Encode values and their capture time as JSON."""
    seconds, nanoseconds = divmod(capture_ns, NS_PER_S)
    return json.dumps({"timestamp": {"sec": seconds, "nsec": nanoseconds}, "frame_id": "sensor"} | values).encode()


def colour_message(colour: U8, *, capture_ns: int) -> bytes:
    """Encode an (h, w, 3) RGB picture as a JSON message that contains a JPEG, or raise ValueError."""
    done, jpeg = cv2.imencode(".jpg", colour[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError("OpenCV could not encode a picture as JPEG")
    return _stamped(capture_ns, data=base64.b64encode(jpeg.tobytes()).decode(), format="jpeg")


def colour_from_message(data: bytes, *, max_pixels: int = 1 << 26) -> U8:
    """Decode the result of `colour_message` to an (h, w, 3) RGB picture, with JPEG's losses. Raises
    ValueError if the message is malformed, or if the picture is too large or cannot be decoded.
    """
    coded = base64.b64decode(_read(ColourImage, data).data)
    width, height = picture_size(coded)
    if max(width, height) > IMAGE_SIDE_MAX_PX or width * height > max_pixels:
        raise ValueError(f"a colour image of {width} x {height} pixels exceeds the maximum of {max_pixels:,} pixels")
    image = None if is_cut_off(coded) else cv2.imdecode(np.frombuffer(coded, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError("a colour image cannot be decoded")
    return np.ascontiguousarray(image[..., ::-1])


def depth_message(depth_mm: U16, *, capture_ns: int) -> bytes:
    """Encode an (h, w) depth picture in millimetres as a JSON message with 16-bit little-endian numbers."""
    height, width = depth_mm.shape
    raw = base64.b64encode(np.ascontiguousarray(depth_mm, dtype="<u2").tobytes()).decode()
    return _stamped(capture_ns, width=width, height=height, encoding="16UC1", step=2 * width, data=raw)


def depth_from_message(data: bytes) -> U16:
    """Decode `depth_message`, without loss, to (h, w) millimetres. Raises ValueError if it is malformed."""
    image = _read(DepthImage, data)
    raw = base64.b64decode(image.data)
    if len(raw) != 2 * image.width * image.height:
        raise ValueError(
            f"a depth image has {len(raw)} bytes, but {image.width} x {image.height} pixels require two bytes each"
        )
    return np.frombuffer(raw, "<u2").reshape(image.height, image.width).astype(np.uint16)


def calibration_message(intrinsics: Intrinsics, *, capture_ns: int) -> bytes:
    """Encode intrinsics as a JSON message by Foxglove's schema, where pixel centres are integers."""
    i = intrinsics
    matrix = [i.fx_px, 0.0, i.cx_px - 0.5, 0.0, i.fy_px, i.cy_px - 0.5, 0.0, 0.0, 1.0]
    projection = [*matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0]
    size = {"width": i.width_px, "height": i.height_px}
    turn = [1, 0, 0, 0, 1, 0, 0, 0, 1]
    return _stamped(capture_ns, **size, distortion_model="", D=[], K=matrix, R=turn, P=projection)


def intrinsics_from_message(data: bytes) -> Intrinsics:
    """Decode `calibration_message`. Raises ValueError if it is malformed."""
    camera = _read(Camera, data)
    k = camera.K
    if k[0] <= 0 or k[4] <= 0:
        raise ValueError(f"K: focal lengths must be positive, but are {k[0]:g} and {k[4]:g} pixels")
    return Intrinsics(camera.width, camera.height, k[0], k[4], k[2] + 0.5, k[5] + 0.5)
